"use strict";
(() => {
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
  // A fresh copy of a description with the scheme's colours in it: plotly changes what it is given.
  const coloured = (node, scheme) => {
    if (typeof node === "string") return node.startsWith("@") ? colour(scheme, node) : node;
    if (Array.isArray(node)) return node.map((item) => coloured(item, scheme));
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
    figure: JSON.parse(document.getElementById(div.dataset.figure).textContent),
    select: document.getElementById(div.dataset.select || ""),
  }));
  const draw = ({ div, figure, select }) => {
    const scheme = query.matches ? schemes.dark : schemes.light;
    const data = select ? figure.sets[select.selectedIndex].data : figure.data;
    return Plotly.react(div, coloured(data, scheme), coloured(figure.layout, scheme), config);
  };
  // The ticks written out suit the whole band; a closer look takes plotly's own.
  const ticks = ({ div, figure }) => {
    const axes = Object.keys(figure.layout).filter((k) => figure.layout[k].tickmode === "array");
    div.on("plotly_relayout", (change) => {
      const update = {};
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
    const { select, div } = plot;
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
})();
