// The keys of the page.

import { rows } from "/metrics.js";

/** Key, its name in the list (none if another line names it), what it does, and the action with its arguments. */
const KEYS = [
  [" ", "space", "pause or resume", "pause"],
  ["ArrowRight", "→", "advance by one frame", "right"],
  ["ArrowLeft", "←", "go back one frame in the timeline", "left"],
  ["ArrowUp", "← → ↑ ↓", "move the tool, if there is one that follows the mouse", "up"],
  ["ArrowDown", "", "", "down"],
  ["End", "End", "the newest frame", "live"],
  ["r", "r", "reset all streams", "reset"],
  ["f", "f", "free run on or off", "free_run"],
  ["+", "+", "horizon + 1 frame", "longer", 1],
  ["-", "−", "horizon − 1 frame", "longer", -1],
  ["o", "o", "side by side or overlaid", "view"],
  ["c", "c", "next colour mode", "colour"],
  ["z", "z", "zoom in", "zoom", 1.25],
  ["Z", "shift z", "zoom out", "zoom", 0.8],
  ["0", "0", "show the whole domain", "unzoom"],
  ["shift ArrowLeft", "shift ← → ↑ ↓", "pan", "pan", -1, 0],
  ["shift ArrowRight", "", "", "pan", 1, 0],
  ["shift ArrowUp", "", "", "pan", 0, 1],
  ["shift ArrowDown", "", "", "pan", 0, -1],
  ["p", "p", "save a picture", "picture"],
  ["t", "t", "light or dark", "theme"],
  ["?", "?", "controls and keys", "help"],
];
/** Keys that a slider handles itself. */
const SLIDER_KEYS = ["ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown", "Home", "End", "PageUp", "PageDown"];

/** Lists the keys, and performs the actions of those that are pressed. */
export function listen(actions) {
  rows(document.getElementById("key-list"), KEYS.filter(([, shown]) => shown).map(([, shown, what]) => [shown, what]));
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const { target, key } = event;
    const isFree = target.type === "range" && !SLIDER_KEYS.includes(key);
    if (target.closest("input, select, dialog") && !isFree) return;
    // The space bar presses a focused button.
    if (key === " " && target.closest("button, summary")) return;
    const pressed = event.shiftKey && key.startsWith("Arrow") ? `shift ${key}` : key;
    const found = KEYS.find(([one]) => one === pressed);
    if (!found) return;
    event.preventDefault();
    const [, , , action, ...more] = found;
    actions[action](...more);
  });
}
