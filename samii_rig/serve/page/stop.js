// The stop: asked of all that can carry it out at once, again and again until the run is seen to be
// at rest. What a server answers is not believed by its status alone: a proxy answers too.

const EVERY = 300; // ms between tries
const WITHIN = 2000; // ms for an answer
const INSISTS = 1200; // ms after which a run that has not ended is told once more
const AGE = 5; // s; how long it takes is said in steps of so many, as each is read aloud
const ASLEEP = 30000; // ms without a try, as of a page that slept: who pressed then is asked again
const SAID = 8000; // ms for which it is said that it is done
const KEY = "samii-rig stop";

export class Stop {
  // urls : whom to ask, the service first. running : whether a live state says that a run may move,
  // null without one. said : takes what goes on. alarm : takes what went wrong, "" once it is over.
  constructor({ urls, running, said, alarm, store = sessionStorage }) {
    Object.assign(this, { urls, running, said, alarm, store, since: 0, last: 0, timer: 0, offered: false });
    const kept = JSON.parse(store.getItem(KEY) ?? "null");
    if (kept) { Object.assign(this, kept); this.next(); }
  }

  press() {
    const now = Date.now();
    if (!this.since || this.offered) this.since = now;
    Object.assign(this, { last: now, receivedAt: 0, offered: false });
    this.keep();
    this.said("Stop asked for …");
    clearTimeout(this.timer);
    this.round();
  }

  // Who pressed does not want it any more.
  drop() { this.end(); this.said(""); }

  keep() { this.store.setItem(KEY, JSON.stringify({ since: this.since, last: this.last })); }

  end() {
    clearTimeout(this.timer);
    Object.assign(this, { since: 0, offered: false });
    this.store.removeItem(KEY);
    this.alarm("");
  }

  next() {
    clearTimeout(this.timer);
    this.timer = setTimeout(() => {
      if (Date.now() - this.last > ASLEEP) this.offer(); else this.round();
    }, EVERY);
  }

  // Long after it was pressed it may be another run that would be stopped.
  offer() {
    this.offered = true;
    this.alarm(`The stop of ${new Date(this.since).toLocaleTimeString()} did not reach the service, as far as this page knows.`);
  }

  async round() {
    const mine = (this.turn = Symbol("turn")), now = Date.now();
    this.last = now;
    this.keep();
    const again = !this.receivedAt || now - this.receivedAt > INSISTS;
    const answers = this.urls().map((url) => this.ask(url, again ? "POST" : "GET"));
    const first = await Promise.any(answers).catch((all) => ({ failed: [...new Set(all.errors.map((e) => e.message))].join(", ") }));
    if (mine !== this.turn || !this.since) return; // pressed again, or dropped, meanwhile
    if (first.failed) this.failed(first.failed);
    else if (first.moving || this.running()) this.ending(again);
    else {
      this.end();
      this.said("The stop is done: nothing moves.");
      this.timer = setTimeout(() => this.said(""), SAID);
      return;
    }
    this.next();
  }

  async ask(url, method) {
    const answer = await fetch(url, { method, keepalive: true, credentials: "include", signal: AbortSignal.timeout(WITHIN) })
      .catch(() => { throw new Error("no answer"); });
    if (!answer.ok) throw new Error(`answered with ${answer.status}`);
    const found = await answer.json().catch(() => ({}));
    if (typeof found.moving !== "boolean") throw new Error("answered by something else");
    return found;
  }

  ending(asked) {
    if (asked) this.receivedAt = Date.now();
    this.alarm("");
    const s = Math.floor((Date.now() - this.since) / 1000);
    this.said(`The stop was received${s ? ` ${s} s ago` : ""}; the run has not ended yet …`);
    if (s >= AGE) this.alarm("THE STOP WAS RECEIVED, BUT THE RUN HAS NOT ENDED. Use the emergency stop at the rig.");
  }

  failed(what) {
    const s = AGE * Math.floor((Date.now() - this.since) / 1000 / AGE);
    this.receivedAt = 0;
    this.said("The stop has not reached the service.");
    this.alarm(`THE STOP HAS NOT REACHED THE SERVICE${s ? ` for ${s} s` : ""} (${what}). Use the emergency stop at the rig. It is sent again until it works.`);
  }
}
