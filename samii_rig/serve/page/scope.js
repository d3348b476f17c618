// The live scope: the newest seconds of up to four channels. Missing samples are gaps, and a
// connection that is lost covers the picture: what is old never looks as if it were live.

const HEAD = 32; // bytes before a frame's values, see viewers.py
const KEPT = 24; // s
const EASE = 0.12; // of what is missing, a frame: blocks come four times a second

function extremes(values, n, columns) {
  const low = new Array(columns).fill(Infinity), high = new Array(columns).fill(-Infinity);
  for (let i = 0; i < n; i++) {
    for (let c = 0; c < columns; c++) {
      const v = values[i * columns + c];
      if (v < low[c]) low[c] = v;
      if (v > high[c]) high[c] = v;
    }
  }
  return { low, high };
}

export class Scope {
  constructor(canvas) {
    this.canvas = canvas;
    this.channels = [];
    this.shown = [];
    this.span = 5;
    this.paused = false;
    this.live = false;
    this.why = "";
    this.clear();
    const draw = () => { this.draw(); requestAnimationFrame(draw); };
    requestAnimationFrame(draw);
  }

  clear() { this.rows = []; this.next = null; this.edge = null; this.lost = 0; }

  take(buffer) {
    const view = new DataView(buffer);
    if (view.getUint8(0) !== 1) return;
    const columns = view.getUint16(2, true), n = view.getUint32(4, true);
    const step = view.getUint32(8, true);
    this.lost = view.getUint32(12, true);
    const rate = view.getFloat64(16, true), first = Number(view.getBigInt64(24, true));
    if (columns !== this.channels.length) return;
    const values = new Float32Array(buffer, HEAD);
    const samples = step === 1 ? n : (n / 2) * step;
    if (this.next !== null && first < this.next) this.clear();
    const t0 = first * (samples ? n / samples / rate : 0);
    const gap = this.next !== null && first !== this.next;
    this.rows.push({ t0, dt: 1 / rate, n, values, gap, ...extremes(values, n, columns) });
    this.next = first + samples;
    const end = t0 + n / rate;
    while (this.rows.length && this.rows[0].t0 + this.rows[0].n * this.rows[0].dt < end - KEPT) {
      this.rows.shift();
    }
  }

  draw() {
    const c = this.canvas, ratio = window.devicePixelRatio || 1;
    const w = c.clientWidth, h = c.clientHeight;
    if (c.width !== Math.round(w * ratio) || c.height !== Math.round(h * ratio)) {
      c.width = Math.round(w * ratio); c.height = Math.round(h * ratio);
    } else if (this.paused) return;
    const g = c.getContext("2d");
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.clearRect(0, 0, w, h);
    const style = getComputedStyle(document.documentElement);
    const ink = (name) => style.getPropertyValue(name).trim();
    const last = this.rows.at(-1);
    const end = last ? last.t0 + last.n * last.dt : 0;
    if (this.edge === null || Math.abs(end - this.edge) > 2) this.edge = end;
    if (!this.paused) this.edge += EASE * (end - this.edge);
    const lanes = this.shown.length || 1, left = 76, tall = (h - 22) / lanes;
    g.font = "13px system-ui, sans-serif"; g.lineJoin = "round";
    this.shown.forEach((column, lane) => {
      this.lane(g, column, lane, left, 4 + lane * tall, w - left - 8, tall - 8, ink);
    });
    g.fillStyle = ink("--muted"); g.textAlign = "left";
    g.fillText(`−${this.span} s`, left, h - 4);
    g.textAlign = "right"; g.fillText("now", w - 8, h - 4);
    if (this.why) {
      g.fillStyle = ink("--panel"); g.globalAlpha = 0.8; g.fillRect(left, 0, w, h - 20);
      g.globalAlpha = 1; g.fillStyle = ink(this.live ? "--muted" : "--bad");
      g.font = "600 18px system-ui, sans-serif"; g.textAlign = "center";
      g.fillText(this.why, left + (w - left) / 2, h / 2);
    }
  }

  lane(g, column, lane, x, y, w, h, ink) {
    const from = this.edge - this.span, columns = this.channels.length;
    let low = Infinity, high = -Infinity;
    for (const r of this.rows) {
      if (r.t0 + r.n * r.dt < from) continue;
      low = Math.min(low, r.low[column]);
      high = Math.max(high, r.high[column]);
    }
    g.strokeStyle = ink("--line"); g.lineWidth = 1; g.strokeRect(x, y, w, h);
    const channel = this.channels[column], colour = ink(`--c${lane}`);
    g.textAlign = "right"; g.fillStyle = colour;
    g.fillText(channel ? channel.name : "", x - 8, y + 14);
    g.fillStyle = ink("--muted");
    g.fillText(channel ? channel.unit.replace("^2", "²") : "", x - 8, y + 30);
    if (!(high >= low)) return;
    if (high === low) { high += 1e-6 + Math.abs(high) * 0.01; low -= 1e-6 + Math.abs(low) * 0.01; }
    if (h > 64) {
      g.fillText(high.toPrecision(2), x - 8, y + 48);
      g.fillText(low.toPrecision(2), x - 8, y + h - 2);
    }
    const px = (t) => x + (w * (t - from)) / this.span;
    const py = (v) => y + 3 + (h - 6) * (1 - (v - low) / (high - low));
    g.save(); g.beginPath(); g.rect(x, y, w, h); g.clip();
    g.beginPath(); g.strokeStyle = colour; g.lineWidth = 1.5;
    const gaps = [];
    let pen = false;
    for (const r of this.rows) {
      if (r.t0 + r.n * r.dt < from) { pen = false; continue; }
      if (r.gap) { pen = false; gaps.push(r.t0); }
      for (let i = 0; i < r.n; i++) {
        const v = r.values[i * columns + column];
        if (Number.isNaN(v)) { pen = false; continue; }
        const at = px(r.t0 + i * r.dt);
        if (pen) g.lineTo(at, py(v)); else g.moveTo(at, py(v));
        pen = true;
      }
    }
    g.stroke();
    g.strokeStyle = ink("--bad"); g.setLineDash([4, 4]);
    for (const t of gaps) { g.beginPath(); g.moveTo(px(t), y); g.lineTo(px(t), y + h); g.stroke(); }
    g.restore();
  }
}
