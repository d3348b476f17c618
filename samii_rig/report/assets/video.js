// A film beside the samples, by the time at which each was taken. The film stays where it is: the
// page shows it from the reader's own disk and holds none of it.
(() => {
  const $ = (id) => document.getElementById(id);
  const plot = page.plots.find((p) => p.figure.sets && p.figure.sets[0].stamp);
  if (!plot || !$("video-file")) return;
  const { div, select, figure } = plot, film = $("video-shown");
  const SINCE_1904 = 2082844800; // s from where MP4 counts to 1970
  let stamp = NaN; // ms since 1970 of the film's first picture

  // When an MP4 or MOV says that it was made, ms since 1970; NaN where it does not say.
  const made = async (file) => {
    let at = 0;
    while (at + 16 <= file.size) {
      const v = new DataView(await file.slice(at, at + 40).arrayBuffer());
      const kind = String.fromCharCode(...[4, 5, 6, 7].map((i) => v.getUint8(i)));
      const long = v.getUint32(0) === 1, head = long ? 16 : 8;
      const size = long ? Number(v.getBigUint64(8)) : v.getUint32(0);
      if (size < head) break;
      if (kind === "mvhd" && v.byteLength >= head + 12) {
        const s = v.getUint8(head) ? Number(v.getBigUint64(head + 4)) : v.getUint32(head + 4);
        return s > SINCE_1904 ? 1000 * (s - SINCE_1904) : NaN;
      }
      at += kind === "moov" ? head : size;
    }
    return NaN;
  };
  const say = (text) => { $("video-said").textContent = text; };
  const written = (ms) => new Date(ms).toISOString().slice(0, 23);
  const end = (set) => set.stamp + 1000 * set.lasts;

  // The line in the samples where the film is now; another segment where it is in another.
  const follow = () => {
    if (!Number.isFinite(stamp)) return;
    const now = stamp + 1000 * film.currentTime;
    const k = figure.sets.findIndex((s) => s.stamp <= now && now <= end(s));
    if (k < 0) { say(`No sample at ${written(now)} UTC: recorded from ${written(figure.sets[0].stamp)} to ${written(end(figure.sets.at(-1)))}.`); mark(null); return; }
    if (select && select.selectedIndex !== k) { select.selectedIndex = k; page.draw(plot); }
    const t = (now - figure.sets[k].stamp) / 1000;
    say(`${figure.sets[k].name}, ${t.toFixed(3)} s; ${written(now)} UTC`);
    mark(t);
  };
  const mark = (t) => {
    const line = { type: "line", xref: "x", yref: "paper", x0: t, x1: t, y0: 0, y1: 1, line: { width: 2, color: "#d0342c" } };
    Plotly.relayout(div, { shapes: t === null ? [] : [line] });
  };
  $("video-file").onchange = async () => {
    const [file] = $("video-file").files;
    if (!file) return;
    URL.revokeObjectURL(film.src);
    film.src = URL.createObjectURL(file);
    film.hidden = false;
    const told = await made(file);
    if (!Number.isFinite(told)) say("The film does not say when it was made: it begins here with the first sample. Correct its stamp.");
    stamp = Number.isFinite(told) ? told : figure.sets[0].stamp;
    $("video-stamp").value = written(stamp);
    if (Number.isFinite(told)) follow();
  };
  $("video-stamp").onchange = () => {
    const given = Date.parse(`${$("video-stamp").value}Z`);
    $("video-stamp").setAttribute("aria-invalid", !Number.isFinite(given));
    if (Number.isFinite(given)) { stamp = given; follow(); } else say("The stamp is no time; expected such as 2026-11-24T09:30:05.250");
  };
  film.onerror = () => say("This browser cannot show that film.");
  film.ontimeupdate = film.onseeked = follow;
  div.on("plotly_click", ({ points }) => {
    if (!Number.isFinite(stamp)) return;
    const set = figure.sets[select ? select.selectedIndex : 0];
    film.currentTime = Math.max(0, (set.stamp + 1000 * points[0].x - stamp) / 1000);
  });
})();
