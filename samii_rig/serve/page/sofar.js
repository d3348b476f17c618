// What is known of the run while it goes on: its frequency responses and its diagnosis.

import { MOVES, clock } from "/page/now.js";

const part = (p) => (p > 0.9995 ? "over 99.9 %" : p < 0.0005 ? "under 0.1 %" : `${(100 * p).toFixed(1)} %`);
const ago = (s) => (s < 90 ? `${Math.round(s)} s` : `${Math.round(s / 60)} min`);
const hz = (f) => f.toPrecision(2);
const TAKES = 3; // s of a look and an estimate
// In steps of a tenth or so: it is an expectation, and each change is read aloud.
const rounded = (s) => (s > 60 ? 10 * Math.ceil(s / 10) : s > 15 ? 5 * Math.ceil(s / 5) : Math.ceil(s));

export class SoFar {
  // $ : element by id. ask : the service. put : append an element. panel : draws the responses.
  constructor($, ask, put, panel) {
    Object.assign(this, { $, ask, put, panel, data: null, seen: "", job: "", busy: false });
  }

  async show(state) {
    const { $ } = this;
    const run = state.running, job = run ? run.id : state.last ? state.last.id : "";
    if (job !== this.job) { this.job = job; this.seen = ""; this.data = null; this.final(run ? null : state.last); }
    const told = run ? state.so_far : null;
    $("diagnosis-doing").textContent = told?.doing ? `Now: ${told.doing}.` : "";
    if (told) this.diagnosis(told, state);
    else if (!run && this.was) this.final(state.last);
    this.was = run;
    $("frf-age").textContent = told && this.data?.responses.length ? `Estimated ${ago(told.responses_age_s)} ago.` : "";
    const due = this.expected(state);
    if (due !== this.due && this.data) this.about(run, due);
    this.due = due;
    if (this.busy || !job || (told ? told.responses === this.seen : this.seen === "over")) return;
    this.busy = true;
    const seen = told ? told.responses : "over";
    try {
      // Nothing is asked for that is not there.
      const there = told ? seen !== "0" : state.last.estimated;
      const data = there ? await this.ask("GET", `/jobs/${job}/responses`) : null;
      if (job === this.job) Object.assign(this, { data, seen });
    } catch { this.seen = seen; } finally { this.busy = false; }
    this.about(run, this.expected(state));
  }

  // When there will be a first estimate, in words; "" once there is one, or no run.
  expected({ running: run, pace }) {
    const { data } = this;
    if (!run || data?.responses.length) return "";
    if (!MOVES.includes(run.phase)) return "The last one is being made.";
    if (!data) return "Its process is being started.";
    if (data.first_s === null) return "This experiment gives none.";
    const { duration, time_left: left } = run.progress, s = (data.first_s - (duration - left)) / pace + TAKES;
    if (!(s < Infinity)) return "The first estimate comes soon.";
    return s > TAKES ? `The first estimate is expected in about ${clock(rounded(s))}.` : "The first estimate is being made.";
  }

  about(run, due) {
    const { $, data } = this;
    this.panel.set(data, Boolean(run));
    if (!data) return;
    const said = data.responses.map((r) => `${r.level} ${r.unit}: ${hz(r.low_hz)} to ${hz(r.high_hz)} Hz, ${
      r.going_on ? (run ? "goes on" : "cut off") : `${r.n} ${r.n > 1 ? "repeats" : "sweep"}`}`).join("; ");
    const of = `${data.done} of ${data.of} segments`;
    const when = run ? `${of} whole` : data.final ? `Last run, all that was recorded: ${of} whole` : `Last run, as estimated when ${of} were whole`;
    const none = run ? `Nothing measured yet. ${due}`.trim().replace(/\.$/, "") : "No response can be estimated from it";
    $("frf-about").textContent = `${when}. ${said || none}.${data.trouble ? ` The newest part: ${data.trouble}.` : ""}`;
    $("frf-hatched").hidden = !run;
    $("frf").setAttribute("aria-label", `Frequency responses over the model. ${$("frf-about").textContent}`);
  }

  diagnosis({ diagnosis: d, failed }, state) {
    const { $ } = this, run = state.running;
    $("diagnosis-section").hidden = !run.diagnosis;
    $("h-diagnosis").textContent = "Diagnosis so far";
    const why = run.phase === "analysing" ? " The last one is being made." : failed ? " What makes it has ended; the log of the job says why." : "";
    if (!d) {
      const cut = run.phase === "analysing" && run.status !== "completed" && !run.early;
      const then = failed || run.phase === "analysing" ? why : ` ${this.expected(state) || "The first one is being made."}`;
      this.empty(cut ? "None: the run ended before there was one." : `None yet: it is made from what is measured.${then}`);
      return;
    }
    this.say(d, d.repeats ? "" : "Preliminary, from one sweep: its noise is not known from repeats.");
    const end = d.certain ? `Certain: ${d.certain}. ` : "";
    const stop = run.stop_when_certain ? (d.certain ? "The run ends after this segment." : "The run ends once it is certain.") : "";
    $("diagnosis-age").textContent = `${ago(d.age_s)} old, made in ${d.took_s.toFixed(1)} s from ${d.done} of ${d.of} segments, ${
      hz(d.low_hz)} to ${hz(d.high_hz)} Hz. ${end}${stop}${why}`;
  }

  // The diagnosis that is kept with the recording; of a run that did not end, what was known until then.
  async final(last) {
    const { $ } = this;
    $("diagnosis-section").hidden = true;
    if (!last || !last.diagnosed) return;
    const d = await this.ask("GET", `/jobs/${last.id}/diagnosis`).catch(() => null);
    if (!d || this.job !== last.id) return;
    $("diagnosis-section").hidden = false;
    $("h-diagnosis").textContent = d.final ? "Diagnosis of the last run" : "Diagnosis until the last run ended";
    this.say(d, d.final ? "" : "Preliminary, and not kept with the recording.");
    $("diagnosis-age").textContent = d.final ? `Kept with ${last.recording}. ${last.early ? `The run ended early: ${last.early}.` : ""}`
      : `From ${d.done} of ${d.of} segments, ${hz(d.low_hz)} to ${hz(d.high_hz)} Hz.`;
  }

  // but : what keeps the answer from being a final one.
  say(d, but) {
    const { $, put } = this;
    if (!d.verdict) {
      this.empty(d.final ? `None: ${d.trouble}` : "No answer yet.");
      $("diagnosis-more").textContent = d.final ? "" : d.trouble;
      return;
    }
    const open = !d.repeats && !d.final && d.verdict === "unknown";
    $("diagnosis-what").textContent = open ? "No answer yet." : d.lines[0];
    $("diagnosis-but").textContent = but;
    $("diagnosis-more").textContent = open ? "" : d.lines.slice(1).join(" ");
    $("diagnosis-facts").replaceChildren();
    const facts = {};
    if (d.nothing !== null) facts["Chance that nothing is missing"] = part(d.nothing);
    if (d.probability && d.causes.length) facts["Chance of the answer"] = part(d.probability);
    if (d.sites.length) facts.Sites = d.sites.map((s) => `${s.site} ${part(s.probability)}`).join(", ");
    for (const [k, v] of Object.entries(facts)) {
      const box = put($("diagnosis-facts"), "div", "");
      put(box, "dt", k); put(box, "dd", v);
    }
    $("next").hidden = !d.next_toml;
    $("next").textContent = `Queue the next experiment: ${d.experiment}`;
  }

  empty(text) {
    const { $ } = this;
    $("diagnosis-what").textContent = text;
    $("diagnosis-but").textContent = $("diagnosis-more").textContent = $("diagnosis-age").textContent = "";
    $("diagnosis-facts").replaceChildren();
    $("next").hidden = true;
  }

  // The file of the next experiment, as the diagnosis asks for it.
  async next() { return (await this.ask("GET", `/jobs/${this.job}/diagnosis`)).next_toml; }
}
