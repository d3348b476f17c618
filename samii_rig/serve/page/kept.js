// What a person sets stays with their browser: the layout and the colours, nothing of a run.

const KEY = (name) => `samii-rig ${name}`;

export function kept(name, otherwise = "") {
  try { return localStorage.getItem(KEY(name)) ?? otherwise; } catch { return otherwise; }
}

export function keep(name, value) {
  try { localStorage.setItem(KEY(name), value); } catch { /* a browser that keeps nothing */ }
}

// A select or a checkbox that is as it was left. apply : what its change does.
export function remembered(element, name, apply = () => {}) {
  const box = element.type === "checkbox", was = kept(name, null);
  if (was !== null) {
    if (box) element.checked = was === "true";
    else if ([...element.options].some((o) => o.value === was)) element.value = was;
  }
  element.addEventListener("change", () => { keep(name, box ? element.checked : element.value); apply(); });
  apply();
}

// Light, dark, or as the system; what draws on a canvas is told by "colours" on the window.
export function themed(select) {
  const root = document.documentElement;
  const tell = () => dispatchEvent(new Event("colours"));
  remembered(select, "theme", () => {
    if (select.value) root.dataset.theme = select.value; else delete root.dataset.theme;
    tell();
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", tell);
}

// The rig's drawing, small beside or large above the curves.
export function sized(button, section, side, here) {
  const large = (on) => {
    button.setAttribute("aria-pressed", on);
    button.textContent = on ? "Small" : "Large";
    (on ? here : side).prepend(section);
    keep("rig large", on);
  };
  button.onclick = () => { large(button.getAttribute("aria-pressed") !== "true"); button.focus(); };
  if (kept("rig large") === "true") large(true);
}
