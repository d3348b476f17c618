// The rig as it moves: to scale along the chain, displacements exaggerated by the factor that is
// written on it. Accelerations are integrated twice here, slowly forgetting; see motion.py.

const FORGET = 2 * Math.PI * 0.2; // rad/s; slower motion is not drawn
const KEPT = 3000; // samples
const FACTORS = [1, 2, 5];
const ROOM = 0.38; // of the height, for the largest displacement
const HOLD = 0.995; // a frame, of the largest displacement seen
const SMALL = 420; // px, too narrow for words
const STALE = 1.0; // s without a sample

// s/(s + c)^3: the double integral of an acceleration without its offset.
export class Integrator {
  constructor() { this.reset(); }
  reset() { this.before = null; this.fast = this.v = this.x = 0; }
  next(a, dt) {
    const keep = Math.exp(-FORGET * dt);
    if (this.before === null) this.before = a;
    this.fast = keep * (this.fast + a - this.before);
    this.before = a;
    this.v = keep * this.v + dt * this.fast;
    this.x = keep * this.x + dt * this.v;
    return this.x;
  }
}

export class Motion {
  constructor(canvas, scope, said) {
    Object.assign(this, { canvas, scope, said, about: null, hz: null, text: "" });
    this.clear();
    const draw = () => { this.draw(); requestAnimationFrame(draw); };
    requestAnimationFrame(draw);
  }

  // about : as GET /api/rig gives it, null for a rig that is not drawn so.
  rig(about) { this.about = about; this.canvas.hidden = !about; this.clear(); }

  clear() {
    this.times = []; this.y = []; this.next = null; this.peak = 0; this.factor = 0; this.arrived = 0; this.held = null;
    this.integrators = this.about ? this.about.sensors.map(() => new Integrator()) : [];
  }

  take(frame, channels) {
    if (!this.about) return;
    const columns = this.about.sensors.map((name) => channels.findIndex((c) => c.name === name));
    if (columns.includes(-1)) return;
    if (this.next !== null && Math.abs(frame.t0 - this.next) > frame.dt) this.clear();
    const pair = frame.step > 1 ? 2 : 1, dt = frame.dt * pair;
    for (let i = 0; i + pair <= frame.n; i += pair) {
      const y = columns.map((c, k) => {
        let v = frame.values[i * channels.length + c];
        if (pair === 2) v = (v + frame.values[(i + 1) * channels.length + c]) / 2;
        if (!Number.isFinite(v)) return NaN;
        return this.about.accelerations[k] ? this.integrators[k].next(v, dt) : v;
      });
      if (y.some(Number.isNaN)) continue; // what a sensor does not say is not drawn
      this.times.push(frame.t0 + i * frame.dt); this.y.push(y);
      this.arrived = performance.now();
    }
    this.next = frame.t0 + frame.n * frame.dt;
    const over = this.times.length - KEPT;
    if (over > KEPT) { this.times.splice(0, over); this.y.splice(0, over); }
  }

  // The displacements at the time that the scope shows as now.
  now() {
    const edge = this.scope.edge;
    let low = 0, high = this.times.length - 1;
    while (low < high) { const m = (low + high + 1) >> 1; if (this.times[m] <= edge) low = m; else high = m - 1; }
    const { hz, matrix } = this.about, y = this.y[low];
    let k = 0;
    if (this.hz) for (let i = 1; i < hz.length; i++) if (!k || Math.abs(Math.log(hz[i] / this.hz)) < Math.abs(Math.log(hz[k] / this.hz))) k = i;
    return { w: matrix[k].map((row) => row.reduce((sum, m, j) => sum + m * y[j], 0)), y };
  }

  stale() {
    if (!this.scope.live) return "not live";
    if (this.over || !this.y.length) return "no run";
    const old = (performance.now() - this.arrived) / 1000;
    return old > STALE ? `stale: no sample for ${Math.round(old)} s` : "";
  }

  draw() {
    const c = this.canvas, about = this.about;
    if (!about || c.hidden) return;
    const ratio = window.devicePixelRatio || 1, w = c.clientWidth, h = c.clientHeight;
    if (c.width !== Math.round(w * ratio)) { c.width = Math.round(w * ratio); c.height = Math.round(h * ratio); }
    const g = c.getContext("2d"), ink = this.scope.ink;
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.clearRect(0, 0, w, h);
    const paused = this.scope.paused;
    if (!paused) this.held = this.y.length ? this.now() : null;
    const stale = paused ? "" : this.stale(), there = this.held;
    const d = there && !stale ? there.w : about.x.map(() => 0);
    const largest = Math.max(...d.map(Math.abs));
    this.peak = Math.max(largest, this.peak * HOLD);
    if (this.peak > 0 && !stale) this.choose(ROOM * h, w);
    const left = 24, px = (w - 48) / about.x.at(-1), mid = h / 2, up = this.factor * px;
    const at = about.x.map((x, i) => [left + px * x, mid - up * d[i]]);
    g.strokeStyle = ink("--line"); g.setLineDash([4, 5]); g.lineWidth = 1;
    g.beginPath(); g.moveTo(left, mid); g.lineTo(left + px * about.x.at(-1), mid); g.stroke(); g.setLineDash([]);
    g.globalAlpha = stale ? 0.35 : 1;
    g.lineCap = "round"; g.lineJoin = "round";
    for (let i = 1; i < at.length; i++) {
      if (at[i][0] === at[i - 1][0]) continue;
      const beam = about.kind[i].includes("beam");
      g.strokeStyle = ink(beam ? "--muted" : "--ink"); g.lineWidth = beam ? 5 : 9;
      g.beginPath(); g.moveTo(...at[i - 1]); g.lineTo(...at[i]); g.stroke();
    }
    about.kind.forEach((kind, i) => {
      if (!kind.includes("spring") && !kind.includes("source")) return;
      g.fillStyle = ink("--panel"); g.strokeStyle = ink(kind.includes("source") ? "--warning" : "--accent"); g.lineWidth = 3;
      g.beginPath(); g.arc(...at[i], 6, 0, 7); g.fill(); g.stroke();
    });
    g.globalAlpha = 1;
    const angles = there && !stale ? about.sensors.map((name, k) => (about.accelerations[k] ? "" : `${name} ${this.milli(there.y[k])}`)).filter(Boolean).join(", ") : "";
    const text = stale ? `Not moving: ${stale}.` : `${paused ? "Paused. " : ""}${w < SMALL ? "" : "Displacements "}× ${this.factor}${w < SMALL ? "" : `. ${angles}`}`;
    g.font = "600 14px system-ui, sans-serif"; g.textAlign = "left"; g.fillStyle = ink(stale && stale !== "no run" ? "--bad" : "--muted");
    g.fillText(text, 4, 18);
    // To who does not see it, when it changes and not at every frame.
    const plain = stale || paused ? text : `The rig moves, displacements drawn ${this.factor} times as large.`;
    if (plain !== this.text) { this.text = plain; this.said(plain); }
  }

  milli(angle) { return `${(1000 * angle).toFixed(2)} mrad`; }

  // A factor of 1, 2, 5, 10 ... by which the largest displacement fills the room, changed seldom.
  choose(room, w) {
    const px = (w - 48) / this.about.x.at(-1), fits = room / (px * this.peak);
    if (this.factor && this.factor <= fits && this.factor > fits / 4) return;
    const power = 10 ** Math.floor(Math.log10(fits));
    this.factor = Math.max(1, ...FACTORS.map((f) => f * power).filter((f) => f <= fits));
    if (this.factor > 2) this.factor = Math.round(this.factor);
  }
}
