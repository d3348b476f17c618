// One diagram on a canvas: axes, curves with their bands, cursors, notes.

const TICKS = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000];
const known = (v) => v !== null && v !== undefined && Number.isFinite(v);
const short = (v) => (v === 0 ? "0" : Math.abs(v) >= 1e4 || Math.abs(v) < 1e-3 ? v.toExponential(0) : `${Number(v.toPrecision(3))}`);

// b : place in px, the diagram's inside. x, y : [low, high, step]; logarithmic : of x.
// curves : {x, y, low, high, ink, width, dash, alpha}. hatched : parts of x without a measurement.
// cursors : {name, at, points}. flags : {at, text}. Gives the maps of x and y to px.
export function diagram(g, b, { title, unit, x, y, logarithmic, curves, hatched = [], cursors = [], flags = [] }, ink) {
  const put = logarithmic ? Math.log : (v) => v;
  const px = (v) => b.x + (b.w * (put(v) - put(x[0]))) / (put(x[1]) - put(x[0]));
  const py = (v) => b.y + b.h * (1 - (v - y[0]) / (y[1] - y[0]));
  g.font = "600 13px system-ui, sans-serif"; g.textAlign = "left"; g.fillStyle = ink("--ink");
  g.fillText(title, b.x, b.y - 7);
  g.font = "12px system-ui, sans-serif"; g.fillStyle = ink("--muted"); g.lineWidth = 1;
  g.textAlign = "right"; g.fillText(unit, b.x + b.w, b.y - 7);
  const rule = (x0, y0, x1, y1, heavy) => {
    g.strokeStyle = ink(heavy ? "--muted" : "--line");
    g.beginPath(); g.moveTo(x0, y0); g.lineTo(x1, y1); g.stroke();
  };
  for (let k = Math.ceil(y[0] / y[2] - 1e-6); k * y[2] <= y[1] + y[2] / 1e6; k++) {
    const v = k * y[2], at = v;
    rule(b.x, py(v), b.x + b.w, py(v), at === 0);
    g.fillText(short(at), b.x - 5, py(v) + 4);
  }
  g.textAlign = "center";
  let right = -Infinity;
  const across = logarithmic ? TICKS : Array.from({ length: Math.floor((x[1] - x[0]) / x[2]) + 1 }, (_, k) => (Math.ceil(x[0] / x[2]) + k) * x[2]);
  for (const v of across) {
    if (v < x[0] * (logarithmic ? 0.999 : 1) - 1e-12 || v > x[1] * (logarithmic ? 1.001 : 1) + 1e-12) continue;
    const at = Math.abs(v) < 1e-12 ? 0 : v;
    rule(px(v), b.y, px(v), b.y + b.h, !logarithmic && at === 0);
    if (px(v) - right < 26) continue; // no number on another, nor where the unit has to stand
    if (logarithmic && b.x + b.w - px(v) < 18) continue;
    g.fillText(short(at), px(v), b.y + b.h + 14); right = px(v);
  }
  // The unit of the axis behind its last number.
  if (logarithmic) { g.textAlign = "left"; g.fillText("Hz", Math.max(right + 11, b.x + b.w - 14), b.y + b.h + 14); }
  g.save(); g.beginPath(); g.rect(b.x, b.y, b.w, b.h); g.clip();
  for (const [from, to] of hatched) hatch(g, Math.max(b.x, px(from)), Math.min(b.x + b.w, px(to)), b, ink);
  for (const c of curves) {
    g.globalAlpha = 0.28 * (c.alpha ?? 1); g.fillStyle = ink(c.ink);
    if (c.low && c.high) band(g, c, px, py, logarithmic);
    g.globalAlpha = c.alpha ?? 1; g.setLineDash(c.dash ?? []);
    line(g, c, px, py, logarithmic, ink(c.ink));
    g.setLineDash([]); g.globalAlpha = 1;
  }
  g.fillStyle = g.strokeStyle = ink("--ink"); g.lineWidth = 1.5; g.textAlign = "left";
  for (const { name, at, points } of cursors) {
    if (at !== null) {
      g.setLineDash([2, 3]); g.beginPath(); g.moveTo(px(at), b.y); g.lineTo(px(at), b.y + b.h); g.stroke(); g.setLineDash([]);
      g.fillText(name, px(at) + 3, b.y + 12);
    }
    for (const [u, v] of points) { g.beginPath(); g.arc(px(u), py(v), 3.5, 0, 7); g.fill(); if (at === null) g.fillText(name, px(u) + 6, py(v) - 5); }
  }
  g.fillStyle = g.strokeStyle = ink("--warning");
  flags.forEach(({ at, text }, k) => {
    g.beginPath(); g.moveTo(px(at), b.y); g.lineTo(px(at), b.y + b.h); g.stroke();
    g.fillText(text.slice(0, 24), px(at) + 3, b.y + b.h - 6 - 13 * (k % 3));
  });
  g.restore();
  g.strokeStyle = ink("--muted"); g.lineWidth = 1; g.strokeRect(b.x, b.y, b.w, b.h);
  return { px, py };
}

function hatch(g, a, e, b, ink) {
  if (e - a < 4) return;
  g.save(); g.beginPath(); g.rect(a, b.y, e - a, b.h); g.clip();
  g.strokeStyle = ink("--line"); g.lineWidth = 2;
  for (let x = a - b.h; x < e; x += 12) {
    g.beginPath(); g.moveTo(x, b.y + b.h); g.lineTo(x + b.h, b.y); g.stroke();
  }
  if (e - a > 110) {
    g.fillStyle = ink("--muted"); g.textAlign = "center"; g.font = "12px system-ui, sans-serif";
    g.fillText("not yet measured", (a + e) / 2, b.y + b.h - 8);
  }
  g.restore();
}

function line(g, c, px, py, positive, colour) {
  g.beginPath(); g.strokeStyle = colour; g.lineWidth = c.width ?? 1.5;
  let pen = false;
  c.x.forEach((x, k) => {
    if (!known(c.y[k]) || !known(x) || (positive && x <= 0)) { pen = false; return; }
    if (pen) g.lineTo(px(x), py(c.y[k])); else g.moveTo(px(x), py(c.y[k]));
    pen = true;
  });
  g.stroke();
}

function band(g, c, px, py, positive) {
  const at = c.x.map((_, k) => k).filter((k) => known(c.low[k]) && known(c.high[k]) && (!positive || c.x[k] > 0));
  if (at.length < 2) return;
  g.beginPath();
  for (const k of at) g.lineTo(px(c.x[k]), py(c.high[k]));
  for (const k of at.reverse()) g.lineTo(px(c.x[k]), py(c.low[k]));
  g.closePath(); g.fill();
}
