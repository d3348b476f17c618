// The recordings: found, looked at, compared, replayed, laid over the responses.

import { plot } from "/page/curves.js";
import { VERDICTS, clock } from "/page/now.js";

// Two recordings, in units of their joint uncertainty
const COLUMNS = {
  "Response": (p, r) => `${r.output}/${r.input} at ${p.level} ${p.unit}`,
  "Lines": (p, r) => r.lines,
  "Mean square (noise: 1)": (p, r) => r.mean_square?.toPrecision(3) ?? "–",
  "Lines beyond noise": (p, r) => r.beyond_noise,
  "Largest": (p, r) => (r.largest === null ? "–" : `${r.largest.toPrecision(2)} sd at ${r.largest_hz.toFixed(2)} Hz`),
  "Median difference": (p, r) => (r.median_relative === null ? "–" : `${(100 * r.median_relative).toPrecision(2)} %`),
};

export class Recordings {
  // state : the newest. play : takes a recording to replay. lay : takes a recording's responses and
  // notes. tried : wraps what may go wrong.
  constructor({ $, put, ask, tried, state, play, lay }) {
    Object.assign(this, { $, put, ask, tried, state, play, lay, looked: "", listed: [], asked: 0, shown: 0 });
    $("search").onsubmit = tried(() => this.find());
    $("other").onchange = tried(() => this.compare());
    $("note").onsubmit = tried(async () => {
      await ask("POST", `/recordings/${this.looked}/notes`, { text: $("note-text").value });
      $("note-text").value = "";
      await this.look(this.looked);
    });
  }

  async find() {
    const { $, put, ask } = this;
    const query = new URLSearchParams({ text: $("words").value, experiment: $("by-experiment").value, since: $("since").value, limit: 50 });
    const asked = ++this.asked, found = await ask("GET", `/recordings?${query}`);
    if (asked < this.shown) return; // a later question was answered before
    this.shown = asked;
    $("found").textContent = `${found.total} found`;
    this.listed = found.recordings;
    $("list").replaceChildren();
    for (const e of found.recordings) {
      const row = put($("list"), "tr", ""), running = this.state()?.running;
      const written = running && `${running.recording}.partial` === e.path;
      put(row, "td", e.started.slice(0, 16).replace("T", " "), "time");
      for (const text of [e.experiment, e.operator, clock(e.duration_s), written ? "being written" : e.problem || e.status, VERDICTS[e.verdict] ?? "", e.tags.join(", ")]) put(row, "td", text);
      const cell = put(row, "td", ""), b = put(cell, "button", e.path);
      b.type = "button"; b.onclick = this.tried(() => this.look(e.id));
    }
  }

  async look(id) {
    const { $, put, ask } = this;
    this.looked = id;
    $("replay").disabled = true; // of what was looked at before
    const { recording: e, remarks } = await ask("GET", `/recordings/${id}`);
    $("one").hidden = false;
    this.offer(id);
    $("h-one").textContent = e.path;
    $("one-about").textContent = `${e.rig}, ${e.experiment}, ${e.samples.toLocaleString()} samples at ${e.rate_hz} Hz; ${e.status}: ${e.reason} `;
    $("report").href = `/api/recordings/${id}/report`;
    const link = put($("one-about"), "a", "download");
    link.href = `/api/recordings/${id}/file`;
    $("one-diagnosis").textContent = (remarks?.diagnosis.lines || []).join(" ");
    $("one-notes").replaceChildren();
    for (const n of remarks?.notes || []) put($("one-notes"), "li", `${n.time.slice(0, 16).replace("T", " ")} ${n.author}: ${n.text}`);
    $("one").scrollIntoView({ block: "start" });
    // Who opened it by a key goes on from here.
    $("h-one").focus({ preventScroll: true });
    const signals = await ask("GET", `/recordings/${id}/signals?pixels=700`);
    const time = $("one-time"), bode = $("one-frf");
    time.style.height = `${40 + 70 * signals.curves.length}px`;
    $("replay").onclick = () => {
      const list = signals.curves.map(({ name, unit, role }) => ({ name, unit, role }));
      this.play({ id, name: e.path, duration: signals.duration_s, channels: list, rig: e.rig });
      $("h-scope").scrollIntoView({ block: "start" });
    };
    $("replay").disabled = false;
    plot(time, signals.curves.map((c) => ({ name: c.name, unit: c.unit, x: c.time, y: c.values })));
    const { responses } = e.responses ? await ask("GET", `/recordings/${id}/frf`) : { responses: [] };
    bode.hidden = $("lay").hidden = !responses.length;
    if (!responses.length) return;
    $("lay").onclick = () => {
      this.lay({ id, name: e.path, responses, notes: remarks?.notes || [] });
      $("h-frf").scrollIntoView({ block: "start" });
    };
    const r = responses.at(-1);
    bode.style.height = `${40 + 110 * r.curves.length}px`;
    plot(bode, r.curves.map((c) => ({
      name: `${c.output}/${c.input}`, unit: "dB", x: r.frequency,
      y: c.re.map((re, i) => (re === null ? null : 20 * Math.log10(Math.hypot(re, c.im[i])))),
    })), { logarithmic: true, unit: "Hz" });
  }

  offer(id) {
    const { $, put } = this;
    $("compared").replaceChildren();
    $("other").replaceChildren();
    put($("other"), "option", "another recording …").value = "";
    for (const e of this.listed) if (e.id !== id && e.responses) put($("other"), "option", e.path).value = e.id;
  }

  async compare() {
    const { $, put } = this;
    $("compared").replaceChildren();
    if (!$("other").value) return;
    const { pairs } = await this.ask("GET", `/compare?a=${this.looked}&b=${$("other").value}`);
    const table = put($("compared"), "table", ""), head = put(put(table, "thead", ""), "tr", "");
    for (const name of Object.keys(COLUMNS)) put(head, "th", name);
    const body = put(table, "tbody", "");
    for (const p of pairs) {
      for (const r of p.outputs) {
        const row = put(body, "tr", "");
        for (const text of Object.values(COLUMNS)) put(row, "td", text(p, r));
      }
    }
    if (!body.children.length) $("compared").textContent = "They have no response on common lines.";
  }
}
