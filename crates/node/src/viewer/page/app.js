// The live page: shows what the program sends, and sends it the commands of the user.

import { draw as drawChart } from "/chart.js";
import { read } from "/frame.js";
import { Link } from "/link.js";
import { Painter, scaleStart } from "/painter.js";

const $ = (id) => document.getElementById(id);
const root = document.documentElement;

/** The state of the page. */
const now = {
  hello: null, metrics: null, frame: null, next: null, undrawn: 0,
  state: {}, pending: 0, until: 0,
  held: false, steps: 0, dirty: true, drawn: [], available: new Set(), curves: null,
};
const view = { over: false, colour: "material" };

// --- colours

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
const system = matchMedia("(prefers-color-scheme: dark)");
const isDark = () => (root.dataset.theme ?? (system.matches ? "dark" : "light")) === "dark";
let theme = null;
function colours() {
  theme ??= {
    background: components("--plot"), plain: components("--ghost"), dark: isDark(),
    chart: {
      ink: solid("--ink"), muted: solid("--muted"), line: solid("--line"),
      model: solid("--accent"), baseline: solid("--warm"),
    },
  };
  return theme;
}
function resetTheme() {
  theme = null;
  now.dirty = true;
  drawLegend();
  drawCurves();
}
system.addEventListener("change", resetTheme);
function toggleTheme() {
  root.dataset.theme = isDark() ? "light" : "dark";
  resetTheme();
  try { localStorage.setItem("eddy-theme", root.dataset.theme); } catch { /* private windows store nothing */ }
}
try {
  const kept = localStorage.getItem("eddy-theme");
  if (kept === "light" || kept === "dark") root.dataset.theme = kept;
} catch { /* the same */ }

// --- the connection

let countdown = 0;
const link = new Link({
  opened() {
    clearInterval(countdown);
    connection("open", "connected");
    now.undrawn = now.pending = 0;
    now.next = null;
  },
  closed(wait) {
    clearInterval(countdown);
    const until = performance.now() + wait;
    const update = () => {
      const left = Math.max(0, (until - performance.now()) / 1000);
      connection("closed", `connection lost, retrying in ${left.toFixed(1)} s`);
    };
    update();
    countdown = setInterval(update, 100);
  },
  message(message) {
    if (message.type === "hello") start(message);
    else if (message.type === "metrics") show(message);
    else if (message.type === "outcome") {
      if (!message.done) notify(`${message.of.replace("_", " ")}: ${message.message}`);
      else if (message.message) notify(message.message);
      now.pending = Math.max(0, now.pending - 1);
      if (isSettled()) showState(message.state);
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

/** Requests as many frames as were drawn. A page that is hidden, or holds its view, requests and receives none. */
function acknowledge() {
  if (now.undrawn) link.send({ drawn: now.undrawn });
  now.undrawn = 0;
}

let notifying = 0;
function notify(text) {
  $("message").textContent = text;
  $("message").classList.add("shown");
  clearTimeout(notifying);
  notifying = setTimeout(() => $("message").classList.remove("shown"), 4000);
}

function start(hello) {
  const restarted = now.hello && now.hello.instance !== hello.instance;
  now.hello = hello;
  now.available = new Set(hello.controls);
  $("title").textContent = hello.title;
  document.title = `eddy ${hello.command}`;
  for (const name of ["pause", "step", "reset", "publish_all", "free_run"]) $(name).hidden = !now.available.has(name);
  $("back").hidden = $("forward").hidden = !now.available.has("skip");
  $("rate-label").hidden = !now.available.has("rate");
  $("horizon-label").hidden = !now.available.has("horizon");
  const { horizon, free_run: freeRun } = hello.settings;
  [$("horizon").min, $("horizon").max] = horizon.range;
  $("horizon").title = `${horizon.help} (+, −)`;
  $("free_run").title = `${freeRun.help} (f)`;
  // The source of a node cannot be paused, but the view can be held.
  $("hold").hidden = now.available.has("pause");
  if ($("hold").hidden) hold(false);
  $("step").hidden = !(now.available.has("step") || now.held);
  if (restarted) {
    notify("the program was restarted");
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
  $("waiting").textContent = `${failure}: cannot draw particles`;
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
  // The truth is drawn larger, so that it is visible as a rim below the prediction.
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
    painter?.draw(now.frame, panels(), colours());
  }
}
requestAnimationFrame(tick);

function caption() {
  const frame = now.frame;
  const { truth, prediction } = frame;
  const when = (side) => (side.present ? `t = ${side.stamp.toFixed(2)} s, frame ${side.sequence}` : "");
  const frames = frame.horizon === 1 ? "frame" : "frames";
  const info = frame.horizon ? `, ${frame.horizon} ${frames} ahead${frame.freeRunning ? ", free run" : ""}` : "";
  $("truth").querySelector(".when").textContent = when(truth);
  const predicted = prediction.present ? when(prediction) + info : now.hello?.model ? "warming up" : "no prediction";
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

// --- metrics and curves

const duration = (seconds) =>
  seconds >= 1 ? `${seconds.toFixed(1)} s` : `${(1e3 * seconds).toFixed(seconds < 0.01 ? 2 : 1)} ms`;
const count = (number) => number.toLocaleString("en");
let before = null;

function rate(metrics) {
  const time = performance.now();
  const last = before;
  if (!last || metrics.observed < last.metrics.observed) before = { time, metrics };
  if (!last || time - last.time < 200) return null;
  if (time - last.time > 2000) before = { time, metrics };
  return (1e3 * (metrics.observed - last.metrics.observed)) / (time - last.time);
}

function rows(list, entries) {
  list.replaceChildren(...entries.flatMap(([name, value]) => {
    const [term, text] = [document.createElement("dt"), document.createElement("dd")];
    term.textContent = name;
    text.textContent = value;
    text.dataset.name = name;
    return [term, text];
  }));
}

function show(metrics) {
  now.metrics = metrics;
  now.curves = metrics.curves;
  const { node, page } = metrics;
  const observed = rate(metrics);
  const span = now.drawn.length > 1 ? now.drawn.at(-1) - now.drawn[0] : 0;
  const drawnRate = span > 0 && performance.now() - now.drawn.at(-1) < 1000 ? (1e3 * (now.drawn.length - 1)) / span : 0;
  const entries = [];
  if (now.frame) entries.push(["particles", count(now.frame.particles)]);
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
  if (now.hello?.model) entries.push(["model", now.hello.model.slice(0, 12)]);
  rows($("metrics"), entries);
  $("renderer").textContent = painter ? `renderer: ${painter.renderer}` : failure;
  rows($("counters"), (node?.counters ?? []).map(([name, value]) => [name.replaceAll("_", " "), count(value)]));

  if (isSettled()) showState(metrics.state);
  streams(metrics);
  drawCurves();
  if (view.colour === "speed") drawLegend();
}

/** Shows the state of the controls; while commands are pending, the state they will lead to. */
function showState(state) {
  now.state = state;
  const pressed = (id, on) => $(id).setAttribute("aria-pressed", String(Boolean(on)));
  pressed("pause", state.paused);
  $("pause").textContent = state.paused ? "Resume" : "Pause";
  pressed("free_run", state.free_run);
  pressed("publish_all", state.publish_all);
  if (state.horizon != null && document.activeElement !== $("horizon")) $("horizon").value = state.horizon;
  if (state.rate != null && document.activeElement !== $("rate")) choose($("rate"), String(state.rate), `${state.rate.toFixed(2)}×`);
}

/** Selects a value, and adds it to the options if necessary. */
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
  const curves = now.curves ?? { time: [], horizon: [], baseline: null };
  const { chart } = colours();
  const { baseline } = curves;
  const time = drawChart($("error-time"), curves.time, { unit: "s", baseline, colours: chart, gap: 0.5 });
  $("error-time").setAttribute("aria-label", `Error over time: ${time}`);
  $("horizon-card").hidden = curves.horizon.length < 2;
  if (curves.horizon.length >= 2) {
    const horizon = drawChart($("error-horizon"), curves.horizon, { unit: "frames ahead", baseline, colours: chart, decimals: 0 });
    $("error-horizon").setAttribute("aria-label", `Error by horizon: ${horizon}`);
  }
}
addEventListener("resize", () => { now.dirty = true; drawCurves(); });

// --- commands

const TIMEOUT = 7000; // ms, after which an outcome is considered lost
/** Whether no command is pending. */
const isSettled = () => now.pending === 0 || performance.now() > now.until;
/** Sends a command that leads to the state `then`. */
function send(name, more = {}, then = {}) {
  if (!link.send({ do: name, ...more })) return notify("not connected");
  now.pending += 1;
  now.until = performance.now() + TIMEOUT;
  showState({ ...now.state, ...then });
}
function toggle(name) {
  if (!now.available.has(name)) return;
  const on = now.state[name];
  if (on == null) notify(`${name.replace("_", " ")}: state not known yet`);
  else send(name, { on: !on }, { [name]: !on });
}
function pause(paused) {
  send(paused ? "pause" : "resume", {}, { paused });
}
function hold(held) {
  now.held = held;
  now.steps = 0;
  $("hold").setAttribute("aria-pressed", String(held));
  $("step").hidden = !(now.available.has("step") || held);
}
const actions = {
  pause() {
    if (now.available.has("pause")) pause(!now.state.paused);
    else hold(!now.held);
  },
  step() {
    if (now.held) now.steps += 1;
    else if (now.available.has("step")) {
      if (!now.state.paused) pause(true);
      send("step");
    }
  },
  reset: () => now.available.has("reset") && send("reset"),
  free_run: () => toggle("free_run"),
  publish_all: () => toggle("publish_all"),
  horizon(frames) {
    if (!now.available.has("horizon")) return;
    const wanted = Math.round(frames);
    const [min, max] = now.hello.settings.horizon.range;
    if (wanted >= min && wanted <= max) send("horizon", { frames: wanted }, { horizon: wanted });
    else notify(`horizon: found ${frames}, expected ${min} to ${max}`);
  },
  longer: (by) => actions.horizon(Math.max(1, (now.state.horizon ?? 1) + by)),
  skip: (seconds) => now.available.has("skip") && send("skip", { seconds }),
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
$("forward").addEventListener("click", () => actions.skip(5));
$("horizon").addEventListener("change", (event) => actions.horizon(Number(event.target.value)));
$("rate").addEventListener("change", (event) => {
  const rate = Number(event.target.value);
  send("rate", { rate }, { rate });
});
$("view").addEventListener("change", () => actions.view());
$("colour").addEventListener("change", (event) => actions.colour(event.target.value));
$("stream").addEventListener("change", (event) => link.send({ select: event.target.value || null }));

const KEYS = [
  [" ", "space", "pause or resume", () => actions.pause()],
  ["ArrowRight", "→", "advance by one frame", () => actions.step()],
  ["r", "r", "reset all streams", () => actions.reset()],
  ["f", "f", "free run on or off", () => actions.free_run()],
  ["+", "+", "horizon + 1 frame", () => actions.longer(1)],
  ["-", "−", "horizon − 1 frame", () => actions.longer(-1)],
  ["o", "o", "side by side or overlaid", () => actions.view()],
  ["c", "c", "next colour mode", () => actions.colour()],
  ["t", "t", "light or dark", () => actions.theme()],
  ["?", "?", "these keys", () => actions.help()],
];
rows($("key-list"), KEYS.map(([, shown, what]) => [shown, what]));
addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const { target } = event;
  if (target.closest("input, select, dialog")) return;
  // The space bar presses a focused button.
  if (event.key === " " && target.closest("button, summary")) return;
  const found = KEYS.find(([key]) => key === event.key);
  if (!found) return;
  event.preventDefault();
  found[3]();
});
drawCurves();
