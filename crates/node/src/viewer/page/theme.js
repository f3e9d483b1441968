// Light and dark, and the colours of the style sheet for what is drawn.

const root = document.documentElement;
const system = matchMedia("(prefers-color-scheme: dark)");
const probe = document.createElement("canvas").getContext("2d", { willReadFrequently: true });

/** A colour of the style sheet as components from 0 to 1. */
function components(name) {
  const element = document.createElement("i");
  element.style.color = `var(${name})`;
  root.append(element);
  probe.fillStyle = getComputedStyle(element).color;
  element.remove();
  probe.fillRect(0, 0, 1, 1);
  return [...probe.getImageData(0, 0, 1, 1).data].slice(0, 3).map((part) => part / 255);
}
/** The same as a CSS colour. */
const solid = (name) => `rgb(${components(name).map((part) => Math.round(255 * part)).join(" ")})`;

export const isDark = () => (root.dataset.theme ?? (system.matches ? "dark" : "light")) === "dark";

let known = null;
/** The colours now. */
export function colours() {
  known ??= {
    background: components("--plot"), outside: components("--background"), plain: components("--ghost"),
    dark: isDark(), ghost: solid("--ghost"), paper: solid("--background"),
    chart: {
      ink: solid("--ink"), muted: solid("--muted"), line: solid("--line"),
      model: solid("--accent"), baseline: solid("--warm"),
    },
  };
  return known;
}

let changed = () => {};
/** Calls `then` when the colours change. */
export function onChange(then) {
  changed = then;
}
function reset() {
  known = null;
  changed();
}
system.addEventListener("change", reset);

export function toggle() {
  root.dataset.theme = isDark() ? "light" : "dark";
  reset();
  try { localStorage.setItem("eddy-theme", root.dataset.theme); } catch { /* private windows store nothing */ }
}
try {
  const kept = localStorage.getItem("eddy-theme");
  if (kept === "light" || kept === "dark") root.dataset.theme = kept;
} catch { /* the same */ }
