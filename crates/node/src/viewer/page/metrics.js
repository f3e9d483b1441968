// Metrics and counters as lists of names and values.

const $ = (id) => document.getElementById(id);
const duration = (seconds) =>
  seconds >= 1 ? `${seconds.toFixed(1)} s` : `${(1e3 * seconds).toFixed(seconds < 0.01 ? 2 : 1)} ms`;
const count = (number) => number.toLocaleString("en");

/** Fills a description list. */
export function rows(list, entries) {
  list.replaceChildren(...entries.flatMap(([name, value]) => {
    const [term, text] = [document.createElement("dt"), document.createElement("dd")];
    term.textContent = name;
    text.textContent = value;
    text.dataset.name = name;
    return [term, text];
  }));
}

let before = null;
/** Frames observed a second; null if not known yet. */
function rate(metrics) {
  const time = performance.now();
  const last = before;
  if (!last || metrics.observed < last.metrics.observed) before = { time, metrics };
  if (!last || time - last.time < 200) return null;
  if (time - last.time > 2000) before = { time, metrics };
  return (1e3 * (metrics.observed - last.metrics.observed)) / (time - last.time);
}

/** Shows the metrics: `drawn` are the times at which frames were drawn. */
export function show(metrics, hello, frame, drawn) {
  const { node, page, skill } = metrics;
  const observed = rate(metrics);
  const span = drawn.length > 1 ? drawn.at(-1) - drawn[0] : 0;
  const drawnRate = span > 0 && performance.now() - drawn.at(-1) < 1000 ? (1e3 * (drawn.length - 1)) / span : 0;
  const entries = [];
  if (frame) entries.push(["particles", count(frame.particles)]);
  if (observed != null) entries.push(["frames observed", `${observed.toFixed(0)} /s`]);
  if (node) {
    entries.push(["predictions", `${node.rate.toFixed(0)} /s`]);
    entries.push(["latency p50, p99", node.rate > 0 ? `${duration(node.latency[0])}, ${duration(node.latency[1])}` : "-"]);
    entries.push(["frames lost by the node", count(node.lost)]);
    entries.push(["streams", count(node.streams)]);
  } else {
    entries.push(["streams", count(metrics.streams.length)]);
  }
  entries.push(["frames sent to this page", count(page.sent)]);
  entries.push(["frames skipped by this page", count(page.dropped + page.skipped)]);
  entries.push(["open pages", count(page.browsers)]);
  entries.push(["display rate", `${drawnRate.toFixed(0)} /s`]);
  if (hello?.model) entries.push(["model", hello.model.slice(0, 12)]);
  rows($("metrics"), entries);
  rows($("counters"), (node?.counters ?? []).map(([name, value]) => [name.replaceAll("_", " "), count(value)]));
  $("counters").parentElement.hidden = !node;
  const [number, words] = skillText(skill);
  banners(node);
  $("skill").hidden = !skill && !hello?.model;
  $("skill").querySelector("b").textContent = number;
  $("skill").querySelector("span").textContent = words;
}

/** What is said above the panels: why frames are rejected, and how the stream differs from the model's training. */
export function banners(node) {
  const rejected = node?.rejected ? `Frames are rejected, so nothing is predicted from them: ${node.rejected}` : "";
  for (const [id, text] of [["rejected", rejected], ["differs", (node?.warnings ?? []).join(". ")]]) {
    if ($(id).textContent !== text) $(id).textContent = text;
    $(id).hidden = !text;
  }
}

/** An error as text (domain lengths). */
const distance = (error) => (error >= 1e-3 ? error.toFixed(4) : error.toExponential(1).replace("-", "−"));

/** Skill as text: the number and its description. */
export function skillText(skill) {
  if (!skill) return ["", "no prediction can be compared yet"];
  // A bag without statuses does not say what its predictions were made from.
  if (skill.horizon === 0) return ["–", "skill: frames ahead unknown"];
  const ahead = `${skill.horizon} ${skill.horizon === 1 ? "frame" : "frames"} ahead`;
  if (skill.value == null && skill.baseline) return ["at rest", `error ${ahead} ${distance(skill.error)}`];
  if (skill.value == null) return ["–", `skill ${ahead}: no baseline; error ${distance(skill.error)}`];
  const value = Math.abs(skill.value) < 100 ? skill.value.toFixed(2) : skill.value.toFixed(0);
  return [`${skill.value >= 0 ? "+" : ""}${value}`.replace("-", "−"), `skill ${ahead}: error ${distance(skill.error)}, ${skill.baseline} ${distance(skill.baseline_error)}`];
}
