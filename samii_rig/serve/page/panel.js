// The responses: of the run that goes on, over the rig file's model, and of any recordings laid
// over it; one view at a time, two cursors, notes at a frequency.

import { diagram } from "/page/chart.js";
import { remembered } from "/page/kept.js";
import { pretty } from "/page/units.js";
import { VIEWS, fromParts, nearest, shown, spanned, turned } from "/page/values.js";

const INKS = ["--c1", "--c2", "--c3"];
const DASHES = [[], [7, 3], [2, 3]];
const NOTE = /^at ([\d.]+) Hz: /; // how a note at a frequency begins
const WIDE = 1100; // px, as in layout.css
const LEAST_HIGH = 130, LEAST_WIDE = 220; // px of a diagram

const short = (v) => (Number.isFinite(v) ? Number(v.toPrecision(4)) : "–");

// Axes on which a circle is round: [low, high, step] of both.
function round(re, im, b) {
  const ends = (v) => { const k = v.filter(Number.isFinite); return [Math.min(...k, 0), Math.max(...k, 0)]; };
  const [[left, right], [foot, top]] = [ends(re), ends(im)];
  const scale = 1.1 * Math.max((right - left) / b.w, (top - foot) / b.h, 1e-12), [, , step] = spanned([0, scale * Math.min(b.w, b.h)], {});
  const around = (low, high, room) => [(low + high - scale * room) / 2, (low + high + scale * room) / 2, step];
  return [around(left, right, b.w), around(foot, top, b.h)];
}

// Over what is measured, or a model that fits would not be seen.
const modelLast = (a, b) => (a.name === "model") - (b.name === "model");

export class Panel {
  // noted : takes a note that a person writes at a frequency.
  constructor($, put, noted) {
    Object.assign(this, { $, put, live: null, going: false, laid: [], notes: [], cursors: [null, null], boxes: [] });
    for (const [id, v] of Object.entries(VIEWS)) put($("frf-show"), "option", v.name).value = id;
    remembered($("frf-show"), "responses", () => this.draw());
    $("frf-level").onchange = () => this.draw();
    const cursors = () => { $("frf-cursor-row").hidden = !$("frf-cursors").checked; this.draw(); };
    remembered($("frf-cursors"), "response cursors", cursors);
    for (const id of ["frf-a", "frf-b"]) $(id).oninput = () => this.draw();
    $("frf").onpointerdown = $("frf").onpointermove = (event) => this.pointed(event);
    $("frf-note").onsubmit = (event) => {
      event.preventDefault();
      noted(`at ${this.hz("frf-a").toPrecision(4)} Hz: ${$("frf-note-text").value}`);
      $("frf-note-text").value = "";
    };
    new ResizeObserver(() => this.draw()).observe($("frf-fill"));
    addEventListener("colours", () => this.draw());
  }

  // The responses of a run as the service tells them, null for none; going : it goes on.
  set(data, going) { Object.assign(this, { live: data, going }); this.levels(); }

  // A recording, over what is shown.
  lay(recording) {
    const responses = recording.responses.map((r) => ({ ...r, unit: r.level_unit, curves: r.curves.map(fromParts) }));
    this.laid = [...this.laid.filter((l) => l.id !== recording.id), { ...recording, responses }];
    this.levels();
  }

  levels() {
    const { $, put, live } = this, was = $("frf-level").value;
    $("frf-section").hidden = !live && !this.laid.length;
    $("h-frf").textContent = live && this.going ? "Frequency response so far" : "Frequency response";
    $("frf-level").replaceChildren();
    put($("frf-level"), "option", "newest").value = "";
    (live?.responses ?? []).forEach((r, k) => { put($("frf-level"), "option", `${r.level} ${r.unit}`).value = k; });
    if ([...$("frf-level").options].some((o) => o.value === was)) $("frf-level").value = was;
    $("frf-laid").replaceChildren();
    this.laid.forEach((l, k) => {
      const item = put($("frf-laid"), "span", "", "laid"), mark = put(item, "i", "");
      mark.style.background = `var(${INKS[k % INKS.length]})`;
      put(item, "span", l.name);
      const b = put(item, "button", "Take off");
      b.type = "button"; b.setAttribute("aria-label", `Take ${l.name} off`);
      b.onclick = () => { this.laid = this.laid.filter((x) => x !== l); this.levels(); };
    });
    this.draw();
  }

  // All curves of one output over one input, the model's first.
  curves(output, input) {
    const { live } = this, found = [];
    const at = this.$("frf-level").value;
    const chosen = at === "" ? (live?.responses.length ?? 0) - 1 : Number(at);
    const of = (r) => r.curves.find((c) => c.output === output && c.input === input);
    const m = live && of(live.model);
    if (m) found.push({ name: "model", f: live.model.frequency, curve: m, ink: "--ink", dash: [6, 4], width: 1.3 });
    (live?.responses ?? []).forEach((r, k) => {
      const c = of(r), main = k === chosen;
      if (c) found.push({ name: main ? "measured" : "", f: r.frequency, curve: c, ink: "--c0", alpha: main ? 1 : 0.4, width: main ? 1.6 : 1, banded: main });
    });
    this.laid.forEach((l, k) => {
      const r = l.responses.at(-1), c = r && of(r);
      if (c) found.push({ name: l.name, f: r.frequency, curve: c, ink: INKS[k % INKS.length], dash: DASHES[Math.floor(k / INKS.length) % 3], banded: true });
    });
    return found;
  }

  // Which outputs over which inputs there are, with their units.
  entries() {
    const found = new Map(), { live } = this;
    const add = ({ output, input, unit }) => found.set(`${output} / ${input}`, { output, input, unit: pretty(unit) });
    for (const c of live?.model.curves ?? []) add(c);
    for (const l of this.laid) for (const c of l.responses.at(-1)?.curves ?? []) add(c);
    return [...found].map(([title, e]) => ({ title, ...e }));
  }

  // Hz from the lowest to the highest that is shown.
  band() {
    const all = this.laid.flatMap((l) => l.responses.flatMap((r) => r.frequency.filter((f) => f > 0)));
    const ends = this.live ? [this.live.low_hz, this.live.high_hz] : [];
    const low = Math.min(...ends.slice(0, 1), ...all), high = Math.max(...ends.slice(1), ...all);
    return [Math.max(low, high * 1e-3), high];
  }

  hz(id) {
    const [low, high] = this.band();
    return low * (high / low) ** (Number(this.$(id).value) / 1000);
  }

  draw() {
    const { $ } = this, canvas = $("frf");
    if ($("frf-section").hidden) return;
    const entries = this.entries(), view = $("frf-show").value, about = VIEWS[view], room = $("frf-fill");
    const wide = Math.max(1, Math.min(2, Math.floor(room.clientWidth / LEAST_WIDE))), rows = Math.ceil(entries.length / wide);
    // Where the page is one column it scrolls, and nothing within it.
    room.style.minHeight = innerWidth < WIDE ? `${rows * LEAST_HIGH}px` : "";
    canvas.style.height = `${Math.max(room.clientHeight, rows * LEAST_HIGH)}px`;
    room.style.overflowY = rows * LEAST_HIGH > room.clientHeight ? "auto" : "hidden";
    const ratio = window.devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
    canvas.width = Math.round(w * ratio); canvas.height = Math.round(h * ratio);
    const g = canvas.getContext("2d"), style = getComputedStyle(document.documentElement);
    const ink = (name) => style.getPropertyValue(name).trim();
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.lineJoin = "round";
    const on = $("frf-cursors").checked ? [["A", this.hz("frf-a")], ["B", this.hz("frf-b")]] : [];
    this.boxes = []; this.read = [];
    entries.forEach((e, i) => {
      const b = { x: (i % wide) * (w / wide) + 52, y: Math.floor(i / wide) * (h / rows) + 22, w: w / wide - 62, h: h / rows - 44 };
      this.one(g, b, e, view, about, on, ink);
      this.boxes.push(b);
    });
    if (on.length) this.tell(on, about);
  }

  one(g, b, e, view, about, on, ink) {
    const list = this.curves(e.output, e.input), first = list[0], flags = this.flags();
    const drawn = list.map((c) => {
      const d = shown(c.curve, view);
      return view === "phase" && c !== first ? turned(d, c.f, shown(first.curve, view).y, first.f) : d;
    });
    const bare = (d, c) => (c.banded ? d : { y: d.y });
    if (view === "nyquist") {
      const re = list.map((c) => shown(c.curve, "real").y), im = list.map((c) => shown(c.curve, "imag").y);
      const [x, y] = round(re.flat(), im.flat(), b);
      const cursors = on.map(([name, at]) => ({ name, at: null, points: list.slice(-1).flatMap((c) => { const k = nearest(c.f, at); return k < 0 ? [] : [[re.at(-1)[k], im.at(-1)[k]]]; }) }));
      const curves = list.map((c, k) => ({ ...c, x: re[k], y: im[k] })).sort(modelLast);
      diagram(g, b, { title: e.title, unit: about.unit(e.unit), x, y, curves, cursors }, ink);
      drawn.forEach((d, k) => { d.words = re[k].map((v, i) => `${short(v)} ${im[k][i] < 0 ? "−" : "+"} ${short(Math.abs(im[k][i]))}i`); });
    } else {
      const x = this.band(), y = spanned(drawn.flatMap((d) => d.y), about);
      const curves = list.map((c, k) => ({ ...c, ...bare(drawn[k], c), x: c.f })).sort(modelLast);
      const seen = list.find((c) => c.name === "measured");
      const hatched = !this.going || this.laid.length ? [] : seen ? [[x[0], seen.f[0]], [seen.f.at(-1), x[1]]] : [x];
      const cursors = on.map(([name, at]) => ({ name, at, points: [] }));
      diagram(g, b, { title: e.title, unit: about.unit(e.unit), x, y, logarithmic: true, curves, hatched, cursors, flags }, ink);
    }
    this.read.push({ title: e.title, values: list.map((c, k) => ({ c, d: drawn[k] })).filter(({ c }) => c.name) });
  }

  flags() {
    const said = [...this.notes, ...this.laid.flatMap((l) => l.notes.map((n) => n.text))];
    return said.map((t) => [NOTE.exec(t), t]).filter(([m]) => m).map(([m, t]) => ({ at: Number(m[1]), text: t.slice(m[0].length) }));
  }

  // The cursors in words: frequency, value and band of each curve.
  tell(on, about) {
    const { $, put } = this, table = $("frf-read");
    table.replaceChildren();
    const head = put(put(table, "thead", ""), "tr", "");
    for (const text of ["Response", ...on.map(([name, at]) => `${name}: ${at.toPrecision(4)} Hz`)]) put(head, "th", text);
    for (const id of ["frf-a", "frf-b"]) $(id).setAttribute("aria-valuetext", `${this.hz(id).toPrecision(4)} Hz`);
    const body = put(table, "tbody", "");
    for (const { title, values } of this.read) {
      for (const { c, d } of values) {
        const row = put(body, "tr", "");
        put(row, "td", `${title}, ${c.name}`);
        for (const [, at] of on) {
          const k = nearest(c.f, at);
          const around = k >= 0 && c.banded && d.low ? ` (${short(d.low[k])} to ${short(d.high[k])})` : "";
          put(row, "td", k >= 0 && d.words ? d.words[k] : k < 0 || d.y?.[k] === null ? "–" : `${short(d.y[k])}${around}`);
        }
      }
    }
    table.setAttribute("aria-label", `Cursors, ${about.name}`);
  }

  // With a pointer: the nearer cursor comes.
  pointed(event) {
    const { $ } = this;
    if (!$("frf-cursors").checked || !event.buttons || $("frf-show").value === "nyquist") return;
    const place = $("frf").getBoundingClientRect(), x = event.clientX - place.left, y = event.clientY - place.top;
    const b = this.boxes.find((box) => x >= box.x && x <= box.x + box.w && y >= box.y && y <= box.y + box.h);
    if (!b) return;
    const at = (1000 * (x - b.x)) / b.w, far = (id) => Math.abs(Number($(id).value) - at);
    $(far("frf-a") < far("frf-b") ? "frf-a" : "frf-b").value = Math.round(at);
    this.draw();
  }
}
