// Two curves on a logarithmic axis: the error of the model and of the best trivial predictor.

const MARGIN = { left: 46, right: 12, top: 22, bottom: 40 };

/** A power of ten as text: 10⁻⁴. */
function power(exponent) {
  const digits = "⁰¹²³⁴⁵⁶⁷⁸⁹";
  return `10${exponent < 0 ? "⁻" : ""}${[...String(Math.abs(exponent))].map((digit) => digits[digit]).join("")}`;
}

/** The step of an axis, 1, 2 or 5 times a power of ten, for about `parts` parts of `span`. */
function nice(span, parts) {
  const rough = span / parts;
  const ten = 10 ** Math.floor(Math.log10(rough));
  return ten * [1, 2, 5, 10].find((step) => step * ten >= rough);
}

/**
 * `rows` are [x, model, baseline or null], `title` that of the horizontal axis, `mark` a place on it. Returns a
 * description of the last row.
 */
export function draw(canvas, rows, { title, baseline, colours, decimals = 1, gap = Infinity, mark = null }) {
  const density = devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  if (!width) return "";
  if (canvas.width !== Math.round(width * density)) canvas.width = Math.round(width * density);
  if (canvas.height !== Math.round(height * density)) canvas.height = Math.round(height * density);
  const pen = canvas.getContext("2d");
  pen.setTransform(density, 0, 0, density, 0, 0);
  pen.clearRect(0, 0, width, height);
  pen.font = "12px system-ui, sans-serif";
  const values = rows.flatMap(([, model, best]) => [model, best]).filter((value) => value > 0);
  if (rows.length < 2 || !values.length) {
    pen.fillStyle = colours.muted;
    pen.textAlign = "center";
    pen.fillText("no prediction can be compared yet", width / 2, height / 2);
    return "no data yet";
  }
  // Errors below 1e-6 are rounding errors.
  let low = Math.max(-6, Math.floor(Math.log10(Math.min(...values))));
  let high = Math.max(low + 1, Math.ceil(Math.log10(Math.max(...values))));
  const [first, last] = [rows[0][0], rows.at(-1)[0]];
  const x = (value) => MARGIN.left + (width - MARGIN.left - MARGIN.right) * (value - first) / (last - first || 1);
  const y = (value) => {
    const share = (Math.log10(Math.max(value, 10 ** low)) - low) / (high - low);
    return height - MARGIN.bottom - (height - MARGIN.top - MARGIN.bottom) * share;
  };
  pen.lineWidth = 1;
  pen.strokeStyle = colours.line;
  pen.fillStyle = colours.muted;
  pen.textAlign = "right";
  pen.textBaseline = "middle";
  for (let exponent = low; exponent <= high; exponent++) {
    const at = Math.round(y(10 ** exponent)) + 0.5;
    pen.beginPath();
    pen.moveTo(MARGIN.left, at);
    pen.lineTo(width - MARGIN.right, at);
    pen.stroke();
    pen.fillText(power(exponent), MARGIN.left - 7, at);
  }
  pen.textAlign = "center";
  pen.textBaseline = "alphabetic";
  const step = Math.max(nice(last - first || 1, Math.max(4, width / 110)), decimals ? 0 : 1);
  const digits = step < 1 ? Math.max(decimals, Math.ceil(-Math.log10(step) - 1e-9)) : 0;
  for (let value = Math.ceil(first / step) * step; value <= last + 1e-9; value += step) {
    pen.fillText(`${value.toFixed(digits)}`, x(value), height - MARGIN.bottom + 17);
  }
  pen.fillText(title, MARGIN.left + (width - MARGIN.left - MARGIN.right) / 2, height - 6);
  if (mark != null && mark >= first && mark <= last) {
    pen.strokeStyle = colours.muted;
    pen.beginPath();
    pen.moveTo(x(mark), MARGIN.top);
    pen.lineTo(x(mark), height - MARGIN.bottom);
    pen.stroke();
  }

  const curve = (column, colour, dashes) => {
    pen.strokeStyle = colour;
    pen.lineWidth = 2;
    pen.lineJoin = "round";
    pen.setLineDash(dashes);
    pen.beginPath();
    let before = null;
    for (const row of rows) {
      if (row[column] == null) { before = null; continue; }
      const connected = before !== null && row[0] - before <= gap;
      if (connected) pen.lineTo(x(row[0]), y(row[column]));
      else pen.moveTo(x(row[0]), y(row[column]));
      before = row[0];
    }
    pen.stroke();
    pen.setLineDash([]);
  };
  curve(2, colours.baseline, [6, 4]);
  curve(1, colours.model, []);

  pen.textAlign = "left";
  let at = MARGIN.left;
  const best = width > 420 && baseline ? `best trivial: ${baseline}` : "best trivial";
  for (const [name, colour, dashes] of [["model", colours.model, []], [best, colours.baseline, [6, 4]]]) {
    pen.strokeStyle = colour;
    pen.setLineDash(dashes);
    pen.beginPath();
    pen.moveTo(at, 9);
    pen.lineTo(at + 22, 9);
    pen.stroke();
    pen.setLineDash([]);
    pen.fillStyle = colours.ink;
    pen.fillText(name, at + 28, 13);
    at += 44 + pen.measureText(name).width;
  }
  const [, model, other] = rows.at(-1);
  return `error ${model.toExponential(1)}${other == null ? "" : `, best trivial ${other.toExponential(1)}`}`;
}
