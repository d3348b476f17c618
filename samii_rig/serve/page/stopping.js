// The stop's button and Escape, wired by a script of its own: whatever else of the page fails to
// load or to run, they work. No lease, no token.

import { Stop } from "/page/stop.js";

const $ = (id) => document.getElementById(id);
const FRESH = 3000; // ms for which a state counts as live

// What the page knows: its newest state, and when the service was heard last.
export const known = { state: null, heard: 0 };
export const live = () => Boolean(known.heard) && performance.now() - known.heard < FRESH;

const stop = new Stop({
  urls: () => {
    const name = $("operator").value.trim(), port = known.state?.stop_port;
    const query = name ? `?name=${encodeURIComponent(name)}` : "";
    return ["", ...(port ? [`${location.protocol}//${location.hostname}:${port}`] : [])].map((at) => `${at}/api/stop${query}`);
  },
  running: () => live() && ["starting", "running"].includes(known.state?.running?.phase),
  said: (text) => { $("stopping").textContent = text; $("stopping").hidden = !text; },
  alarm: (text) => { if ($("stop-failed").textContent !== text) $("stop-failed").textContent = text; $("stop-alarm").hidden = !text; },
});
$("stop").onclick = $("stop-again").onclick = () => stop.press();
$("stop-drop").onclick = () => stop.drop();
document.addEventListener("keydown", (e) => { if (e.key === "Escape") { e.preventDefault(); stop.press(); } });
