// What is to be seen from across the room: the averages so far, and whether a channel is overloaded.

const HEAD = 32; // bytes before a frame's values, see viewers.py
const NEAR = 0.8; // of the limit, from which a lamp is amber
const HELD = 1000; // ms for which a value counts as of now
const SHOWN = 250; // ms between looks

// The least of a channel's gate limit and its converter's range: unit, max, and of which it is.
export function bounds(rig) {
  const found = {};
  const least = (name, max, what, unit) => { if (max > 0 && !(found[name]?.max <= max)) found[name] = { max, what, unit }; };
  for (const s of [...rig.sensor, ...rig.actuator]) {
    const low = s.low ?? -Infinity, high = s.high ?? Infinity, range = Math.min(-low, high);
    if (Number.isFinite(range)) least(s.name, range, "range", s.unit);
  }
  for (const l of rig.limit) least(l.channel, l.max, "limit", l.unit);
  return found;
}

export class Lamps {
  constructor($, put) {
    Object.assign(this, { $, put, bounds: {}, channels: [], now: [], boxes: [], job: "" });
    setInterval(() => this.show(), SHOWN);
  }

  rig(rig) { this.bounds = bounds(rig); this.key = ""; }

  // A frame of the live data, whatever the scope shows.
  take(buffer) {
    const v = new DataView(buffer), columns = v.getUint16(2, true), rows = v.getUint32(4, true), at = performance.now();
    if (v.getUint8(0) !== 1 || columns !== this.channels.length) return;
    const values = new Float32Array(buffer, HEAD);
    this.boxes.forEach((box) => {
      let most = 0;
      for (let i = box.column; i < rows * columns; i += columns) { const a = Math.abs(values[i]); if (a > most) most = a; }
      const part = most / box.bound.max;
      if (part >= box.part || at - box.at > HELD) Object.assign(box, { part, at });
      if (part >= 1) box.over = true;
    });
  }

  // What a state says: the channels of the run, and its averages.
  state(s, moves) {
    const r = s.running, { $ } = this;
    $("lamps").hidden = !moves;
    if (!r) return;
    const key = r.id + JSON.stringify(s.channels);
    if (s.channels.length && (key !== this.key)) { this.key = key; this.lay(s.channels); }
    const p = r.progress, some = p.of_averages > 0;
    $("averages").textContent = some ? `${p.averages} / ${p.of_averages}` : "–";
    $("averages-of").textContent = some ? `averages at ${p.level} ${p.unit}` : "averages";
  }

  lay(channels) {
    const { $, put } = this;
    this.channels = channels;
    $("overloads").replaceChildren();
    this.boxes = channels.flatMap((c, column) => {
      const bound = this.bounds[c.name];
      if (!bound || c.role === "reference") return [];
      const box = put($("overloads"), "li", "", "lamp");
      put(box, "b", c.name);
      return [{ element: box, word: put(box, "span", ""), column, bound, part: 0, at: 0, over: false }];
    });
  }

  show() {
    for (const b of this.boxes) {
      const part = performance.now() - b.at > HELD ? 0 : b.part;
      const state = part >= 1 ? "over" : b.over ? "was" : part >= NEAR ? "near" : "fine";
      const word = { over: "OVER", was: "was over", near: `${Math.round(100 * part)} %`, fine: `${Math.round(100 * part)} %` }[state];
      if (b.element.dataset.state !== state) b.element.dataset.state = state;
      if (b.word.textContent !== word) b.word.textContent = word;
      b.element.title = `largest value of the last second, of the ${b.bound.what} ${b.bound.max} ${b.bound.unit}`;
    }
  }
}
