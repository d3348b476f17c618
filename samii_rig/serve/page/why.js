// Why a run was stopped: asked once it is at rest, kept as a note with its recording, and told
// where it says what is now. It has no part in the stop.

const BEGINS = "stopped because: ";
const AGAIN = 10000; // ms between looks for what another person wrote

export class Why {
  // ask : the service. tried : wraps what may go wrong.
  constructor({ $, ask, tried }) {
    Object.assign(this, { $, ask, job: "", recording: null, at: 0 });
    $("why-stopped").onsubmit = tried(async () => {
      const text = $("why-stopped-text").value.trim();
      const { remarks } = await ask("POST", `/recordings/${this.recording}/notes`, { text: BEGINS + text });
      $("why-stopped-text").value = "";
      this.tell(remarks.notes);
    });
  }

  show(state) {
    const { $ } = this, l = state.last, asked = !state.running && l && ["stopped", "tripped", "failed"].includes(l.status);
    if (!asked || l.id !== this.job) {
      $("why-stopped").hidden = $("why-said").hidden = true;
      Object.assign(this, { job: asked ? l.id : "", recording: null, at: 0 });
    }
    if (!asked || performance.now() - this.at < AGAIN || !$("why-said").hidden) return;
    this.at = performance.now();
    this.look(l).catch(() => {}); // looked at again
  }

  async look(last) {
    if (!last.recording_id) return;
    const { remarks } = await this.ask("GET", `/recordings/${last.recording_id}`);
    if (this.job !== last.id) return;
    this.recording = last.recording_id;
    this.tell(remarks?.notes ?? []);
  }

  tell(notes) {
    const { $ } = this, said = notes.filter((n) => n.text.startsWith(BEGINS)).at(-1);
    $("why-stopped").hidden = Boolean(said);
    $("why-said").hidden = !said;
    if (said) $("why-said").textContent = `Why, by ${said.author}: ${said.text.slice(BEGINS.length)}`;
  }
}
