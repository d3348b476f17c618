// What stands behind the scope's curves: a grid in round steps, the zero, the limits.

const BITS = 20; // steps of the converter: a lane shows at least so many, or its noise would fill it
const ACROSS = 10; // divisions of the time
const APART = 22; // px between lines, at least
const ROOM = 1.06; // of a limit that is to be seen

export const short = (v) => (v === 0 ? "0" : Math.abs(v) >= 1e4 || Math.abs(v) < 1e-3 ? v.toExponential(1) : `${Number(v.toPrecision(3))}`);

// The values between which a lane is drawn. about : resolution and limit of its channel, if known.
export function range(low, high, about, toLimits) {
  if (toLimits && about?.limit) return [-ROOM * about.limit, ROOM * about.limit];
  const least = about?.resolution ? BITS * about.resolution : 1e-6 + Math.abs(high) * 0.01;
  if (high - low < least) {
    const middle = (high + low) / 2;
    return [middle - least / 2, middle + least / 2];
  }
  return [low, high];
}

function step(low, high, most) {
  const power = 10 ** Math.floor(Math.log10((high - low) / most));
  return [1, 2, 5, 10].map((m) => m * power).find((s) => (high - low) / s <= most);
}

// b : place in px. py : from a value to px.
export function grid(g, b, low, high, py, about, ink) {
  const every = step(low, high, Math.max(2, Math.floor(b.h / APART)));
  g.lineWidth = 1; g.textAlign = "right"; g.fillStyle = ink("--muted"); g.strokeStyle = ink("--line");
  g.beginPath();
  for (let k = 1; k < ACROSS; k++) { const x = b.x + (b.w * k) / ACROSS; g.moveTo(x, b.y); g.lineTo(x, b.y + b.h); }
  for (let k = Math.ceil(low / every); k * every <= high; k++) { g.moveTo(b.x, py(k * every)); g.lineTo(b.x + b.w, py(k * every)); }
  g.stroke();
  let last = Infinity;
  for (let k = Math.ceil(low / every); k * every <= high; k++) {
    const y = py(k * every);
    if (last - y < 13) continue; // no number on another
    g.fillText(short(k * every), b.x - 6, Math.min(Math.max(y + 4, b.y + 10), b.y + b.h)); last = y;
  }
  const across = (v, colour, dash) => {
    if (v < low || v > high) return;
    g.strokeStyle = ink(colour); g.setLineDash(dash);
    g.beginPath(); g.moveTo(b.x, py(v)); g.lineTo(b.x + b.w, py(v)); g.stroke(); g.setLineDash([]);
  };
  across(0, "--muted", []);
  if (!about?.limit) return;
  g.lineWidth = 2;
  across(about.limit, "--bad", [10, 4]); across(-about.limit, "--bad", [10, 4]);
  g.lineWidth = 1;
}
