// Values of plots under the pointer, and tables sorted by a click on a title. The page is complete without it.
"use strict";

const PLACES = 4; // significant digits

const tip = document.createElement("div");
tip.className = "tip";
tip.hidden = true;
tip.setAttribute("role", "status");
document.body.append(tip);

/** Reads the numbers of a plot; the format is described in `page::plot`. */
function readPlot(text) {
  const [x, y, ...series] = text.split("\n").map((line) => line.split("\t"));
  const axis = ([title, scale, ...ends]) => {
    const [from, to, low, high] = ends.map(Number);
    const place = (number) => (scale === "log" ? Math.log10(number) : number);
    return { title, pixel: (number) => from + ((to - from) * (place(number) - low)) / (high - low) };
  };
  const [across, up] = [axis(x), axis(y)];
  const curve = ([name, color, kind, numbers]) => {
    const points = numbers.split(" ").map((pair) => pair.split(",").map(Number));
    return { name, color, scattered: kind === "scatter", points };
  };
  return { across, up, curves: series.map(curve) };
}

const short = (number) => String(Number(number.toPrecision(PLACES)));

for (const svg of document.querySelectorAll("svg[data-plot]")) {
  const { across, up, curves } = readPlot(svg.dataset.plot);
  const scattered = curves.every((curve) => curve.scattered);
  const all = curves.flatMap((curve) => curve.points.map(([x, y]) => ({ x, y, curve })));
  const columns = [...new Set(all.map((point) => point.x))].sort((a, b) => a - b);
  const layer = document.createElementNS(svg.namespaceURI, "g");
  layer.setAttribute("class", "hover");
  svg.append(layer);
  svg.tabIndex = 0;
  let chosen = -1;

  const hide = () => {
    tip.hidden = true;
    layer.replaceChildren();
  };
  /** Shows points with the same x, or a single one. */
  const show = (points) => {
    if (points.length === 0) return hide();
    const marks = points.map(({ x, y, curve }) => {
      const mark = document.createElementNS(svg.namespaceURI, "circle");
      const place = { cx: across.pixel(x), cy: up.pixel(y), r: 9, fill: curve.color };
      for (const name in place) mark.setAttribute(name, place[name]);
      return mark;
    });
    layer.replaceChildren(...marks);
    const title = document.createElement("b");
    title.textContent = `${short(points[0].x)} ${across.title}`;
    const lines = points.map(({ y, curve }) => {
      const line = document.createElement("div");
      line.textContent = `${curve.name}: ${short(y)}`;
      line.style.borderColor = curve.color;
      return line;
    });
    tip.replaceChildren(title, ...lines);
    tip.hidden = false;
    const box = svg.getBoundingClientRect();
    const scale = box.width / svg.viewBox.baseVal.width;
    const at = box.left + across.pixel(points[0].x) * scale;
    const left = at + 14 + tip.offsetWidth > innerWidth ? at - 14 - tip.offsetWidth : at + 14;
    tip.style.left = `${Math.max(left, 4) + scrollX}px`;
    tip.style.top = `${box.top + scrollY + 8}px`;
  };
  const showColumn = (index) => {
    chosen = Math.min(Math.max(index, 0), columns.length - 1);
    const points = all.filter((point) => point.x === columns[chosen]);
    show(points.sort((a, b) => b.y - a.y));
  };
  /** Index of the smallest number. */
  const least = (numbers) => numbers.reduce((best, number, index) => (numbers[best] > number ? index : best), 0);
  svg.addEventListener("pointermove", (event) => {
    const box = svg.getBoundingClientRect();
    const scale = svg.viewBox.baseVal.width / box.width;
    const [x, y] = [(event.clientX - box.left) * scale, (event.clientY - box.top) * scale];
    if (scattered) show([all[least(all.map((point) => Math.hypot(across.pixel(point.x) - x, up.pixel(point.y) - y)))]]);
    else showColumn(least(columns.map((column) => Math.abs(across.pixel(column) - x))));
  });
  svg.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!step) return;
    event.preventDefault();
    if (scattered) {
      chosen = (chosen + step + all.length) % all.length;
      show([all[chosen]]);
    } else {
      showColumn(chosen + step);
    }
  });
  for (const end of ["pointerleave", "blur"]) svg.addEventListener(end, hide);
}

/** What a cell is sorted by: its number, or its text. */
function keyOf(cell) {
  const text = (cell?.textContent ?? "").trim().replace("−", "-");
  const number = text.match(/^[+-]?[\d.,]+(e[+-]?\d+)?/i);
  if (number) return Number(number[0].replaceAll(",", ""));
  return text === "" || text === "-" ? null : text;
}

for (const table of document.querySelectorAll(".table > table")) {
  const body = table.tBodies[0];
  // A row with those that belong to it; fixed rows stay where they are.
  const groups = [];
  for (const row of body.rows) {
    if (row.className === "detail" && groups.length) groups.at(-1).push(row);
    else groups.push([row]);
  }
  const isFixed = (group) => group[0].className === "fixed";
  const movable = groups.filter((group) => !isFixed(group));
  if (movable.length > 1) [...table.tHead.rows[0].cells].forEach((title, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.title = "Sort by this column";
    button.append(...title.childNodes);
    title.append(button);
    if (!button.textContent) button.setAttribute("aria-label", "name");
    button.addEventListener("click", () => {
      const before = title.getAttribute("aria-sort");
      const order = before === "ascending" ? "descending" : before === "descending" ? "none" : "ascending";
      for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
      if (order !== "none") title.setAttribute("aria-sort", order);
      const sign = order === "descending" ? -1 : 1;
      const compare = (one, other) => {
        const [a, b] = [one, other].map((group) => keyOf(group[0].cells[column]));
        // Missing numbers are last in either order.
        if (a === null || b === null) return (a === null) - (b === null);
        if (typeof a === typeof b && typeof a === "number") return sign * (a - b);
        return sign * String(a).localeCompare(String(b));
      };
      const sorted = order === "none" ? [...movable] : [...movable].sort(compare);
      body.append(...groups.map((group) => (isFixed(group) ? group : sorted.shift())).flat());
    });
  });
}
