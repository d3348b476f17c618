// An experiment's levels, band, repeats and channels as fields with units. They write into the
// experiment's file, which is what is ordered; each change is predicted at once, and each limit
// says how much of it would be left. The pose of a rig that has weight is a field of the order.

import { pretty } from "/page/units.js";

const WAIT = 350; // ms after the last key
// What a file may hold, in the order of the page: key, name, unit ("" for a number, null for the file's).
const FIELDS = [
  ["amplitudes", "Levels", null], ["start_hz", "From", "Hz"], ["stop_hz", "To", "Hz"], ["low_hz", "From", "Hz"], ["high_hz", "To", "Hz"],
  ["duration", "Sweep", "s"], ["period", "Period", "s"], ["hold", "Hold", "s"], ["repeats", "Repeats", ""], ["realisations", "Realisations", ""],
  ["periods", "Periods", ""], ["points", "Frequencies", ""], ["lead_in", "Lead in", "s"], ["ring_down", "Ring down", "s"], ["actuator", "Drives", ""],
];
const NUMBER = /^[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?$/i;

// The line of a key before the file's first table; one that goes on over lines is left to the file.
const at = (key) => new RegExp(`^(${key}[ \\t]*=[ \\t]*)([^\\n#]*?)([ \\t]*(?:#.*)?)$`, "m");
const head = (text) => { const k = text.search(/^\[/m); return k < 0 ? [text, ""] : [text.slice(0, k), text.slice(k)]; };

export function read(text, key) {
  const m = at(key).exec(head(text)[0]);
  return m && (!m[2].startsWith("[") || m[2].endsWith("]")) ? m[2] : null;
}

export function written(text, key, value) {
  const [top, rest] = head(text);
  return top.replace(at(key), (_, before, old, after) => before + value + after) + rest;
}

export class Fields {
  // text : the file's textarea. predict : a file and what goes with it to its dry run. changed : the
  // file was changed here.
  constructor({ $, put, predict, changed }) {
    Object.assign(this, { $, put, predict, changed, timer: 0, turn: 0, inputs: {}, rig: null });
    $("pose").oninput = () => this.posed();
  }

  // Of which rig they are. Without gravity it has no pose; degrees, as the drive's of a bench.
  of(rig) {
    const { $ } = this;
    this.rig = rig;
    $("stands").hidden = !rig.gravity;
    this.own = rig.pose ? String(Number(((180 / Math.PI) * rig.pose.value).toPrecision(12))) : "0";
    $("pose").value = this.own;
  }

  // The pose of the order, where it is another than the rig file's.
  get pose() {
    const { $ } = this, at = $("pose").value.trim();
    return $("stands").hidden || !at || Number(at) === Number(this.own) ? {} : { pose: `${at} deg` };
  }

  posed() {
    const { $ } = this, at = $("pose").value.trim(), wrong = at !== "" && !NUMBER.test(at);
    $("pose").setAttribute("aria-invalid", wrong);
    if (!wrong) { this.check(); return; }
    this.stale(`Pose: ${at} is not a number of degrees.`);
  }

  // The fields of another file; check : whether its margins are wanted at once.
  show(check) {
    const { $, put } = this, text = $("text").value, unit = (read(text, "unit") ?? "").replaceAll('"', "");
    $("fields").replaceChildren();
    this.inputs = {};
    for (const [key, name, own] of FIELDS) {
      const value = read(text, key);
      if (value === null) continue;
      const label = put($("fields"), "label", "", key === "amplitudes" ? "list" : ""), says = own === null ? unit : own;
      put(label, "span", `${name}${says ? ` [${says}]` : ""}`);
      const choice = key === "actuator" && this.rig;
      const input = this.inputs[key] = put(label, choice ? "select" : "input", "");
      if (choice) for (const a of this.rig.actuator) put(input, "option", a.name);
      else input.inputMode = "decimal";
      input.value = key === "amplitudes" ? value.slice(1, -1).trim() : value.replaceAll('"', "");
      input.setAttribute("aria-describedby", "checked");
      input.oninput = () => this.typed(key, input);
    }
    this.said("");
    $("margins").replaceChildren();
    if (check) this.check(); else clearTimeout(this.timer);
  }

  typed(key, input) {
    const { $ } = this, parts = input.value.split(",").map((v) => v.trim());
    const list = key === "amplitudes", word = key === "actuator";
    if (!word && !(parts.every((v) => NUMBER.test(v)) && (list || parts.length === 1))) {
      this.wrong(key, list ? "numbers with commas between them" : "a number");
      return;
    }
    $("text").value = written($("text").value, key, list ? `[${parts.join(", ")}]` : word ? `"${input.value}"` : parts[0]);
    this.changed();
    this.check();
  }

  // A field whose value is not in the file is not what would be run.
  get bad() { return [...Object.values(this.inputs), this.$("pose")].some((i) => i.getAttribute("aria-invalid") === "true"); }

  wrong(key, expected) {
    this.inputs[key].setAttribute("aria-invalid", "true");
    const name = FIELDS.find(([k]) => k === key)[1];
    this.stale(`${name}: ${this.inputs[key].value || "nothing"} is not ${expected}.`);
  }

  // What was predicted, or is being predicted, is not of what stands in the fields.
  stale(text) {
    clearTimeout(this.timer); this.turn++;
    this.said(text, true);
    this.$("margins").replaceChildren();
  }

  said(text, bad = false) { this.$("checked").textContent = text; this.$("checked").className = bad ? "bad" : "sub"; }

  check() {
    clearTimeout(this.timer);
    this.said("predicting …");
    this.timer = setTimeout(async () => {
      const mine = ++this.turn;
      let found, failed = "";
      try { found = await this.predict(this.$("text").value, this.pose); } catch (error) { failed = error.message; }
      if (mine !== this.turn) return; // typed again meanwhile
      for (const [key, input] of Object.entries(this.inputs)) input.setAttribute("aria-invalid", new RegExp(`: ${key}\\b`).test(failed));
      this.$("margins").replaceChildren();
      if (failed) { this.said(failed, true); return; }
      this.margins(found);
    }, WAIT);
  }

  // One row a limit: the worst of all runs.
  margins({ runs, refused }) {
    const { $, put } = this, rows = new Map();
    for (const run of runs) for (const m of run.margins) {
      const key = `${m.channel} ${m.what}`;
      if (!(rows.get(key)?.margin <= m.margin)) rows.set(key, m);
    }
    this.said(refused ? `Refused: ${refused}` : "Within every limit.", Boolean(refused));
    const head = put(put($("margins"), "thead", ""), "tr", "");
    for (const name of ["Limit", "At", "Left"]) put(head, "th", name);
    const body = put($("margins"), "tbody", "");
    for (const m of [...rows.values()].sort((a, b) => a.margin - b.margin)) {
      const row = put(body, "tr", "", m.margin <= 0 ? "bad" : "");
      put(row, "th", `${m.channel} ${m.what}`).scope = "row";
      put(row, "td", `${m.limit.toPrecision(3)} ${pretty(m.unit)}`);
      put(row, "td", `${(100 * m.margin).toFixed(0)} %`);
      row.title = `${m.predicted.toPrecision(3)} ${pretty(m.unit)} in ${m.segment}; ${m.reason}`;
    }
  }
}
