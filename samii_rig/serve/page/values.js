// A response's values as each view shows them, with their 90 % bands.

const FAINT = 0.1; // of a gain, which stands for "may be nothing" on a logarithmic axis
const PART = 1.645 / Math.SQRT2; // of sd = sqrt(E|dH|^2): half a 90 % interval of one part
const DEGREES = 180 / Math.PI;

// name : for a person. unit : of the axis. whole : ticks are multiples of it.
export const VIEWS = {
  db: { name: "gain, dB", unit: (u) => `dB re 1 ${u}`, whole: 20 },
  gain: { name: "gain, linear", unit: (u) => u },
  phase: { name: "phase", unit: () => "degrees", whole: 90 },
  real: { name: "real part", unit: (u) => u },
  imag: { name: "imaginary part", unit: (u) => u },
  nyquist: { name: "Nyquist", unit: (u) => u },
  coherence: { name: "coherence", unit: () => "", from: 0, to: 1 },
};

const decibel = (g) => (g > 0 ? 20 * Math.log10(g) : null);
const known = (v) => v !== null && v !== undefined && Number.isFinite(v);
const each = (a, b, what) => a.map((v, k) => (known(v) && known(b[k]) ? what(v, b[k]) : null));

// A response as a recording has it (real and imaginary part, sd) in the form of a run's so far.
export function fromParts({ re, im, sd, ...more }) {
  const gain = each(re, im, Math.hypot);
  let turns = 0, before = null;
  const phase = each(re, im, (x, y) => {
    const p = DEGREES * Math.atan2(y, x);
    if (before !== null) turns -= 360 * Math.round((p - before) / 360);
    before = p;
    return p + turns;
  });
  return { ...more, gain, phase,
    low: each(gain, sd, (g, s) => Math.max(0, g - PART * s)), high: each(gain, sd, (g, s) => g + PART * s),
    half: each(gain, sd, (g, s) => (PART * s < g ? DEGREES * Math.asin((PART * s) / g) : 180)) };
}

// What is drawn of a curve: y, and the ends low and high of its band where there is one.
export function shown(curve, view) {
  const { gain, phase, low, high, half } = curve;
  const around = (y, r) => ({ y, low: r && each(y, r, (v, d) => v - d), high: r && each(y, r, (v, d) => v + d) });
  const radius = low && high && each(high, low, (h, l) => (h - l) / 2);
  switch (view) {
    case "db": return { y: gain.map(decibel), low: low && low.map((g, k) => decibel(Math.max(g ?? 0, FAINT * gain[k]))), high: high && high.map(decibel) };
    case "gain": return { y: gain, low, high };
    case "phase": return around(phase, half);
    case "real": return around(each(gain, phase, (g, p) => g * Math.cos(p / DEGREES)), radius);
    case "imag": return around(each(gain, phase, (g, p) => g * Math.sin(p / DEGREES)), radius);
    default: return { y: curve.coherence ?? gain.map(() => null) };
  }
}

// By whole turns next to another curve: a phase begins anywhere.
export function turned(lane, f, other, fo) {
  const at = (x) => { let k = 0; while (k < fo.length - 1 && fo[k] < x) k++; return other[k]; };
  const apart = f.map((x, k) => (known(lane.y[k]) && known(at(x)) ? at(x) - lane.y[k] : NaN)).filter(Number.isFinite).sort((a, b) => a - b);
  const turns = 360 * Math.round((apart[apart.length >> 1] ?? 0) / 360);
  const moved = (v) => (known(v) ? v + turns : null);
  return { y: lane.y.map(moved), low: lane.low && lane.low.map(moved), high: lane.high && lane.high.map(moved) };
}

// The line of a response that is nearest to a frequency, -1 where none is near.
export function nearest(f, hz) {
  let best = -1;
  f.forEach((x, k) => { if (x > 0 && (best < 0 || Math.abs(Math.log(x / hz)) < Math.abs(Math.log(f[best] / hz)))) best = k; });
  return best >= 0 && Math.abs(Math.log(f[best] / hz)) < 0.1 ? best : -1;
}

// From the smallest to the largest value that is drawn, in round steps: [low, high, step].
export function spanned(values, { whole, from, to }) {
  if (from !== undefined) return [from, to, 0.25];
  const seen = values.filter(known);
  let low = Math.min(...seen), high = Math.max(...seen);
  if (!(high >= low)) [low, high] = [0, 1];
  if (high === low) { low -= Math.abs(low) / 10 || 1; high += Math.abs(high) / 10 || 1; }
  const power = 10 ** Math.floor(Math.log10((high - low) / 4));
  let step = [1, 2, 5, 10].map((m) => m * power).find((s) => (high - low) / s <= 5);
  if (whole) step = whole * Math.max(1, Math.ceil((high - low) / whole / 5)); // 20 dB, quarter turns
  return [Math.floor(low / step) * step, Math.ceil(high / step) * step, step];
}
