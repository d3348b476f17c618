// The scope's controls: channels, span, pause, trigger and cursors, all from the keyboard too.

import { remembered } from "/page/kept.js";
import { LEFT, RIGHT } from "/page/scope.js";

export function controls($, put, scope) {
  remembered($("span"), "span", () => { scope.span = Number($("span").value); scope.arm(); });
  remembered($("scale"), "scale", () => { scope.toLimits = $("scale").value === "limits"; });
  $("pause").onclick = () => {
    scope.pause(!scope.paused);
    $("pause").setAttribute("aria-pressed", scope.paused);
    $("pause").textContent = scope.paused ? "Go on" : "Pause";
  };
  const trigger = () => {
    const mode = $("trigger").value;
    scope.trigger = {
      mode,
      lane: Number($("trigger-lane").value),
      level: Number($("trigger-level").value) || 0,
      rising: $("trigger-edge").value === "rising",
    };
    $("trigger-more").hidden = mode === "off";
    $("arm").hidden = mode !== "single";
    scope.arm();
  };
  for (const id of ["trigger", "trigger-lane", "trigger-level", "trigger-edge"]) $(id).onchange = trigger;
  $("arm").onclick = () => scope.arm();
  const cursors = () => {
    $("cursor-row").hidden = !$("cursors").checked;
    scope.cursors = $("cursors").checked ? ["cursor-a", "cursor-b"].map((id) => Number($(id).value) / 1000) : null;
    for (const id of ["cursor-a", "cursor-b"]) {
      $(id).setAttribute("aria-valuetext", `${((Number($(id).value) / 1000) * scope.span).toPrecision(3)} s from the left`);
    }
  };
  for (const id of ["cursors", "cursor-a", "cursor-b"]) $(id).oninput = cursors;
  setInterval(() => { $("cursor-read").textContent = scope.measured(); }, 100);
  // With a pointer: the nearer cursor comes.
  const canvas = scope.canvas;
  canvas.onpointerdown = canvas.onpointermove = (event) => {
    if (!scope.cursors || !event.buttons) return;
    const box = canvas.getBoundingClientRect();
    const part = Math.min(1, Math.max(0, (event.clientX - box.left - LEFT) / (box.width - LEFT - RIGHT)));
    const [a, b] = scope.cursors;
    $(Math.abs(part - a) < Math.abs(part - b) ? "cursor-a" : "cursor-b").value = Math.round(1000 * part);
    cursors();
  };

  // What channels there are; the first sensors are shown.
  return (list) => {
    scope.channels = list; scope.clear();
    const sensors = list.map((c, i) => [c, i]).filter(([c]) => c.role !== "reference").map(([, i]) => i);
    scope.shown = sensors.slice(0, 4);
    $("picks").replaceChildren();
    $("trigger-lane").replaceChildren();
    for (let lane = 0; lane < Math.min(4, list.length); lane++) {
      const label = put($("picks"), "label", `${lane + 1} `), select = put(label, "select", "");
      list.forEach((c, i) => { put(select, "option", c.name).value = i; });
      scope.shown[lane] ??= lane;
      select.value = scope.shown[lane];
      select.onchange = () => { scope.shown[lane] = Number(select.value); scope.arm(); };
      put($("trigger-lane"), "option", `${lane + 1}`).value = lane;
    }
    trigger();
  };
}
