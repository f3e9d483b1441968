// The legend: materials as named dots, or the colour scale between two limits that can be typed.

import { colourAt, shortNumber } from "/scale.js";

const $ = (id) => document.getElementById(id);

export class Legend {
  /** `scales` by property; `changed` is called after a limit was typed, `notify` with a message for the user. */
  constructor(scales, changed, notify) {
    this.scales = scales;
    this.scale = null;
    ["low", "high"].forEach((id, end) => {
      $(id).addEventListener("change", () => {
        const problem = this.type(end, $(id).value.trim());
        if (problem) notify(problem);
        this.limits(true);
        changed();
      });
      $(id).addEventListener("keydown", (event) => event.key === "Enter" && $(id).blur());
    });
    $("auto").addEventListener("click", () => {
      this.scale.typed = [null, null];
      this.limits(true);
      changed();
    });
  }

  /** Sets a limit; nothing makes it automatic again. Returns what is wrong with it. */
  type(end, text) {
    const typed = [...this.scale.typed];
    typed[end] = text === "" ? null : Number(text.replace(",", "."));
    if (text !== "") {
      const problem = Number.isFinite(typed[end]) ? this.scale.problemWith(typed[end]) : "expected a number";
      if (problem) return `colour limit: found ${text}, ${problem}`;
      const other = typed[1 - end] ?? this.scale.limits[1 - end];
      if (end === 0 ? typed[0] >= other : typed[1] <= other) {
        return `colour limits: found ${end === 0 ? text : shortNumber(other)} to ${end === 0 ? shortNumber(other) : text}, expected the lower one first`;
      }
    }
    this.scale.typed = typed;
    return "";
  }

  /** Shows dots `[colour, name]`, and the scale of a property if it has one. */
  show(property, dots, table, dark) {
    this.scale = this.scales[property] ?? null;
    this.dots = dots;
    $("scale").hidden = !this.scale;
    $("swatches").replaceChildren(...dots.map(([colour, name]) => {
      const [entry, dot] = [document.createElement("span"), document.createElement("i")];
      dot.style.background = colour;
      entry.append(dot, name);
      return entry;
    }));
    if (!this.scale) return;
    $("unit").textContent = this.scale.unit;
    this.bar($("bar").getContext("2d"), 0, 0, $("bar").width, $("bar").height, table, dark);
    this.limits(false);
  }

  bar(pen, left, top, width, height, table, dark) {
    for (let column = 0; column < width; column++) {
      pen.fillStyle = colourAt(table, column / (width - 1), dark);
      pen.fillRect(left + column, top, 1, height);
    }
  }

  /** Shows the present limits, also in a field that has the focus if `all`. */
  limits(all) {
    if (!this.scale) return;
    this.scale.limits.forEach((limit, end) => {
      const field = $(["low", "high"][end]);
      if (all || document.activeElement !== field) field.value = shortNumber(limit);
      field.dataset.typed = String(this.scale.typed[end] != null);
    });
    $("auto").setAttribute("aria-pressed", String(!this.scale.isTyped));
  }

  /** Draws the legend on a canvas, from `left` at the middle height `y`. */
  draw(pen, left, y, table, dark, ink) {
    let at = left;
    const word = (text) => {
      pen.fillStyle = ink;
      pen.fillText(text, at, y);
      at += pen.measureText(text).width;
    };
    if (this.scale) {
      const [low, high] = this.scale.limits.map(shortNumber);
      word(low);
      this.bar(pen, Math.round(at + 8), y - 5, 120, 10, table, dark);
      at += 136;
      word(`${high} ${this.scale.unit}`);
      at += 20;
    }
    for (const [colour, name] of this.dots ?? []) {
      pen.fillStyle = colour;
      pen.beginPath();
      pen.arc(at + 6, y, 5.5, 0, 7);
      pen.fill();
      at += 18;
      word(name);
      at += 16;
    }
  }
}
