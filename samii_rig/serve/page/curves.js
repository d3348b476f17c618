// Recorded curves on a canvas: channels over time, frequency responses in dB.

import { pretty } from "/page/units.js";

export function plot(canvas, lanes, { logarithmic = false, unit = "s" } = {}) {
  const ratio = window.devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
  canvas.width = Math.round(w * ratio); canvas.height = Math.round(h * ratio);
  const g = canvas.getContext("2d"), style = getComputedStyle(document.documentElement);
  const ink = (name) => style.getPropertyValue(name).trim();
  g.setTransform(ratio, 0, 0, ratio, 0, 0);
  g.font = "13px system-ui, sans-serif";
  const left = 92, tall = (h - 22) / Math.max(1, lanes.length);
  const all = lanes.flatMap((l) => l.x).filter((x) => !logarithmic || x > 0);
  const put = logarithmic ? Math.log10 : (x) => x;
  const from = put(Math.min(...all)), to = put(Math.max(...all));
  lanes.forEach((lane, i) => {
    const y0 = 4 + i * tall, tallest = tall - 8, width = w - left - 8;
    const ys = lane.y.filter((v) => v !== null);
    const low = Math.min(...ys), high = Math.max(...ys), size = high - low || 1;
    g.strokeStyle = ink("--line"); g.lineWidth = 1; g.strokeRect(left, y0, width, tallest);
    g.textAlign = "right"; g.fillStyle = ink(`--c${i % 4}`);
    g.fillText(lane.name, left - 8, y0 + 14);
    if (ys.length && tall > 44) {
      g.fillStyle = ink("--muted");
      g.fillText(`${high.toPrecision(2)} ${pretty(lane.unit)}`, left - 8, y0 + 30);
      g.fillText(low.toPrecision(2), left - 8, y0 + tallest - 2);
    }
    g.beginPath(); g.strokeStyle = ink(`--c${i % 4}`); g.lineWidth = 1.3;
    let pen = false;
    lane.x.forEach((x, k) => {
      if (lane.y[k] === null || (logarithmic && x <= 0)) { pen = false; return; }
      const px = left + (width * (put(x) - from)) / (to - from || 1);
      const py = y0 + 3 + (tallest - 6) * (1 - (lane.y[k] - low) / size);
      if (pen) g.lineTo(px, py); else g.moveTo(px, py);
      pen = true;
    });
    g.stroke();
  });
  if (!all.length) return;
  const back = (v) => (logarithmic ? 10 ** v : v).toPrecision(3);
  g.fillStyle = ink("--muted"); g.textAlign = "left";
  g.fillText(`${back(from)} ${unit}`, left, h - 4);
  g.textAlign = "right"; g.fillText(`${back(to)} ${unit}`, w - 8, h - 4);
}
