// What is now, in words: the run that goes on, how the last one ended, and who ended it.

// The verdicts of a diagnosis, for who has not read its manual.
export const VERDICTS = {
  no_mismatch: "nothing is missing", named: "cause named", ambiguous: "several causes fit", unknown: "mismatch, cause unknown",
};
export const MOVES = ["starting", "running"];
const PHASES = { starting: "starting; predicted once more, nothing moves yet" };
const ENDS = { completed: "completed", stopped: "stopped", tripped: "stopped by a limit", failed: "FAILED" };
const OUTPUT = { true: "The output is at zero.", false: "THE OUTPUT WAS NOT SEEN AT ZERO: use the emergency stop at the rig." };

export function clock(s) {
  if (!(s >= 0 && s < Infinity)) return "–";
  const m = Math.floor(s / 60);
  return m ? `${m} min ${String(Math.floor(s % 60)).padStart(2, "0")} s` : `${Math.ceil(s)} s`;
}

// Whether what moves is real; a simulated rig may have a clock of its own.
export function kind(s) {
  if (s.real) return "real rig";
  return `simulated rig${s.pace === 1 ? "" : s.pace ? `, ${s.pace} × real time` : ", as fast as it can"}`;
}

// A run by its experiment, and the pose that it was asked for in.
export const called = (j) => (j.pose ? `${j.experiment} at ${j.pose}` : j.experiment);

// How a run ended, who ended it, and that the output is at zero.
export function ended(l) {
  const at = new Date(l.ended || l.time), today = at.toDateString() === new Date().toDateString();
  const when = today ? at.toLocaleTimeString() : at.toLocaleString();
  if (l.phase === "refused" && !l.status) return `${called(l)}: did not start, ${when}: ${l.error}. Nothing moved.`;
  if (l.phase === "died") {
    const output = l.reason.startsWith("stopped") ? "Nothing moved." : "The device's own deadman drops the output: look at the rig.";
    return `${called(l)}: ${l.reason}, ${when}. ${l.at_zero ? OUTPUT.true : output}`;
  }
  const by = l.reason.startsWith("stop asked by ") ? ` by ${l.reason.slice(14)}` : "";
  const why = by || l.status === "completed" ? "" : `: ${l.early || (l.status === "failed" && l.error) || l.reason}`;
  return `${called(l)}: ${ENDS[l.status] ?? l.status}${by}, ${when}${why}. ${OUTPUT[l.at_zero] ?? ""}`;
}

// The line of a state.
export function line(s) {
  const r = s.running, moves = MOVES.includes(r?.phase), p = moves ? r.progress : {};
  if (moves && p.segment && r.phase === "running") return `${called(r)}: ${p.name}, segment ${p.segment} of ${p.n_segments}`;
  if (moves) return `${called(r)}: ${PHASES[r.phase] ?? r.phase}`;
  // Of a run that did not go through no diagnosis is kept, so none is made.
  const whole = r && r.diagnosis && (r.status === "completed" || r.early);
  if (r) return `${ended(r)} Being estimated${whole ? " and diagnosed" : ""}.`;
  return `${s.fault ? `FAULT: ${s.fault.reason}. ` : ""}${s.last ? ended(s.last) : s.fault ? "" : "No run. One is started under Drive."}`;
}

// What stands below it while samples come, and while they are diagnosed.
export function facts(p, s) {
  if (s.running?.doing) return { "The diagnosis tries": s.running.doing };
  return p.segment ? {
    "Run left": clock(p.time_left / s.pace), "Queue left": clock(s.time_left_s / s.pace),
    Level: `${p.level} ${p.unit}`, Frequency: p.broadband ? "whole band" : p.frequency ? `${p.frequency.toFixed(2)} Hz` : "at rest",
    "Nearest limit now": p.channel ? `${p.channel}, ${(100 * p.margin).toFixed(0)} % left` : "–",
    "Nearest in this run": `${p.worst_channel}, ${(100 * p.worst_margin).toFixed(0)} % left`,
    "Late samples": p.late_ticks, "Missing samples": p.missing_samples,
  } : {};
}
