// The page: what the program says is shown, what the user wants is said to the program.

import { draw as drawChart } from "/chart.js";
import { read } from "/frame.js";
import { Link } from "/link.js";
import { Painter, scaleStart } from "/painter.js";

const $ = (id) => document.getElementById(id);
const root = document.documentElement;

/** What is known now. */
const now = {
  hello: null, figures: null, frame: null, next: null, undrawn: 0,
  state: {}, asked: 0, until: 0,
  held: false, steps: 0, dirty: true, drawn: [], offered: new Set(), curves: null,
};
const view = { over: false, colour: "material" };

// --- colours

const probe = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
/** A colour of the style sheet as numbers from 0 to 1. */
function numbers(name) {
  const element = document.createElement("i");
  element.style.color = `var(${name})`;
  root.append(element);
  probe.fillStyle = getComputedStyle(element).color;
  element.remove();
  probe.fillRect(0, 0, 1, 1);
  return [...probe.getImageData(0, 0, 1, 1).data].slice(0, 3).map((part) => part / 255);
}
/** The same as a colour for a canvas. */
const solid = (name) => `rgb(${numbers(name).map((part) => Math.round(255 * part)).join(" ")})`;
const system = matchMedia("(prefers-color-scheme: dark)");
const isDark = () => (root.dataset.theme ?? (system.matches ? "dark" : "light")) === "dark";
let theme = null;
function dressed() {
  theme ??= {
    ground: numbers("--plot"), plain: numbers("--ghost"), dark: isDark(),
    chart: {
      ink: solid("--ink"), soft: solid("--soft"), line: solid("--line"),
      model: solid("--accent"), baseline: solid("--warm"),
    },
  };
  return theme;
}
function undress() {
  theme = null;
  now.dirty = true;
  drawLegend();
  drawCurves();
}
system.addEventListener("change", undress);
function toggleTheme() {
  root.dataset.theme = isDark() ? "light" : "dark";
  undress();
  try { localStorage.setItem("eddy-theme", root.dataset.theme); } catch { /* private windows keep nothing */ }
}
try {
  const kept = localStorage.getItem("eddy-theme");
  if (kept === "light" || kept === "dark") root.dataset.theme = kept;
} catch { /* likewise */ }

// --- the connection

let counting = 0;
const link = new Link({
  opened() {
    clearInterval(counting);
    connection("open", "connected");
    now.undrawn = now.asked = 0;
    now.next = null;
  },
  closed(wait) {
    clearInterval(counting);
    const until = performance.now() + wait;
    const tell = () => {
      const left = Math.max(0, (until - performance.now()) / 1000);
      connection("closed", `connection lost, trying again in ${left.toFixed(1)} s`);
    };
    tell();
    counting = setInterval(tell, 100);
  },
  words(words) {
    if (words.type === "hello") greet(words);
    else if (words.type === "figures") show(words);
    else if (words.type === "outcome") {
      if (!words.done) say(`${words.of.replace("_", " ")}: ${words.said}`);
      else if (words.said) say(words.said);
      now.asked = Math.max(0, now.asked - 1);
      if (isSettled()) showState(words.state);
    }
  },
  frame(buffer) {
    const frame = read(buffer);
    now.undrawn += 1;
    if (!frame) return acknowledge();
    now.next = frame;
  },
});

function connection(state, text) {
  if ($("connection").dataset.state !== state || $("connection").textContent !== text) {
    $("connection").dataset.state = state;
    $("connection").textContent = text;
  }
}

/** There is room for as many more. A page that is hidden, or holds its view, says nothing and is sent nothing. */
function acknowledge() {
  if (now.undrawn) link.say({ drawn: now.undrawn });
  now.undrawn = 0;
}

let saying = 0;
function say(text) {
  $("said").textContent = text;
  $("said").classList.add("shown");
  clearTimeout(saying);
  saying = setTimeout(() => $("said").classList.remove("shown"), 4000);
}

function greet(hello) {
  const restarted = now.hello && now.hello.instance !== hello.instance;
  now.hello = hello;
  now.offered = new Set(hello.controls);
  $("title").textContent = hello.title;
  document.title = `eddy ${hello.command}`;
  for (const name of ["pause", "step", "reset", "publish_all", "free_run"]) $(name).hidden = !now.offered.has(name);
  $("back").hidden = $("on").hidden = !now.offered.has("skip");
  $("rate-label").hidden = !now.offered.has("rate");
  $("horizon-label").hidden = !now.offered.has("horizon");
  // Where the source is elsewhere, the view is what can be held.
  $("hold").hidden = now.offered.has("pause");
  if ($("hold").hidden) hold(false);
  $("step").hidden = !(now.offered.has("step") || now.held);
  if (restarted) {
    say("the program was restarted");
    now.frame = now.curves = null;
    now.dirty = true;
    drawCurves();
  }
  painter?.colours(hello.materials.map((material) => material.color), hello.scale);
  drawLegend();
}

// --- particles

let painter = null;
let failure = "";
try {
  painter = new Painter($("particles"), () => { now.dirty = true; });
} catch (error) {
  failure = error.message;
  $("waiting").textContent = `${failure}: particles cannot be drawn`;
}

function panels() {
  const layers = (side) => [{ side, colouring: view.colour }];
  const plot = (id) => $(id).querySelector(".plot");
  if (!view.over) {
    return [
      { element: plot("truth"), layers: layers("truth") },
      { element: plot("prediction"), layers: layers("prediction") },
    ];
  }
  // The truth shows as a rim where the prediction covers it, and whole where it does not.
  const below = { side: "truth", colouring: "plain", growth: 1.5 };
  return [{ element: plot("prediction"), layers: [below, { side: "prediction", colouring: view.colour, growth: 0.8 }] }];
}

function tick(time) {
  requestAnimationFrame(tick);
  const wanted = now.next && (!now.held || now.steps > 0);
  if (wanted) {
    now.frame = now.next;
    now.next = null;
    if (now.held) now.steps -= 1;
    acknowledge();
    now.drawn.push(time);
    now.dirty = true;
    caption();
  }
  while (now.drawn.length && now.drawn[0] < time - 2000) now.drawn.shift();
  if (now.dirty) {
    now.dirty = false;
    painter?.draw(now.frame, panels(), dressed());
  }
}
requestAnimationFrame(tick);

function caption() {
  const frame = now.frame;
  const { truth, prediction } = frame;
  const when = (side) => (side.there ? `t = ${side.stamp.toFixed(2)} s, frame ${side.sequence}` : "");
  const ahead = frame.ahead ? `, ${frame.ahead} ahead${frame.free ? ", free run" : ""}` : "";
  $("truth").querySelector(".when").textContent = when(truth);
  const predicted = prediction.there ? when(prediction) + ahead : now.hello?.model ? "warming up" : "no prediction";
  $("prediction").querySelector(".when").textContent = predicted;
  const aspect = (frame.upper[0] - frame.lower[0]) / (frame.upper[1] - frame.lower[1]);
  $("stage").style.setProperty("--aspect", Math.min(Math.max(aspect, 0.5), 4));
  $("waiting").hidden = !failure;
}

function drawLegend() {
  const { hello } = now;
  if (!hello) return;
  const legend = $("legend");
  const svg = (width, height, content) => {
    const holder = document.createElement("span");
    holder.innerHTML = `<svg width="${width}" height="${height}" aria-hidden="true">${content}</svg>`;
    return holder;
  };
  const css = (parts) => `rgb(${parts.join(",")})`;
  const entries = [];
  const named = (fill, text) => {
    const entry = svg(12, 12, `<circle cx="6" cy="6" r="5.5" fill="${fill}"/>`);
    entry.append(text);
    entries.push(entry);
  };
  if (view.colour === "material") {
    for (const { name, color } of hello.materials) named(css(color), name);
  } else {
    const from = scaleStart(isDark());
    const at = (share) => {
      const place = (from + (1 - from) * share) * 8;
      const below = Math.min(Math.floor(place), 7);
      return css([0, 1, 2].map((part) => Math.round(
        hello.scale[below][part] + (hello.scale[below + 1][part] - hello.scale[below][part]) * (place - below))));
    };
    const bars = Array.from({ length: 60 }, (_, i) => `<rect x="${3 * i}" width="3.5" height="10" fill="${at(i / 59)}"/>`);
    const [low, high] = view.colour === "speed"
      ? ["0", `${(now.frame?.topSpeed ?? 0).toFixed(1)} domain lengths/s`]
      : [hello.errors[0].toExponential(0), `${hello.errors[1].toExponential(0)} domain lengths, logarithmic`];
    const entry = svg(180, 10, bars.join(""));
    entry.prepend(low);
    entry.append(high);
    entries.push(entry);
  }
  if (view.over) named(solid("--ghost"), "truth, below the prediction");
  legend.replaceChildren(...entries);
}

// --- figures and curves

const duration = (seconds) =>
  seconds >= 1 ? `${seconds.toFixed(1)} s` : `${(1e3 * seconds).toFixed(seconds < 0.01 ? 2 : 1)} ms`;
const count = (number) => number.toLocaleString("en");
let before = null;

function rate(figures) {
  const time = performance.now();
  const last = before;
  if (!last || figures.observed < last.figures.observed) before = { time, figures };
  if (!last || time - last.time < 200) return null;
  if (time - last.time > 2000) before = { time, figures };
  return (1e3 * (figures.observed - last.figures.observed)) / (time - last.time);
}

function rows(list, entries) {
  list.replaceChildren(...entries.flatMap(([name, value]) => {
    const [term, said] = [document.createElement("dt"), document.createElement("dd")];
    term.textContent = name;
    said.textContent = value;
    said.dataset.name = name;
    return [term, said];
  }));
}

function show(figures) {
  now.figures = figures;
  now.curves = figures.curves;
  const { node, page } = figures;
  const observed = rate(figures);
  const span = now.drawn.length > 1 ? now.drawn.at(-1) - now.drawn[0] : 0;
  const drawnRate = span > 0 && performance.now() - now.drawn.at(-1) < 1000 ? (1e3 * (now.drawn.length - 1)) / span : 0;
  const entries = [];
  if (now.frame) entries.push(["particles", count(now.frame.particles)]);
  if (observed != null) entries.push(["frames observed", `${observed.toFixed(0)} /s`]);
  if (node) {
    entries.push(["predictions", `${node.rate.toFixed(0)} /s`]);
    entries.push(["latency p50, p99", node.rate > 0 ? `${duration(node.latency[0])}, ${duration(node.latency[1])}` : "-"]);
    entries.push(["frames the node lost", count(node.lost)]);
    entries.push(["streams", count(node.streams)]);
  } else {
    entries.push(["streams", count(figures.streams.length)]);
  }
  entries.push(["sent to this page", count(page.sent)]);
  entries.push(["dropped for this page", count(page.dropped + page.skipped)]);
  entries.push(["pages", count(page.browsers)]);
  entries.push(["drawn here", `${drawnRate.toFixed(0)} /s`]);
  if (now.hello?.model) entries.push(["model", now.hello.model.slice(0, 12)]);
  rows($("figures"), entries);
  $("renderer").textContent = painter ? `drawn by ${painter.renderer}` : failure;
  rows($("counters"), (node?.counters ?? []).map(([name, value]) => [name.replaceAll("_", " "), count(value)]));

  if (isSettled()) showState(figures.state);
  streams(figures);
  drawCurves();
  if (view.colour === "speed") drawLegend();
}

/** How the program is set; while commands are on their way, how it will be set. */
function showState(state) {
  now.state = state;
  const pressed = (id, on) => $(id).setAttribute("aria-pressed", String(Boolean(on)));
  pressed("pause", state.paused);
  $("pause").textContent = state.paused ? "Go on" : "Pause";
  pressed("free_run", state.free_run);
  pressed("publish_all", state.publish_all);
  if (state.horizon != null && document.activeElement !== $("horizon")) $("horizon").value = state.horizon;
  if (state.rate != null && document.activeElement !== $("rate")) choose($("rate"), String(state.rate), `${state.rate.toFixed(2)}×`);
}

/** Selects a value, which becomes an option if it is none. */
function choose(select, value, text) {
  if (![...select.options].some((option) => option.value === value)) select.add(new Option(text, value));
  select.value = value;
}

function streams({ streams: all, stream, following }) {
  $("stream-label").hidden = all.length < 2 && following;
  const wanted = ["", ...all];
  const select = $("stream");
  const texts = wanted.map((id) => (id === "" ? `newest${following && stream != null ? ` (${stream})` : ""}` : id));
  if (select.dataset.shown !== texts.join()) {
    select.replaceChildren(...wanted.map((id, place) => new Option(texts[place], id)));
    select.dataset.shown = texts.join();
  }
  if (document.activeElement !== select) choose(select, following ? "" : stream, stream);
}

function drawCurves() {
  const curves = now.curves ?? { time: [], ahead: [], baseline: null };
  const { chart } = dressed();
  const { baseline } = curves;
  const time = drawChart($("error-time"), curves.time, { unit: "s", baseline, colours: chart, gap: 0.5 });
  $("error-time").setAttribute("aria-label", `Error as time passes: ${time}`);
  $("ahead-card").hidden = curves.ahead.length < 2;
  if (curves.ahead.length >= 2) {
    const ahead = drawChart($("error-ahead"), curves.ahead, { unit: "frames ahead", baseline, colours: chart, decimals: 0 });
    $("error-ahead").setAttribute("aria-label", `Error by frames ahead: ${ahead}`);
  }
}
addEventListener("resize", () => { now.dirty = true; drawCurves(); });

// --- what the user wants

const PATIENCE = 7000; // ms: an answer that has not come by then was lost
/** Whether nothing was asked for that changes what the program says of itself. */
const isSettled = () => now.asked === 0 || performance.now() > now.until;
/** Asks for something, after which the program will be set as in `then`. */
function does(name, more = {}, then = {}) {
  if (!link.say({ do: name, ...more })) return say("not connected");
  now.asked += 1;
  now.until = performance.now() + PATIENCE;
  showState({ ...now.state, ...then });
}
/** Turns on what is off, and off what is on. */
function toggle(name) {
  if (!now.offered.has(name)) return;
  const on = now.state[name];
  if (on == null) say(`${name.replace("_", " ")}: not known yet whether it is on`);
  else does(name, { on: !on }, { [name]: !on });
}
function pause(paused) {
  does(paused ? "pause" : "resume", {}, { paused });
}
function hold(held) {
  now.held = held;
  now.steps = 0;
  $("hold").setAttribute("aria-pressed", String(held));
  $("step").hidden = !(now.offered.has("step") || held);
}
const actions = {
  pause() {
    if (now.offered.has("pause")) pause(!now.state.paused);
    else hold(!now.held);
  },
  step() {
    if (now.held) now.steps += 1;
    else if (now.offered.has("step")) {
      if (!now.state.paused) pause(true);
      does("step");
    }
  },
  reset: () => now.offered.has("reset") && does("reset"),
  free_run: () => toggle("free_run"),
  publish_all: () => toggle("publish_all"),
  horizon(frames) {
    if (!now.offered.has("horizon")) return;
    const wanted = Math.round(frames);
    if (wanted >= 1 && wanted <= 10000) does("horizon", { frames: wanted }, { horizon: wanted });
    else say(`horizon: found ${frames}, expected 1 to 10000`);
  },
  longer: (by) => actions.horizon(Math.max(1, (now.state.horizon ?? 1) + by)),
  skip: (seconds) => now.offered.has("skip") && does("skip", { seconds }),
  view() {
    view.over = !view.over;
    $("view").value = view.over ? "over" : "beside";
    $("stage").dataset.view = $("view").value;
    $("prediction").querySelector("b").textContent = view.over ? "Truth and prediction" : "Prediction";
    now.dirty = true;
    drawLegend();
  },
  colour(to) {
    const all = ["material", "speed", "error"];
    view.colour = to ?? all[(all.indexOf(view.colour) + 1) % all.length];
    $("colour").value = view.colour;
    now.dirty = true;
    drawLegend();
  },
  theme: toggleTheme,
  help: () => ($("keys").open ? $("keys").close() : $("keys").showModal()),
};

for (const name of ["pause", "step", "reset", "free_run", "publish_all", "theme", "help"]) {
  $(name).addEventListener("click", () => actions[name]());
}
$("hold").addEventListener("click", () => actions.pause());
$("back").addEventListener("click", () => actions.skip(-5));
$("on").addEventListener("click", () => actions.skip(5));
$("horizon").addEventListener("change", (event) => actions.horizon(Number(event.target.value)));
$("rate").addEventListener("change", (event) => {
  const rate = Number(event.target.value);
  does("rate", { rate }, { rate });
});
$("view").addEventListener("change", () => actions.view());
$("colour").addEventListener("change", (event) => actions.colour(event.target.value));
$("stream").addEventListener("change", (event) => link.say({ select: event.target.value || null }));

const KEYS = [
  [" ", "space", "pause or go on", () => actions.pause()],
  ["ArrowRight", "→", "one frame", () => actions.step()],
  ["r", "r", "reset: forget every stream", () => actions.reset()],
  ["f", "f", "free run on or off", () => actions.free_run()],
  ["+", "+", "one frame farther ahead", () => actions.longer(1)],
  ["-", "−", "one frame less", () => actions.longer(-1)],
  ["o", "o", "overlaid or side by side", () => actions.view()],
  ["c", "c", "next colouring", () => actions.colour()],
  ["t", "t", "light or dark", () => actions.theme()],
  ["?", "?", "these keys", () => actions.help()],
];
rows($("key-list"), KEYS.map(([, shown, what]) => [shown, what]));
addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const { target } = event;
  if (target.closest("input, select, dialog")) return;
  // A button that has the focus is what the space bar means.
  if (event.key === " " && target.closest("button, summary")) return;
  const found = KEYS.find(([key]) => key === event.key);
  if (!found) return;
  event.preventDefault();
  found[3]();
});
drawCurves();
