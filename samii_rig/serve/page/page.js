import { Scope } from "/page/scope.js";
import { controls } from "/page/controls.js";
import { Motion } from "/page/motion.js";
import { SoFar } from "/page/sofar.js";
import { Replay } from "/page/replay.js";
import { known, live } from "/page/stopping.js";
import { Lamps, bounds } from "/page/lamps.js";
import { Fields } from "/page/fields.js";
import { Why } from "/page/why.js";
import { Notes } from "/page/notes.js";
import { Panel } from "/page/panel.js";
import { Recordings } from "/page/recordings.js";
import { MOVES, VERDICTS, called, clock, facts, kind, line } from "/page/now.js";
import { keep, kept, sized, themed } from "/page/kept.js";
import { pretty } from "/page/units.js";

const $ = (id) => document.getElementById(id);
const scope = new Scope($("scope"), (text) => { $("scope-state").textContent = text; });
const motion = new Motion($("motion"), scope, (text) => { $("motion").setAttribute("aria-label", text); });
let lease = "", beating = 0, state = null, job = "", wanted = true, anew = "", unlisted = false;

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
// What a plan takes, on the rig's clock: a simulated one may run faster.
const planned = (s) => (state && state.pace !== 1 ? `${clock(s)} of the rig's time` : clock(s));
function put(parent, tag, text, name = "") {
  const e = document.createElement(tag);
  e.textContent = text; if (name) e.className = name;
  parent.append(e);
  return e;
}

const lamps = new Lamps($, put);
const why = new Why({ $, ask, tried });
const panel = new Panel($, put, (text) => pin(text).catch((error) => alarm(error.message)));
const notes = new Notes(ask, (texts) => { panel.notes = texts; panel.draw(); });
// A note at a frequency is the run's, or the recording's where only recordings are shown.
async function pin(text) {
  const id = panel.live ? "" : panel.laid.at(-1)?.id ?? "";
  await notes.add(text, id);
  if (id) { panel.laid.at(-1).notes.push({ text }); panel.draw(); }
}
const soFar = new SoFar($, ask, put, panel);
Object.assign(window, { scope, motion, lamps, panel, soFar, show }); // to measure what they cost and show

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
    // Not those of the run that is over; the next state may be long in coming.
    scope.over = motion.over = false;
  },
  ended: () => { marked(""); scope.clear(); motion.clear(); scope.over = motion.over = !MOVES.includes(state?.running?.phase); },
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
    known.heard = performance.now();
    if (typeof message.data === "string") show(JSON.parse(message.data));
    else { lamps.take(message.data); if (!replay.on) take(message.data); }
  };
  socket.onopen = () => { if ($("alarm").textContent === GONE) alarm(""); };
  socket.onclose = () => setTimeout(listen, 1000);
}
setInterval(() => {
  const { heard } = known, silent = heard ? (performance.now() - heard) / 1000 : Infinity, on = live();
  $("link").textContent = on ? (replay.on ? "replay, not live" : "live") : heard ? `connection lost for ${Math.round(silent)} s` : "connecting";
  $("link").className = `pill ${on ? (replay.on ? "" : "on") : heard ? "off" : ""}`;
  scope.live = on;
  if (!on) {
    $("unwatched").hidden = true;
    scope.why = heard ? `Connection lost ${Math.round(silent)} s ago: this is not live` : "";
    if (heard) $("now").textContent = "Unknown: the connection to the service is lost. A run may be going on.";
    $("facts").replaceChildren();
    $("bar").hidden = $("lamps").hidden = true;
    $("driver").textContent = "";
  } else scope.why = state && !replay.on && !state.running && scope.empty ? "No run" : "";
  $("lost").textContent = scope.lost ? `${scope.lost} frames were skipped, as this viewer was slow` : "";
}, 500);

function show(s) {
  const before = state;
  state = known.state = s;
  $("rig-name").textContent = s.rig;
  $("kind").textContent = kind(s);
  document.title = `${s.running ? "▶ " : ""}${s.rig}`;
  $("driver").textContent = `${s.operator ? `${s.operator} drives` : "nobody drives"}, ${s.viewers} watching`;
  // A run that begins is more than a replay.
  if (s.running && s.running.id !== job) { job = s.running.id; replay.stop(); scope.clear(); motion.clear(); }
  if (!replay.on) {
    if (s.channels.length && JSON.stringify(s.channels) !== JSON.stringify(scope.channels)) channels(s.channels);
    motion.hz = s.running?.progress.frequency ?? null;
  }
  const r = s.running, moves = MOVES.includes(r?.phase), p = moves ? r.progress : {};
  $("now").textContent = line(s);
  unwatched(s, before, moves);
  $("start").textContent = r ? "Queue" : "Start";
  $("bar").hidden = !p.segment;
  if (p.segment) $("bar").value = 1 - Math.max(0, p.time_left) / p.duration;
  $("facts").replaceChildren();
  for (const [k, v] of Object.entries(facts(p, s))) {
    const box = put($("facts"), "div", "");
    put(box, "dt", k); put(box, "dd", v);
  }
  $("fault").hidden = !s.fault;
  if (s.fault) $("fault-text").textContent = `FAULT since ${s.fault.time}: ${s.fault.reason}`;
  $("held").textContent = s.held ? `Held: ${s.held}` : s.queue.length ? "" : "Empty.";
  // What waits for somebody's word is said where it says what is now.
  const waits = s.held && s.queue.length;
  $("held-here").hidden = !waits;
  if (waits) $("held-now").textContent = `Queue held, ${s.queue.length} ${s.queue.length > 1 ? "runs wait" : "run waits"}.`;
  $("resume").hidden = !(waits && lease);
  $("queue").replaceChildren();
  for (const j of s.queue) {
    const item = put($("queue"), "li", `${called(j)}, ${planned(j.duration_s)} `);
    if (lease) {
      const b = put(item, "button", "Take out");
      b.type = "button";
      b.onclick = tried(() => ask("DELETE", `/queue/${j.id}`));
    }
  }
  const l = s.last;
  $("kept").hidden = Boolean(r) || !l?.recording_id;
  if (!$("kept").hidden) {
    $("kept-name").textContent = l.recording;
    $("kept-report").href = `/api/recordings/${l.recording_id}/report`;
  }
  const told = l ? [l.status || l.phase, l.error || l.reason, VERDICTS[l.verdict]].filter(Boolean) : [];
  $("last").textContent = l ? `Last: ${called(l)}: ${told.join("; ")}.` : "";
  scope.over = motion.over = !moves && !replay.on;
  document.body.classList.toggle("quiet", !r && !replay.on && scope.empty);
  lamps.state(s, moves);
  soFar.show(s);
  notes.about(s);
  why.show(s);
  if (unlisted || (before && l && (!before.last || before.last.id !== l.id))) {
    unlisted = false;
    recordings.find().catch(() => { unlisted = true; }); // the service is gone: with its next state
  }
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
// A field that is empty yet is no alarm.
function nameless(is) {
  $("name-hint").hidden = !is;
  $("operator").setAttribute("aria-invalid", is);
}
async function take_() {
  nameless(!name());
  if (!name()) { $("operator").focus(); return; }
  driving((await ask("POST", "/lease")).lease);
}
$("take-here").onclick = tried(take_);
$("take").onclick = tried(async () => {
  if (lease) { await ask("DELETE", "/lease"); driving(""); } else await take_();
});
$("operator").value = kept("name");
$("operator").oninput = () => { if (name()) nameless(false); };
$("operator").onchange = () => { keep("name", name()); if (name()) nameless(false); };
addEventListener("pagehide", () => {
  if (lease && !(state && state.running)) fetch("/api/lease", { method: "DELETE", keepalive: true, headers: { "X-Lease": lease } });
});
// The experiment, or its file as it was changed
let files = {};
const chosen = () => ({ ...fields.pose, ...($("changed").hidden ? { experiment: $("experiment").value } : { experiment_toml: $("text").value }) });
const changed = () => { $("changed").hidden = $("text").value === files[$("experiment").value]; };
const fields = new Fields({ $, put, changed, predict: (text, more) => ask("POST", "/dry-run", { experiment_toml: text, ...more }) });
$("text").oninput = () => { changed(); fields.show(true); };
const shipped = (check) => {
  $("text").value = files[$("experiment").value];
  $("changed").hidden = true;
  $("planned").textContent = "";
  fields.show(check);
};
$("experiment").onchange = $("as-shipped").onclick = () => shipped(true);
const sound = () => { if (fields.bad) throw new Error("A field is wrong; what it holds is not in the order."); };
$("plan").onclick = tried(async () => {
  sound();
  $("planned").textContent = "predicting …";
  const found = await ask("POST", "/dry-run", chosen()).catch((e) => { $("planned").textContent = ""; throw e; });
  const total = found.runs.reduce((sum, r) => sum + r.duration_s, 0), worst = found.runs[0].margins[0];
  $("planned").textContent = found.refused ? `Refused: ${found.refused}`
    : `${found.runs.length > 1 ? `${found.runs.length} runs, ` : ""}${planned(total)}; nearest to a limit: ${worst.channel} in ${worst.segment}, ${(100 * worst.margin).toFixed(0)} % left of ${worst.limit} ${pretty(worst.unit)}`;
});
// What is asked for next is of the rig as it stood in the run that asks for it.
const standing = (run) => (run?.pose ? { pose: run.pose } : {});
const order = (what) => ask("POST", "/runs", { ...what, operator: name(), stop_when_certain: $("early").checked });
$("next").onclick = tried(async () => order({ experiment_toml: await soFar.next(), ...standing(state.running ?? state.last) }));
$("start").onclick = tried(async () => {
  sound();
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
const recordings = new Recordings({
  $, put, ask, tried, state: () => state,
  play: (about) => {
    if (replay.paused) $("replay-pause").click();
    replay.start({ ...about, moves: about.rig === state?.rig });
  },
  lay: (recording) => panel.lay(recording),
});
$("kept-look").onclick = tried(() => recordings.look(state.last.recording_id));
themed($("theme"));
sized($("rig-size"), $("rig-section"), $("side"), $("rig-here"));

async function begin() {
  // First: it says who may not look.
  const { experiments } = await ask("GET", "/experiments");
  $("experiment").replaceChildren();
  for (const name of Object.keys(experiments)) put($("experiment"), "option", name);
  if ("swept_sine" in experiments) $("experiment").value = "swept_sine";
  const { you } = await ask("GET", "/state");
  if (you.name && !name()) $("operator").value = you.name;
  files = experiments;
  shipped(false);
  if (wanted) { wanted = false; listen(); }
  const drawn = ask("GET", "/rig").then(({ rig, drawing, motion: moves }) => {
    lamps.rig(rig);
    fields.of(rig);
    for (const c of [...rig.sensor, ...rig.actuator]) scope.about[c.name] = { resolution: c.resolution, limit: bounds(rig)[c.name]?.max };
    $("drawing").innerHTML = drawing;
    motion.rig(moves);
  });
  const words = await ask("GET", "/recordings/words");
  for (const name of words.experiment) put($("by-experiment"), "option", name).value = name;
  await recordings.find();
  performance.mark("interactive");
  await drawn;
}
tried(begin)();
