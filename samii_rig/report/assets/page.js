"use strict";
const page = (() => {
  const schemes = {
    light: {
      ink: "#16191d", muted: "#7b8590", grid: "#e3e7ec", panel: "#ffffff", bad: "#b3261e",
      differs: "rgba(179,38,30,0.07)",
      level: ["#0b6bcb", "#c2571a", "#1a8a5a", "#8b4bb0", "#8f7300", "#3f7f90"],
    },
    dark: {
      ink: "#eceff2", muted: "#8d98a3", grid: "#30373e", panel: "#1d2125", bad: "#ff8a80",
      differs: "rgba(255,138,128,0.10)",
      level: ["#5aa9f0", "#f0935a", "#4cc38a", "#c58be8", "#d9be4a", "#86c1d2"],
    },
  };
  const query = window.matchMedia("(prefers-color-scheme: dark)");

  const colour = (scheme, token) => {
    const level = /^@level(\d+)(soft)?$/.exec(token);
    if (!level) return scheme[token.slice(1)];
    return scheme.level[Number(level[1])] + (level[2] ? "38" : "");
  };
  // Arrays come as 16 bit steps of their range, see canvas.py; a shape makes rows of them.
  const restored = ({ q, from, to, log, shape }) => {
    const bytes = Uint8Array.from(atob(q), (c) => c.charCodeAt(0));
    const values = Float32Array.from(new Uint16Array(bytes.buffer), (step) => {
      const v = from + (step / 65534) * (to - from);
      return step === 65535 ? NaN : log ? Math.exp(v) : v;
    });
    if (!shape) return values;
    const [rows, columns] = shape.split(",").map(Number);
    return Array.from({ length: rows }, (_, r) => values.subarray(r * columns, (r + 1) * columns));
  };
  const unpacked = (node) => {
    if (Array.isArray(node)) return node.map(unpacked);
    if (!node || typeof node !== "object") return node;
    if (typeof node.q === "string") return restored(node);
    return Object.fromEntries(Object.entries(node).map(([k, v]) => [k, unpacked(v)]));
  };
  // A fresh copy of a description with the scheme's colours in it: plotly changes what it is given.
  const coloured = (node, scheme) => {
    if (typeof node === "string") return node.startsWith("@") ? colour(scheme, node) : node;
    if (Array.isArray(node)) return node.map((item) => coloured(item, scheme));
    if (ArrayBuffer.isView(node)) return node;
    if (node && typeof node === "object") {
      return Object.fromEntries(Object.entries(node).map(([k, v]) => [k, coloured(v, scheme)]));
    }
    return node;
  };

  const config = {
    responsive: true, displaylogo: false,
    modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"],
  };
  const plots = [...document.querySelectorAll(".plot")].map((div) => ({
    div,
    figure: unpacked(JSON.parse(document.getElementById(div.dataset.figure).textContent)),
    select: document.getElementById(div.dataset.select || ""),
    view: document.getElementById((div.dataset.select || "").replace("select-", "view-")),
    decibels: document.getElementById((div.dataset.select || "").replace("select-", "decibels-")),
  }));
  // The set that the switches choose; its views stand one after the other.
  const chosen = ({ figure, select, view, decibels }) => {
    if (!select) return figure;
    const views = view ? view.options.length : 1;
    const set = figure.sets[select.selectedIndex * views + (view ? view.selectedIndex : 0)];
    const found = { data: set.data, layout: set.layout || figure.layout };
    return decibels && decibels.checked ? inDecibels(found) : found;
  };
  // The first panel, a gain on a logarithmic axis, as 20 log10 of it.
  const dB = (v) => 20 * Math.log10(v);
  const inDecibels = ({ data, layout }) => {
    const { range, title, tickvals, ticktext, minor, ...axis } = layout.yaxis;
    const said = title.text.includes("[") ? title.text.replace("[", "[dB re 1 ") : `${title.text} [dB]`;
    const first = (o, ref) => !o[ref] || o[ref] === "y";
    return {
      data: data.map((t) => (!first(t, "yaxis") ? t
        : { ...t, y: Float32Array.from(t.y, dB), ...(t.hovertemplate ? { hovertemplate: "%{y:.2f} dB" } : {}) })),
      layout: {
        ...layout,
        yaxis: { ...axis, type: "linear", tickmode: "auto", exponentformat: "none", range: range && range.map((v) => 20 * v), title: { ...title, text: said } },
        annotations: (layout.annotations || []).map((a) => (first(a, "yref") ? { ...a, y: 20 * a.y } : a)),
        shapes: (layout.shapes || []).map((s) => (first(s, "yref") ? { ...s, y0: dB(s.y0), y1: dB(s.y1) } : s)),
      },
    };
  };
  const PAPER = 640; // px: what an A4 page has between its margins
  let paper = false;
  const draw = (plot) => {
    const scheme = query.matches && !paper ? schemes.dark : schemes.light;
    const { data, layout } = chosen(plot);
    const placed = coloured(layout, scheme);
    // As tall as what it shows now.
    plot.div.style.height = `${layout.height}px`;
    if (paper) placed.width = PAPER;
    // Beside a narrow page's curves their axes are short of words.
    else if (innerWidth < 600) placed.margin = { ...placed.margin, l: 48, r: 6 };
    return Plotly.react(plot.div, coloured(data, scheme), placed, config);
  };
  // The ticks written out suit the whole band; a closer look takes plotly's own.
  const ticks = (plot) => {
    const { div } = plot;
    div.on("plotly_relayout", (change) => {
      const update = {}, { layout } = chosen(plot);
      const axes = Object.keys(layout).filter((k) => layout[k].tickmode === "array");
      for (const axis of axes) {
        if (`${axis}.range[0]` in change) update[`${axis}.tickmode`] = "auto";
        if (`${axis}.autorange` in change) update[`${axis}.tickmode`] = "array";
      }
      if (Object.keys(update).length) Plotly.relayout(div, update);
    });
  };
  for (const plot of plots) {
    draw(plot);
    ticks(plot);
    const { select, view, decibels, div } = plot;
    if (decibels) decibels.addEventListener("change", () => draw(plot));
    if (view) view.addEventListener("change", () => draw(plot));
    if (!select) continue;
    select.addEventListener("change", () => draw(plot));
    for (const button of div.parentElement.querySelectorAll("button[data-step]")) {
      button.addEventListener("click", () => {
        const n = select.options.length;
        select.selectedIndex = (select.selectedIndex + Number(button.dataset.step) + n) % n;
        draw(plot);
      });
    }
  }
  query.addEventListener("change", () => plots.forEach(draw));
  addEventListener("beforeprint", () => { paper = true; plots.forEach(draw); });
  addEventListener("afterprint", () => { paper = false; plots.forEach(draw); });
  return { plots, draw };
})();
