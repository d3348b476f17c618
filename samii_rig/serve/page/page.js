import { Scope } from "/page/scope.js";
import { plot } from "/page/curves.js";
import { controls } from "/page/controls.js";
import { Motion } from "/page/motion.js";
import { SoFar } from "/page/sofar.js";
import { Replay } from "/page/replay.js";
import { Stop } from "/page/stop.js";

const $ = (id) => document.getElementById(id);
const scope = new Scope($("scope"), (text) => { $("scope-state").textContent = text; });
const motion = new Motion($("motion"), scope, (text) => { $("motion").setAttribute("aria-label", text); });
let lease = "", beating = 0, state = null, heard = 0, job = "", wanted = true, anew = "";

// The verdicts of a diagnosis, for who has not read its manual.
const VERDICTS = {
  no_mismatch: "nothing is missing", named: "cause named", ambiguous: "several causes fit", unknown: "mismatch, cause unknown",
};
const PHASES = {
  starting: "starting; predicted once more, nothing moves yet",
};
const MOVES = ["starting", "running"];
const REFUSED = [401, 403, 409]; // by the service itself
const GONE = "The service does not answer.";
const name = () => $("operator").value.trim();
async function ask(method, path, body, headers = {}) {
  const answer = await fetch(`/api${path}`, {
    method,
    headers: { "X-Name": encodeURIComponent(name()), ...(lease ? { "X-Lease": lease } : {}), ...(body ? { "Content-Type": "application/json" } : {}), ...headers },
    body: body ? JSON.stringify(body) : undefined,
  }).catch(() => { throw new Error(GONE); });
  const found = await answer.json().catch(() => ({}));
  if (answer.status === 401) { $("login").hidden = false; $("token").focus(); }
  // A proxy may have no words of its own.
  if (!answer.ok) {
    const said = found.error || `The service answered with ${answer.status} ${answer.statusText}`.trim();
    throw Object.assign(new Error(said), { status: answer.status });
  }
  return found;
}

function alarm(text) { $("alarm").textContent = text; $("alarm").hidden = !text; }
const tried = (work) => async (event) => {
  if (event) event.preventDefault();
  try { alarm(""); await work(event); } catch (error) { alarm(error.message); }
};
function clock(s) {
  if (!(s >= 0 && s < Infinity)) return "–";
  const m = Math.floor(s / 60);
  return m ? `${m} min ${String(Math.floor(s % 60)).padStart(2, "0")} s` : `${Math.ceil(s)} s`;
}
// What a plan takes, on the rig's clock: a simulated one may run faster.
const planned = (s) => (state && state.pace !== 1 ? `${clock(s)} of the rig's time` : clock(s));
function put(parent, tag, text, name = "") {
  const e = document.createElement(tag);
  e.textContent = text; if (name) e.className = name;
  parent.append(e);
  return e;
}

Object.assign(window, { scope, motion, show }); // to measure what they cost and show
const soFar = new SoFar($, ask, put);

// The stop: no lease, no token, and Escape from anywhere.
const live = () => heard && performance.now() - heard < 3000;
const stop = new Stop({
  urls: () => {
    const query = name() ? `?name=${encodeURIComponent(name())}` : "", port = state?.stop_port;
    return ["", ...(port ? [`${location.protocol}//${location.hostname}:${port}`] : [])].map((at) => `${at}/api/stop${query}`);
  },
  running: () => live() && MOVES.includes(state?.running?.phase),
  said: (text) => { $("stopping").textContent = text; $("stopping").hidden = !text; },
  alarm: (text) => { if ($("stop-failed").textContent !== text) $("stop-failed").textContent = text; $("stop-alarm").hidden = !text; },
});
$("stop").onclick = $("stop-again").onclick = () => stop.press();
$("stop-drop").onclick = () => stop.drop();
document.addEventListener("keydown", (e) => { if (e.key === "Escape") { e.preventDefault(); stop.press(); } });

// Live data, or a recording in their place
function take(data) {
  const frame = scope.take(data);
  if (frame && (!replay.on || replay.about.moves)) motion.take(frame, scope.channels);
}
const replay = new Replay({
  fetched: async (id, start, length) => {
    const answer = await fetch(`/api/recordings/${id}/frames?start=${start}&length=${length}`);
    if (!answer.ok) throw new Error((await answer.json()).error);
    return answer.arrayBuffer();
  },
  show: take,
  began: ({ name: recording, channels: list }) => {
    marked(`REPLAY of ${recording}: not live.`);
    motion.hz = null;
    if (JSON.stringify(list) !== JSON.stringify(scope.channels)) channels(list);
    scope.clear(); motion.clear();
  },
  ended: () => { marked(""); scope.clear(); motion.clear(); },
  said: (text, part) => {
    if (part === undefined) { alarm(text); return; }
    $("replay-state").textContent = text;
    $("replay-place").setAttribute("aria-valuetext", text);
    if (document.activeElement !== $("replay-place")) $("replay-place").value = 1000 * part;
  },
});
// Over the whole page: nobody takes what was for what is.
function marked(text) {
  $("replay-row").hidden = $("replay-mark").hidden = !text;
  $("replay-name").textContent = text;
  document.body.classList.toggle("replaying", Boolean(text));
  scope.recorded = Boolean(text);
}
$("replay-end").onclick = () => replay.stop();
$("replay-speed").onchange = () => { replay.speed = Number($("replay-speed").value); };
$("replay-place").onchange = () => replay.seek((replay.about.duration * $("replay-place").value) / 1000);
$("replay-pause").onclick = () => {
  replay.paused = !replay.paused;
  $("replay-pause").setAttribute("aria-pressed", replay.paused);
  $("replay-pause").textContent = replay.paused ? "Go on" : "Hold";
};
function listen() {
  const socket = new WebSocket(`${location.protocol.replace("http", "ws")}//${location.host}/api/live`);
  socket.binaryType = "arraybuffer";
  socket.onmessage = (message) => {
    heard = performance.now();
    if (typeof message.data === "string") show(JSON.parse(message.data));
    else if (!replay.on) take(message.data);
  };
  socket.onopen = () => { if ($("alarm").textContent === GONE) alarm(""); };
  socket.onclose = () => setTimeout(listen, 1000);
}
setInterval(() => {
  const silent = heard ? (performance.now() - heard) / 1000 : Infinity;
  const on = silent < 3;
  $("link").textContent = on ? (replay.on ? "replay, not live" : "live") : heard ? `connection lost for ${Math.round(silent)} s` : "connecting";
  $("link").className = `pill ${on ? (replay.on ? "" : "on") : heard ? "off" : ""}`;
  scope.live = on;
  if (!on) {
    $("unwatched").hidden = true;
    scope.why = heard ? `Connection lost ${Math.round(silent)} s ago: this is not live` : "";
    if (heard) $("now").textContent = "Unknown: the connection to the service is lost. A run may be going on.";
    $("facts").replaceChildren();
    $("bar").hidden = true;
    $("driver").textContent = "";
  } else scope.why = state && !replay.on && !state.running && scope.empty ? "No run" : "";
  $("lost").textContent = scope.lost ? `${scope.lost} frames were skipped, as this viewer was slow` : "";
}, 500);

// How a run ended, who ended it, and that the output is at zero.
const ENDS = { completed: "completed", stopped: "stopped", tripped: "stopped by a limit", failed: "FAILED" };
const OUTPUT = { true: "The output is at zero.", false: "THE OUTPUT WAS NOT SEEN AT ZERO: use the emergency stop at the rig." };
function ended(l) {
  const at = new Date(l.ended || l.time), today = at.toDateString() === new Date().toDateString();
  const when = today ? at.toLocaleTimeString() : at.toLocaleString();
  if (l.phase === "refused" && !l.status) return `${l.experiment}: did not start, ${when}: ${l.error}. Nothing moved.`;
  if (l.phase === "died") {
    const output = l.reason.startsWith("stopped") ? "Nothing moved." : "The device's own deadman drops the output: look at the rig.";
    return `${l.experiment}: ${l.reason}, ${when}. ${l.at_zero ? OUTPUT.true : output}`;
  }
  const by = l.reason.startsWith("stop asked by ") ? ` by ${l.reason.slice(14)}` : "";
  const why = by || l.status === "completed" ? "" : `: ${l.early || (l.status === "failed" && l.error) || l.reason}`;
  return `${l.experiment}: ${ENDS[l.status] ?? l.status}${by}, ${when}${why}. ${OUTPUT[l.at_zero] ?? ""}`;
}

function show(s) {
  const before = state;
  state = s;
  $("rig-name").textContent = s.rig;
  document.title = `${s.running ? "▶ " : ""}${s.rig}`;
  $("driver").textContent = `${s.operator ? `${s.operator} drives` : "nobody drives"}, ${s.viewers} watching`;
  // A run that begins is more than a replay.
  if (s.running && s.running.id !== job) { job = s.running.id; replay.stop(); scope.clear(); motion.clear(); }
  if (!replay.on) {
    if (s.channels.length && JSON.stringify(s.channels) !== JSON.stringify(scope.channels)) channels(s.channels);
    motion.hz = s.running?.progress.frequency ?? null;
  }
  const r = s.running, moves = MOVES.includes(r?.phase), p = moves ? r.progress : {};
  if (moves && p.segment && r.phase === "running") {
    $("now").textContent = `${r.experiment}: ${p.name}, segment ${p.segment} of ${p.n_segments}`;
  } else if (moves) $("now").textContent = `${r.experiment}: ${PHASES[r.phase] ?? r.phase}`;
  else if (r) $("now").textContent = `${ended(r)} Being estimated and diagnosed.`;
  else $("now").textContent = `${s.fault ? `FAULT: ${s.fault.reason}. ` : ""}${s.last ? ended(s.last) : s.fault ? "" : "No run."}`;
  unwatched(s, before, moves);
  $("start").textContent = r ? "Queue" : "Start";
  $("bar").hidden = !p.segment;
  if (p.segment) $("bar").value = 1 - Math.max(0, p.time_left) / p.duration;
  const facts = p.segment ? {
    "Run left": clock(p.time_left / s.pace), "Queue left": clock(s.time_left_s / s.pace),
    Level: `${p.level} ${p.unit}`, Frequency: p.broadband ? "whole band" : p.frequency ? `${p.frequency.toFixed(2)} Hz` : "at rest",
    "Nearest limit now": p.channel ? `${p.channel}, ${(100 * p.margin).toFixed(0)} % left` : "–",
    "Nearest in this run": `${p.worst_channel}, ${(100 * p.worst_margin).toFixed(0)} % left`,
    "Late samples": p.late_ticks, "Missing samples": p.missing_samples,
  } : {};
  $("facts").replaceChildren();
  for (const [k, v] of Object.entries(facts)) {
    const box = put($("facts"), "div", "");
    put(box, "dt", k); put(box, "dd", v);
  }
  $("fault").hidden = !s.fault;
  if (s.fault) $("fault-text").textContent = `FAULT since ${s.fault.time}: ${s.fault.reason}`;
  $("held").textContent = s.held ? `Held: ${s.held}` : s.queue.length ? "" : "Empty.";
  $("resume").hidden = !(s.held && s.queue.length && lease);
  $("queue").replaceChildren();
  for (const j of s.queue) {
    const item = put($("queue"), "li", `${j.experiment}, ${planned(j.duration_s)} `);
    if (lease) {
      const b = put(item, "button", "Take out");
      b.type = "button";
      b.onclick = tried(() => ask("DELETE", `/queue/${j.id}`));
    }
  }
  const l = s.last;
  const told = l ? [l.status || l.phase, l.error || l.reason, VERDICTS[l.verdict]].filter(Boolean) : [];
  $("last").textContent = l ? `Last: ${l.experiment}: ${told.join("; ")}.` : "";
  scope.over = motion.over = !moves && !replay.on;
  soFar.show(s);
  if (before && l && (!before.last || before.last.id !== l.id)) find();
}

// A run that no operator's page watches over, as after the service was started anew.
function unwatched(s, before, moves) {
  if (before && before.started !== s.started) anew = new Date(s.started).toLocaleTimeString();
  if (s.operator) anew = "";
  const said = [anew ? `The service was started anew at ${anew}.` : "", moves ? "Nobody drives: no operator's page watches over this run." : "Nobody drives."];
  $("unwatched").hidden = Boolean(s.operator) || !(moves || anew);
  $("unwatched-text").textContent = said.filter(Boolean).join(" ");
}

const channels = controls($, put, scope);

// Driving
function driving(secret) {
  lease = secret;
  clearInterval(beating);
  $("take").textContent = lease ? "Hand over" : "Take control";
  $("start").disabled = $("clear").disabled = $("next").disabled = !lease;
  $("drives").hidden = Boolean(lease);
  if (!lease) return;
  beating = setInterval(async () => {
    try { await ask("POST", "/lease/beat"); } catch (error) {
      // A line that is lost for a moment is not the lease, nor is a proxy's or a crowd's error.
      if (!REFUSED.includes(error.status)) return;
      driving("");
      alarm(`You do not drive any more: ${error.message}`);
    }
  }, 2000);
}
async function take_() {
  if (!name()) { $("operator").focus(); throw new Error("Your name first: it stands with every run."); }
  driving((await ask("POST", "/lease")).lease);
}
$("take-here").onclick = tried(take_);
$("take").onclick = tried(async () => {
  if (lease) { await ask("DELETE", "/lease"); driving(""); } else await take_();
});
$("operator").value = localStorage.getItem("samii-rig name") ?? "";
$("operator").onchange = () => localStorage.setItem("samii-rig name", name());
addEventListener("pagehide", () => {
  if (lease && !(state && state.running)) fetch("/api/lease", { method: "DELETE", keepalive: true, headers: { "X-Lease": lease } });
});
// The experiment, or its file as it was changed
let files = {};
const chosen = () => ($("changed").hidden ? { experiment: $("experiment").value } : { experiment_toml: $("text").value });
$("text").oninput = () => { $("changed").hidden = $("text").value === files[$("experiment").value]; };
$("experiment").onchange = $("as-shipped").onclick = () => {
  $("text").value = files[$("experiment").value];
  $("changed").hidden = true;
  $("planned").textContent = "";
};
$("plan").onclick = tried(async () => {
  $("planned").textContent = "predicting …";
  const found = await ask("POST", "/dry-run", chosen()).catch((e) => { $("planned").textContent = ""; throw e; });
  const total = found.runs.reduce((sum, r) => sum + r.duration_s, 0), worst = found.runs[0].margins[0];
  $("planned").textContent = found.refused ? `Refused: ${found.refused}`
    : `${found.runs.length > 1 ? `${found.runs.length} runs, ` : ""}${planned(total)}; nearest to a limit: ${worst.channel} in ${worst.segment}, ${(100 * worst.margin).toFixed(0)} % left of ${worst.limit} ${worst.unit}`;
});
const order = (what) => ask("POST", "/runs", { ...what, operator: name(), stop_when_certain: $("early").checked });
$("next").onclick = tried(async () => order({ experiment_toml: await soFar.next() }));
$("start").onclick = tried(async () => {
  $("planned").textContent = "predicting …";
  try {
    await order(chosen());
  } finally { $("planned").textContent = ""; }
});
$("resume").onclick = tried(() => ask("POST", "/queue/resume"));
$("clear").onclick = tried(() => ask("POST", "/clear-fault", { name: name(), reason: $("why").value }));
$("login").onsubmit = tried(async () => {
  const who = await ask("POST", "/login", null, { Authorization: `Bearer ${$("token").value}` });
  if (!who.role) throw new Error("that is no valid token");
  $("login").hidden = true; $("token").value = "";
  begin();
});

// Recordings
async function find() {
  const query = new URLSearchParams({ text: $("words").value, experiment: $("by-experiment").value, since: $("since").value, limit: 50 });
  const found = await ask("GET", `/recordings?${query}`);
  $("found").textContent = `${found.total} found`;
  listed = found.recordings;
  $("list").replaceChildren();
  for (const e of found.recordings) {
    const row = put($("list"), "tr", "");
    const written = state?.running && `${state.running.recording}.partial` === e.path;
    put(row, "td", e.started.slice(0, 16).replace("T", " "), "time");
    for (const text of [e.experiment, e.operator, clock(e.duration_s), written ? "being written" : e.problem || e.status, VERDICTS[e.verdict] ?? "", e.tags.join(", ")]) put(row, "td", text);
    const cell = put(row, "td", ""), b = put(cell, "button", e.path);
    b.type = "button"; b.onclick = tried(() => look(e.id));
  }
}
$("search").onsubmit = tried(find);

let looked = "", listed = [];
async function look(id) {
  looked = id;
  $("replay").disabled = true; // of what was looked at before
  const { recording: e, remarks } = await ask("GET", `/recordings/${id}`);
  $("one").hidden = false;
  offer(id);
  $("h-one").textContent = e.path;
  $("one-about").textContent = `${e.rig}, ${e.experiment}, ${e.samples.toLocaleString()} samples at ${e.rate_hz} Hz; ${e.status}: ${e.reason} `;
  $("report").href = `/api/recordings/${id}/report`;
  const link = put($("one-about"), "a", "download");
  link.href = `/api/recordings/${id}/file`;
  $("one-diagnosis").textContent = (remarks?.diagnosis.lines || []).join(" ");
  $("one-notes").replaceChildren();
  for (const n of remarks?.notes || []) put($("one-notes"), "li", `${n.time.slice(0, 16).replace("T", " ")} ${n.author}: ${n.text}`);
  $("one").scrollIntoView({ block: "start" });
  const signals = await ask("GET", `/recordings/${id}/signals?pixels=700`);
  const time = $("one-time"), bode = $("one-frf");
  time.style.height = `${40 + 70 * signals.curves.length}px`;
  $("replay").onclick = () => {
    if (replay.paused) $("replay-pause").click();
    const list = signals.curves.map(({ name, unit, role }) => ({ name, unit, role }));
    replay.start({ id, name: e.path, duration: signals.duration_s, channels: list, moves: e.rig === state?.rig });
    $("h-scope").scrollIntoView({ block: "start" });
  };
  $("replay").disabled = false;
  plot(time, signals.curves.map((c) => ({ name: c.name, unit: c.unit, x: c.time, y: c.values })));
  const { responses } = e.responses ? await ask("GET", `/recordings/${id}/frf`) : { responses: [] };
  bode.hidden = !responses.length;
  if (!responses.length) return;
  const r = responses.at(-1);
  bode.style.height = `${40 + 110 * r.curves.length}px`;
  plot(bode, r.curves.map((c) => ({
    name: `${c.output}/${c.input}`, unit: "dB", x: r.frequency,
    y: c.re.map((re, i) => (re === null ? null : 20 * Math.log10(Math.hypot(re, c.im[i])))),
  })), { logarithmic: true, unit: "Hz" });
}
// Two recordings, in units of their joint uncertainty
const COLUMNS = {
  "Response": (p, r) => `${r.output}/${r.input} at ${p.level} ${p.unit}`,
  "Lines": (p, r) => r.lines,
  "Mean square (noise: 1)": (p, r) => r.mean_square?.toPrecision(3) ?? "–",
  "Lines beyond noise": (p, r) => r.beyond_noise,
  "Largest": (p, r) => (r.largest === null ? "–" : `${r.largest.toPrecision(2)} sd at ${r.largest_hz.toFixed(2)} Hz`),
  "Median difference": (p, r) => (r.median_relative === null ? "–" : `${(100 * r.median_relative).toPrecision(2)} %`),
};
function offer(id) {
  $("compared").replaceChildren();
  $("other").replaceChildren();
  put($("other"), "option", "another recording …").value = "";
  for (const e of listed) if (e.id !== id && e.responses) put($("other"), "option", e.path).value = e.id;
}
$("other").onchange = tried(async () => {
  $("compared").replaceChildren();
  if (!$("other").value) return;
  const { pairs } = await ask("GET", `/compare?a=${looked}&b=${$("other").value}`);
  const table = put($("compared"), "table", ""), head = put(put(table, "thead", ""), "tr", "");
  for (const name of Object.keys(COLUMNS)) put(head, "th", name);
  const body = put(table, "tbody", "");
  for (const p of pairs) {
    for (const r of p.outputs) {
      const row = put(body, "tr", "");
      for (const text of Object.values(COLUMNS)) put(row, "td", text(p, r));
    }
  }
  if (!body.children.length) $("compared").textContent = "They have no response on common lines.";
});
$("note").onsubmit = tried(async () => {
  await ask("POST", `/recordings/${looked}/notes`, { text: $("note-text").value });
  $("note-text").value = "";
  await look(looked);
});

async function begin() {
  // First: it says who may not look.
  const { experiments } = await ask("GET", "/experiments");
  $("experiment").replaceChildren();
  for (const name of Object.keys(experiments)) put($("experiment"), "option", name);
  if ("swept_sine" in experiments) $("experiment").value = "swept_sine";
  const { you } = await ask("GET", "/state");
  if (you.name && !name()) $("operator").value = you.name;
  files = experiments;
  $("experiment").onchange();
  if (wanted) { wanted = false; listen(); }
  const drawn = ask("GET", "/rig").then(({ drawing, motion: moves }) => {
    $("drawing").innerHTML = drawing;
    motion.rig(moves);
  });
  const words = await ask("GET", "/recordings/words");
  for (const name of words.experiment) put($("by-experiment"), "option", name).value = name;
  await find();
  performance.mark("interactive");
  await drawn;
}
tried(begin)();
