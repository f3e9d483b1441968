// A picture of the panels as they are shown, with captions, legend and title.

const MARGIN = 16;
const LINE = 22;

/** Draws `stage` (its canvas must have been drawn in this task); `lines` are written below, `legend` draws itself. */
export function compose(stage, canvas, lines, legend, { ink, muted, line, paper }) {
  const density = devicePixelRatio || 1;
  const box = stage.getBoundingClientRect();
  const panels = [...stage.querySelectorAll(".panel")].filter((panel) => panel.clientWidth > 0);
  const plots = panels.map((panel) => panel.querySelector(".plot").getBoundingClientRect());
  const left = Math.min(...plots.map((plot) => plot.left)) - box.left;
  const right = Math.max(...plots.map((plot) => plot.right)) - box.left;
  const width = right - left + 2 * MARGIN;
  const height = box.height + (lines.length + 1) * LINE + 2 * MARGIN + 6;
  const picture = document.createElement("canvas");
  Object.assign(picture, { width: Math.round(width * density), height: Math.round(height * density) });
  const pen = picture.getContext("2d");
  pen.scale(density, density);
  pen.fillStyle = paper;
  pen.fillRect(0, 0, width, height);
  pen.textBaseline = "middle";
  panels.forEach((panel, which) => {
    const plot = plots[which];
    const [x, y] = [plot.left - box.left - left + MARGIN, plot.top - box.top + MARGIN];
    const source = [plot.left - box.left, plot.top - box.top, plot.width, plot.height].map((length) => length * density);
    pen.drawImage(canvas, ...source, x, y, plot.width, plot.height);
    pen.strokeStyle = line;
    pen.strokeRect(x + 0.5, y + 0.5, plot.width - 1, plot.height - 1);
    const [name, when] = [panel.querySelector("b").textContent, panel.querySelector(".when").textContent];
    pen.font = "600 14px system-ui, sans-serif";
    pen.fillStyle = ink;
    pen.fillText(name, x, y - 13);
    const after = x + pen.measureText(name).width + 10;
    pen.font = "13px system-ui, sans-serif";
    pen.fillStyle = muted;
    pen.fillText(when, after, y - 13, plot.right - box.left - left + MARGIN - after);
  });
  pen.font = "13px system-ui, sans-serif";
  let y = MARGIN + box.height + LINE / 2 + 6;
  legend(pen, MARGIN, y, ink);
  pen.fillStyle = muted;
  for (const text of lines) {
    y += LINE;
    pen.fillText(text, MARGIN, y, width - 2 * MARGIN);
  }
  return picture;
}

/** Saves a canvas as a PNG. */
export function save(picture, name) {
  return new Promise((resolve) => {
    picture.toBlob((blob) => {
      const address = URL.createObjectURL(blob);
      const anchor = document.createElement("a");
      Object.assign(anchor, { href: address, download: name });
      anchor.click();
      setTimeout(() => URL.revokeObjectURL(address), 10_000);
      resolve();
    }, "image/png");
  });
}
