// The frequency responses of a run while it goes on: gain or phase over frequency with the 90 %
// band, the rig file's model over it. What is not measured yet is hatched, and says so.

const TICKS = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000];
const FAINT = 0.1; // of a gain, which stands for "may be nothing" on a logarithmic axis

const decibel = (g) => (g > 0 ? 20 * Math.log10(g) : null);

// The values of a lane: middle, low and high end of its band, in dB or degrees.
function drawn(curve, show) {
  if (show === "phase") {
    return {
      y: curve.phase,
      low: curve.half ? curve.phase.map((p, k) => p - curve.half[k]) : null,
      high: curve.half ? curve.phase.map((p, k) => p + curve.half[k]) : null,
    };
  }
  return {
    y: curve.gain.map(decibel),
    low: curve.low ? curve.low.map((g, k) => decibel(Math.max(g ?? 0, FAINT * curve.gain[k]))) : null,
    high: curve.high ? curve.high.map(decibel) : null,
  };
}

// By whole turns next to the model: a phase begins anywhere.
function turned(lane, model, f, fm) {
  const at = (x) => { let k = 0; while (k < fm.length - 1 && fm[k] < x) k++; return model.y[k]; };
  const apart = f.map((x, k) => at(x) - lane.y[k]).filter(Number.isFinite).sort((a, b) => a - b);
  const turns = 360 * Math.round((apart[apart.length >> 1] ?? 0) / 360);
  for (const key of ["y", "low", "high"]) lane[key] = lane[key] && lane[key].map((v) => v + turns);
  return lane;
}

export function plotResponses(canvas, data, chosen, show) {
  const ratio = window.devicePixelRatio || 1, w = canvas.clientWidth;
  const wide = w > 900 ? 2 : 1, rows = Math.ceil(data.model.curves.length / wide);
  canvas.style.height = `${rows * 190}px`;
  const h = canvas.clientHeight;
  canvas.width = Math.round(w * ratio); canvas.height = Math.round(h * ratio);
  const g = canvas.getContext("2d"), style = getComputedStyle(document.documentElement);
  const ink = (name) => style.getPropertyValue(name).trim();
  g.setTransform(ratio, 0, 0, ratio, 0, 0);
  g.lineJoin = "round";
  data.model.curves.forEach((m, i) => {
    const box = { x: (i % wide) * (w / wide) + 62, y: Math.floor(i / wide) * 190 + 24, w: w / wide - 74, h: 140 };
    lane(g, data, m, chosen, show, box, ink);
  });
}

function lane(g, data, modelCurve, chosen, show, b, ink) {
  const model = drawn(modelCurve, show), fm = data.model.frequency;
  const shown = data.responses.map((r) => {
    const curve = r.curves.find((c) => c.output === modelCurve.output && c.input === data.model.input);
    if (!curve) return null;
    const d = drawn(curve, show);
    return { ...(show === "phase" ? turned(d, model, r.frequency, fm) : d), f: r.frequency, r };
  });
  const main = shown[chosen] || null;
  const values = [model.y, ...shown.filter(Boolean).map((s) => s.y)].flat().filter((v) => v !== null && Number.isFinite(v));
  const step = show === "phase" ? 180 : 20;
  let low = Math.floor(Math.min(...values) / step) * step, high = Math.ceil(Math.max(...values) / step) * step;
  if (high === low) high += step;
  const x0 = Math.log(Math.max(data.low_hz, data.high_hz * 1e-3)), x1 = Math.log(data.high_hz);
  const px = (f) => b.x + (b.w * (Math.log(f) - x0)) / (x1 - x0);
  const py = (v) => b.y + b.h * (1 - (v - low) / (high - low));
  g.font = "600 13px system-ui, sans-serif"; g.textAlign = "left"; g.fillStyle = ink("--ink");
  g.fillText(`${modelCurve.output} / ${data.model.input}`, b.x, b.y - 8);
  g.font = "12px system-ui, sans-serif"; g.fillStyle = ink("--muted"); g.strokeStyle = ink("--line"); g.lineWidth = 1;
  g.textAlign = "right";
  g.fillText(show === "phase" ? "degrees" : `dB re 1 ${modelCurve.unit.replace("^2", "²")}`, b.x + b.w, b.y - 8);
  const every = Math.max(1, Math.ceil((high - low) / step / 5)) * step;
  for (let v = low; v <= high + 1e-9; v += every) {
    g.beginPath(); g.moveTo(b.x, py(v)); g.lineTo(b.x + b.w, py(v)); g.stroke();
    g.fillText(`${v}`, b.x - 6, py(v) + 4);
  }
  g.textAlign = "center";
  for (const f of TICKS) {
    if (Math.log(f) < x0 || Math.log(f) > x1) continue;
    g.beginPath(); g.moveTo(px(f), b.y); g.lineTo(px(f), b.y + b.h); g.stroke();
    g.fillText(`${f}`, px(f), b.y + b.h + 15);
  }
  g.save(); g.beginPath(); g.rect(b.x, b.y, b.w, b.h); g.clip();
  const from = main ? [b.x, px(main.f[0])] : [b.x, b.x + b.w];
  for (const [a, e] of main ? [from, [px(main.f.at(-1)), b.x + b.w]] : [from]) hatch(g, a, e, b, ink);
  shown.forEach((s, k) => {
    if (!s || k === chosen) return;
    g.globalAlpha = 0.4; line(g, s.f, s.y, px, py, ink("--c0"), 1); g.globalAlpha = 1;
  });
  if (main) {
    g.globalAlpha = 0.28; g.fillStyle = ink("--c0");
    band(g, main, px, py); g.globalAlpha = 1;
    line(g, main.f, main.y, px, py, ink("--c0"), 1.6);
  }
  g.setLineDash([6, 4]); line(g, fm, model.y, px, py, ink("--c1"), 1.4); g.setLineDash([]);
  g.restore();
  g.strokeStyle = ink("--muted"); g.strokeRect(b.x, b.y, b.w, b.h);
}

function hatch(g, a, e, b, ink) {
  if (e - a < 4) return;
  g.save(); g.beginPath(); g.rect(a, b.y, e - a, b.h); g.clip();
  g.strokeStyle = ink("--line"); g.lineWidth = 2;
  for (let x = a - b.h; x < e; x += 12) {
    g.beginPath(); g.moveTo(x, b.y + b.h); g.lineTo(x + b.h, b.y); g.stroke();
  }
  if (e - a > 120) {
    g.fillStyle = ink("--muted"); g.textAlign = "center"; g.font = "12px system-ui, sans-serif";
    g.fillText("not yet measured", (a + e) / 2, b.y + b.h - 8);
  }
  g.restore();
}

function line(g, f, y, px, py, colour, width) {
  g.beginPath(); g.strokeStyle = colour; g.lineWidth = width;
  let pen = false;
  f.forEach((x, k) => {
    if (y[k] === null || !Number.isFinite(y[k]) || x <= 0) { pen = false; return; }
    if (pen) g.lineTo(px(x), py(y[k])); else g.moveTo(px(x), py(y[k]));
    pen = true;
  });
  g.stroke();
}

function band(g, s, px, py) {
  const at = s.f.map((_, k) => k).filter((k) => Number.isFinite(s.low[k]) && Number.isFinite(s.high[k]) && s.low[k] !== null && s.high[k] !== null);
  if (at.length < 2) return;
  g.beginPath();
  for (const k of at) g.lineTo(px(s.f[k]), py(s.high[k]));
  for (const k of at.reverse()) g.lineTo(px(s.f[k]), py(s.low[k]));
  g.closePath(); g.fill();
}
