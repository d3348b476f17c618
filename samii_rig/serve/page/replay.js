// A recording through the scope and the moving rig, at any speed. What is shown is told to be a
// replay; the state, the stop and the run's progress above stay live.

const HEAD = 32; // bytes before a frame's values, see viewers.py
const TICK = 0.05; // s between what is fed
const AHEAD = 5; // s of a person's time that are fetched at once
const LEAST = 10; // s of the recording, at least

// The frames in an answer of the service, each as its head and values.
function frames(buffer) {
  const found = [], view = new DataView(buffer);
  for (let at = 0; at < buffer.byteLength;) {
    const columns = view.getUint16(at + 2, true), n = view.getUint32(at + 4, true), step = view.getUint32(at + 8, true);
    const end = at + HEAD + 4 * n * columns;
    found.push({ columns, n, step, rate: view.getFloat64(at + 16, true), first: Number(view.getBigInt64(at + 24, true)), data: buffer.slice(at, end), given: 0 });
    at = end;
  }
  return found;
}

// Rows of a frame as a frame of their own.
function part(f, rows) {
  const width = 4 * f.columns, out = new ArrayBuffer(HEAD + width * rows), view = new DataView(out);
  new Uint8Array(out).set(new Uint8Array(f.data, 0, HEAD));
  new Uint8Array(out).set(new Uint8Array(f.data, HEAD + width * f.given, width * rows), HEAD);
  view.setUint32(4, rows, true);
  view.setBigInt64(24, BigInt(f.first + (f.step > 1 ? (f.given / 2) * f.step : f.given)), true);
  return out;
}

export class Replay {
  // fetched : (recording, from, length) in s to the bytes of its frames, numbered from 0.
  // show : takes a frame. began, ended : tell the page. said : what is shown, and which part of it.
  constructor({ fetched, show, began, ended, said }) {
    Object.assign(this, { fetched, show, began, ended, said, on: false, paused: false, speed: 1 });
  }

  // about : id, name, duration in s, channels, whether it moves the rig that is drawn.
  start(about) {
    this.stop();
    Object.assign(this, { about, on: true });
    this.seek(0);
    this.timer = setInterval(() => this.tick(), 1000 * TICK);
  }

  stop() {
    clearInterval(this.timer);
    if (!this.on) return;
    this.on = false;
    this.ended();
  }

  seek(to) {
    Object.assign(this, { position: to, reached: to, queue: [], asked: null, before: performance.now() });
    this.began(this.about);
    this.tick();
  }

  // What comes next, while there is time.
  async fetch() {
    const { about, reached } = this;
    if (this.asked !== null || reached > about.duration || reached - this.position > AHEAD * this.speed) return;
    const length = Math.max(LEAST, AHEAD * this.speed), mine = (this.asked = Symbol("asked"));
    try {
      const found = frames(await this.fetched(about.id, reached, length));
      if (mine !== this.asked) return; // sought elsewhere meanwhile
      this.queue.push(...found);
      this.reached = reached + length;
    } catch (error) {
      if (mine === this.asked) { this.stop(); this.said(`The replay ended: ${error.message}`); }
      return;
    }
    this.asked = null;
  }

  tick() {
    if (!this.on) return;
    const now = performance.now(), passed = (now - this.before) / 1000;
    this.before = now;
    this.fetch();
    const { about, queue } = this;
    // Nothing is passed over that has not come yet.
    if (!this.paused) this.position = Math.min(this.position + passed * this.speed, this.reached, about.duration);
    while (queue.length) {
      const f = queue[0], pair = f.step > 1 ? 2 : 1;
      const begins = (f.first * (f.step > 1 ? 2 / f.step : 1)) / f.rate;
      const upTo = this.position >= about.duration ? f.n : Math.floor((this.position - begins) * f.rate) + 1;
      const rows = Math.floor((Math.min(f.n, upTo) - f.given) / pair) * pair;
      if (rows > 0) { this.show(part(f, rows)); f.given += rows; }
      if (f.given < f.n) break;
      queue.shift();
    }
    const over = this.position >= about.duration && !queue.length;
    this.said(`Replay of ${about.name}: ${this.position.toFixed(1)} of ${about.duration.toFixed(1)} s, × ${this.speed}${
      over ? ", over" : this.paused ? ", held" : ""}. Not live.`, this.position / (about.duration || 1));
  }
}
