// The live scope: up to four channels, free running or from a trigger, with two cursors. Missing
// samples are gaps, and a connection that is lost covers the picture: what is old never looks live.

import { grid, range } from "/page/grid.js";
import { Samples } from "/page/samples.js";
import { pretty } from "/page/units.js";

const EASE = 0.12; // of what is missing, a frame: blocks come four times a second
const BEFORE = 0.25; // of the span, before the trigger
const PATIENCE = 1.0; // s after which "auto" runs on without a trigger
export const LEFT = 52, RIGHT = 8; // px beside the curves

export class Scope {
  constructor(canvas, said) {
    Object.assign(this, { canvas, said, channels: [], shown: [], span: 5, paused: false, live: false, why: "" });
    this.trigger = { mode: "off", lane: 0, level: 0, rising: true };
    this.about = {}; // of each channel by name: its resolution and its limit
    this.toLimits = false;
    this.cursors = null; // two parts of the width, or none
    this.samples = new Samples();
    this.inks = {};
    this.clear();
    addEventListener("colours", () => { this.inks = {}; });
    const draw = () => { if (canvas.isConnected) { this.draw(); requestAnimationFrame(draw); } };
    requestAnimationFrame(draw);
  }

  ink = (name) => (this.inks[name] ??= getComputedStyle(document.documentElement).getPropertyValue(name).trim());

  clear() { this.samples.clear(0, 0); this.edge = null; this.arm(); }

  get empty() { return this.samples.end === null; }
  get lost() { return this.samples.lost; }

  // Look for a trigger from what is new on.
  arm() { this.kept = null; this.at = null; this.looked = this.samples.end ?? 0; this.text = null; }

  take(buffer) {
    const frame = this.samples.take(buffer, this.channels.length);
    if (frame) this.look();
    return frame;
  }

  // The next crossing of the level whose window is whole; after it the next begins.
  look() {
    const { mode, lane, level, rising } = this.trigger, s = this.samples, column = this.shown[lane];
    if (mode === "off" || column === undefined || (mode === "single" && this.kept) || this.paused) return;
    const after = Math.ceil((1 - BEFORE) * this.span * s.rate), before = Math.floor(BEFORE * this.span * s.rate);
    let r = Math.max(this.looked, s.begin + 1);
    for (; r < s.end - after; r++) {
      const a = s.value(column, r - 1), b = s.value(column, r);
      if (rising ? a < level && b >= level : a > level && b <= level) {
        // Between two samples, so that the picture does not jump by one.
        this.at = (r - 1 + (level - a) / (b - a)) / s.rate;
        this.kept = s.copy(r - before - 1, r + after);
        r += after;
        if (mode === "single") break;
      }
    }
    this.looked = r;
  }

  pause(on) {
    this.paused = on;
    const s = this.samples;
    if (!on) { this.frozen = null; return; }
    if (this.empty) return;
    this.frozen = this.view();
    if (this.frozen.rows === s) {
      const { from } = this.frozen;
      this.frozen.rows = s.copy(Math.floor(from * s.rate), Math.ceil((from + this.span) * s.rate));
    }
  }

  // What is shown: rows, the time at the left edge, and the trigger's time if it is from one.
  view() {
    if (this.frozen) return this.frozen;
    const s = this.samples, newest = (s.end ?? 0) / (s.rate || 1);
    const { mode } = this.trigger;
    const waits = mode !== "off" && !(mode === "auto" && newest - (this.at ?? -Infinity) > PATIENCE + this.span);
    if (waits && this.kept) return { rows: this.kept, from: this.at - BEFORE * this.span, at: this.at };
    if (waits && mode !== "auto") return { rows: null, from: 0, at: null };
    return { rows: s, from: this.edge - this.span, at: null };
  }

  tell(view) {
    const { mode } = this.trigger;
    let text = "";
    if (this.paused) text = "Paused";
    else if (this.over) text = this.empty ? "" : "The run is over: these are its last samples";
    else if (mode === "single" && this.kept) text = "Triggered once";
    else if (mode === "normal" || mode === "single") text = view.rows ? "Triggered" : "Waiting for the trigger";
    else if (mode === "auto") text = view.at === null ? "No trigger: runs free" : "Triggered";
    if (text !== this.text) { this.text = text; this.said(text); }
  }

  draw() {
    const c = this.canvas, ratio = window.devicePixelRatio || 1, w = c.clientWidth, h = c.clientHeight;
    if (c.width !== Math.round(w * ratio) || c.height !== Math.round(h * ratio)) {
      c.width = Math.round(w * ratio); c.height = Math.round(h * ratio);
    }
    const g = c.getContext("2d"), s = this.samples, ink = this.ink;
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.clearRect(0, 0, w, h);
    const end = s.end === null ? 0 : s.end / s.rate;
    if (this.edge === null || Math.abs(end - this.edge) > 2) this.edge = end;
    this.edge += EASE * (end - this.edge);
    const view = this.view(), lanes = this.shown.length || 1, tall = (h - 22) / lanes, width = w - LEFT - RIGHT;
    this.tell(view);
    this.read = [];
    g.font = "13px system-ui, sans-serif"; g.lineJoin = "bevel";
    g.globalAlpha = this.over ? 0.55 : 1; // what is over does not look live
    this.shown.forEach((column, lane) => this.lane(g, view, column, lane, 4 + lane * tall, width, tall - 8));
    g.globalAlpha = 1;
    g.fillStyle = ink("--muted"); g.textAlign = "left";
    const zero = view.at === null || view.at === undefined ? view.from + this.span : view.at;
    const told = (t) => (Math.abs(t) < 1e-9 ? (view.at === null ? (this.over ? "end" : this.recorded ? "shown" : "now") : "trigger") : `${t > 0 ? "+" : "−"}${Math.abs(t).toPrecision(3)} s`);
    g.fillText(told(view.from - zero), LEFT, h - 4);
    g.textAlign = "right"; g.fillText(this.frozen && view.at === null ? "paused" : told(view.from + this.span - zero), w - 8, h - 4);
    if (this.cursors) this.marks(g, width, h);
    const why = this.why || (!view.rows && this.live ? "Waiting for the trigger" : "");
    if (why) {
      g.fillStyle = ink("--panel"); g.globalAlpha = 0.8; g.fillRect(LEFT, 0, w, h - 20);
      g.globalAlpha = 1; g.fillStyle = ink(this.live ? "--muted" : "--bad");
      g.font = "600 18px system-ui, sans-serif"; g.textAlign = "center";
      g.fillText(why, LEFT + (w - LEFT) / 2, h / 2);
    }
  }

  marks(g, width, h) {
    g.setLineDash([2, 3]); g.lineWidth = 1.5; g.strokeStyle = g.fillStyle = this.ink("--ink"); g.textAlign = "left";
    this.cursors.forEach((part, i) => {
      const x = LEFT + part * width;
      g.beginPath(); g.moveTo(x, 0); g.lineTo(x, h - 20); g.stroke();
      g.fillText("AB"[i], x + 3, h - 26);
    });
    g.setLineDash([]);
  }

  lane(g, view, column, lane, y, w, h) {
    const ink = this.ink, colour = ink(`--c${lane}`), channel = this.channels[column], x = LEFT;
    g.strokeStyle = ink("--line"); g.lineWidth = 1; g.strokeRect(x, y, w, h);
    this.curve(g, view, column, lane, y, w, h);
    // Over the curve, with room round it: the edge beside it is the values'.
    const name = channel ? channel.name : "", unit = channel ? pretty(channel.unit) : "";
    g.font = "600 13px system-ui, sans-serif"; g.textAlign = "left"; g.lineWidth = 5; g.strokeStyle = ink("--panel");
    const after = x + 12 + g.measureText(name).width;
    g.strokeText(name, x + 6, y + 14); g.fillStyle = colour; g.fillText(name, x + 6, y + 14);
    g.font = "13px system-ui, sans-serif"; g.fillStyle = ink("--muted");
    g.strokeText(unit, after, y + 14); g.fillText(unit, after, y + 14); g.lineWidth = 1;
  }

  // Grid, zero, limits and curve of a channel, as far as there are samples.
  curve(g, view, column, lane, y, w, h) {
    const ink = this.ink, colour = ink(`--c${lane}`), channel = this.channels[column], x = LEFT;
    const rows = view.rows;
    if (!rows || rows.begin === null || !rows.columns[column]) return;
    const values = rows.columns[column], size = rows.length, rate = rows.rate;
    const first = Math.max(rows.begin, Math.ceil(view.from * rate));
    const last = Math.min(rows.end, Math.floor((view.from + this.span) * rate) + 1);
    const perPixel = (this.span * rate) / w, px = (r) => x + (w * (r / rate - view.from)) / this.span;
    // More rows than pixels: the outline of each pixel's rows, which is what would be seen.
    const bins = perPixel > 1 ? Math.ceil(w) + 1 : 0;
    const lowest = new Float32Array(bins).fill(Infinity), highest = new Float32Array(bins).fill(-Infinity);
    let low = Infinity, high = -Infinity;
    for (let r = first; r < last; r++) {
      const v = values[r % size];
      if (v < low) low = v;
      if (v > high) high = v;
      if (bins) {
        const b = ((r / rate - view.from) * w / this.span) | 0;
        if (v < lowest[b]) lowest[b] = v;
        if (v > highest[b]) highest[b] = v;
      }
    }
    if (this.cursors) {
      this.read[lane] = this.cursors.map((part) => {
        const r = Math.round((view.from + part * this.span) * rate);
        return r >= rows.begin && r < rows.end ? values[r % size] : NaN;
      });
    }
    if (!(high >= low)) return;
    const about = this.about[channel?.name];
    [low, high] = range(low, high, about, this.toLimits);
    const py = (v) => y + 3 + (h - 6) * (1 - (v - low) / (high - low));
    grid(g, { x, y, w, h }, low, high, py, about, ink);
    g.save(); g.beginPath(); g.rect(x, y, w, h); g.clip();
    const { mode, lane: on, level } = this.trigger;
    if (mode !== "off" && on === lane) {
      g.strokeStyle = ink("--warning"); g.setLineDash([6, 4]); g.beginPath();
      g.moveTo(x, py(level)); g.lineTo(x + w, py(level));
      if (view.at !== null && view.at !== undefined) { g.moveTo(px(view.at * rate), y); g.lineTo(px(view.at * rate), y + h); }
      g.stroke(); g.setLineDash([]);
    }
    if (bins) {
      // Columns of whole pixels, each down to where the next begins: much cheaper than a line.
      g.fillStyle = colour;
      let above = NaN, below = NaN;
      for (let b = 0; b < bins; b++) {
        let top = py(highest[b]), foot = py(lowest[b]);
        if (lowest[b] > highest[b]) { above = below = NaN; continue; }
        if (above > foot) foot = above;
        if (below < top) top = below;
        g.fillRect(x + b, top - 0.6, 1, foot - top + 1.2);
        above = py(highest[b]); below = py(lowest[b]);
      }
    } else {
      g.beginPath(); g.strokeStyle = colour; g.lineWidth = 1.5;
      let pen = false;
      for (let r = first; r < last; r++) {
        const v = values[r % size];
        if (Number.isNaN(v)) { pen = false; continue; }
        if (pen) g.lineTo(px(r), py(v)); else g.moveTo(px(r), py(v));
        pen = true;
      }
      g.stroke();
    }
    g.lineWidth = 1;
    g.strokeStyle = ink("--bad"); g.setLineDash([4, 4]);
    for (const r of rows.gaps) { g.beginPath(); g.moveTo(px(r), y); g.lineTo(px(r), y + h); g.stroke(); }
    g.restore();
  }

  // The cursors as text: their distance, and of each channel the difference.
  measured() {
    if (!this.cursors || !this.read) return "";
    const [a, b] = this.cursors, dt = (b - a) * this.span;
    const parts = [`Δt ${(dt * 1000).toPrecision(4)} ms${dt ? ` (${Math.abs(1 / dt).toPrecision(4)} Hz)` : ""}`];
    this.shown.forEach((column, lane) => {
      const pair = this.read[lane], c = this.channels[column];
      if (!pair || !c) return;
      const dv = pair[1] - pair[0];
      parts.push(`Δ${c.name} ${Number.isFinite(dv) ? dv.toPrecision(4) : "–"} ${pretty(c.unit)}`);
    });
    return parts.join(", ");
  }
}
