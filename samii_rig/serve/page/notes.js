// Notes at a frequency. Of a run that goes on they wait in the browser until its recording is whole.

import { keep, kept } from "/page/kept.js";

export class Notes {
  // ask : the service. shown : takes the notes of the run that is shown.
  constructor(ask, shown) { Object.assign(this, { ask, shown, recording: "", busy: false, waiting: JSON.parse(kept("notes", "{}")), sent: {} }); }

  save() { keep("notes", JSON.stringify(this.waiting)); this.tell(); }
  tell() { this.shown([...(this.waiting[this.recording] ?? []), ...(this.sent[this.recording] ?? [])]); }

  // What runs, or ran last, is what a note is about.
  about(state) {
    const now = state.running?.recording ?? state.last?.recording ?? "";
    if (now !== this.recording) { this.recording = now; this.tell(); }
    if (!state.running && !this.busy && Object.keys(this.waiting).length) this.settle();
  }

  // id : of a recording that is whole, "" for the run's.
  async add(text, id) {
    if (id) { await this.ask("POST", `/recordings/${id}/notes`, { text }); return; }
    if (!this.recording) throw new Error("there is no run that the note could be about");
    (this.waiting[this.recording] ??= []).push(text);
    this.save();
  }

  // Whole recordings get the notes that waited for them.
  async settle() {
    this.busy = true;
    try {
      const { recordings } = await this.ask("GET", "/recordings?limit=50");
      for (const [path, texts] of Object.entries(this.waiting)) {
        const found = recordings.find((r) => r.path === path);
        if (!found) continue;
        for (const text of [...texts]) {
          await this.ask("POST", `/recordings/${found.id}/notes`, { text });
          texts.shift();
          (this.sent[path] ??= []).push(text);
        }
        delete this.waiting[path];
        this.save();
      }
    } catch { /* asked again with the next state */ } finally { setTimeout(() => { this.busy = false; }, 2000); }
  }
}
