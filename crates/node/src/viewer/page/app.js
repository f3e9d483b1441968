// The live page: shows what the program sends, and sends it the commands of the user.

import { Camera } from "/camera.js";
import { draw as drawChart } from "/chart.js";
import { aspectOf, read, timeOf, toolOf } from "/frame.js";
import { History } from "/history.js";
import { listen } from "/keys.js";
import { Legend } from "/legend.js";
import { Link } from "/link.js";
import { rows, show as showMetrics, skillText } from "/metrics.js";
import { Painter } from "/painter.js";
import { compose, save } from "/picture.js";
import { ErrorScale, SpeedScale } from "/scale.js";
import * as theme from "/theme.js";

const $ = (id) => document.getElementById(id);

/** The state of the page. */
const now = {
  hello: null, metrics: null, frame: null, next: null, undrawn: 0,
  state: {}, pending: 0, until: 0,
  held: false, steps: 0, past: null, predicted: false,
  dirty: true, drawn: [], available: new Set(), curves: null,
};
const view = { over: false, colour: "material" };
const history = new History();
const scales = { speed: new SpeedScale(), error: new ErrorScale() };
const redraw = () => { now.dirty = true; };
const legend = new Legend(scales, redraw, notify);
const camera = new Camera(document.querySelectorAll(".plot"), () => {
  redraw();
  $("unzoom").hidden = camera.zoom === 1;
  $("unzoom").textContent = `${camera.zoom.toFixed(1)}× zoom, reset`;
  $("stage").dataset.zoomed = String(camera.zoom > 1);
});
theme.onChange(() => {
  redraw();
  drawLegend();
  drawCurves();
});

// --- the connection

let countdown = 0;
const link = new Link({
  opened() {
    clearInterval(countdown);
    connection("open", "connected");
    now.undrawn = now.pending = 0;
    now.next = null;
    tool.isMoving = false;
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
      if (message.of === "tool") return tool.moved(message);
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
/** Shows a message in the place of the title. */
function notify(text) {
  $("message").textContent = text;
  document.body.dataset.message = "shown";
  clearTimeout(notifying);
  notifying = setTimeout(() => { delete document.body.dataset.message; }, 4000);
}

function start(hello) {
  const restarted = now.hello && now.hello.instance !== hello.instance;
  now.hello = hello;
  now.available = new Set(hello.controls);
  document.title = `eddy ${hello.command}`;
  for (const name of ["pause", "step", "reset", "publish_all", "free_run"]) $(name).hidden = !now.available.has(name);
  $("back").hidden = $("forward").hidden = !now.available.has("skip");
  $("rate-label").hidden = !now.available.has("rate");
  $("horizon-label").hidden = !now.available.has("horizon");
  const { horizon, free_run: freeRun } = hello.settings;
  [$("horizon").min, $("horizon").max] = horizon.range;
  $("horizon-label").title = `${horizon.help} (+, −)`;
  $("free_run").title = `${freeRun.help} (f)`;
  // The source of a node cannot be paused, but the view can be held.
  $("hold").hidden = now.available.has("pause");
  if ($("hold").hidden) hold(false);
  $("step").hidden = !(now.available.has("step") || now.held);
  if (restarted) {
    notify("the program was restarted");
    now.frame = now.curves = null;
    forget();
    drawCurves();
  }
  scales.error.ends = hello.errors;
  $("evaluation").hidden = !hello.model;
  painter?.colours(hello.materials.map((material) => material.color), hello.scale);
  arrange();
  drawLegend();
  listControls();
}

/** Discards the frames of the previous run of the program. */
function forget() {
  history.clear();
  now.predicted = false;
  now.past = null;
  resetAutomaticLimits();
  redraw();
}

/** Restarts the automatic colour limits from the next frame. */
function resetAutomaticLimits() {
  for (const scale of Object.values(scales)) scale.automatic = null;
}

// --- particles

let painter = null;
let failure = "";
try {
  painter = new Painter($("particles"), redraw);
} catch (error) {
  failure = error.message;
  $("waiting").textContent = `cannot draw particles: ${failure}`;
}

/** Whether there are predictions, or will be. */
const predicts = () => Boolean(now.hello?.model) || now.predicted;

/** Arranges the panels: without predictions there is one, and wide domains are stacked. */
function arrange() {
  const aspect = now.frame ? aspectOf(now.frame) : 1;
  const shape = now.frame ? (aspect > 2 ? "wide" : "square") : "square";
  const stage = $("stage");
  stage.style.setProperty("--aspect", Math.min(Math.max(aspect, 0.5), 16));
  stage.dataset.shape = shape;
  stage.dataset.view = !predicts() ? "alone" : view.over ? "over" : "beside";
  $("view-label").hidden = $("time-card").hidden = !predicts();
  $("colour").querySelector("[value=error]").disabled = !predicts();
  $("waiting").hidden = Boolean(now.frame) && !failure;
}

function panels() {
  const colouring = view.colour === "error" && !now.frame?.pair ? "plain" : view.colour;
  const plot = (id) => $(id).querySelector(".plot");
  if ($("stage").dataset.view !== "over") {
    return ["truth", "prediction"].map((side) => ({ element: plot(side), layers: [{ side, colouring }] }));
  }
  // The truth is drawn larger, so that it is visible as a rim below the prediction.
  const below = { side: "truth", colouring: "plain", growth: 1.5 };
  return [{ element: plot("prediction"), layers: [below, { side: "prediction", colouring, growth: 0.8 }] }];
}

function draw() {
  const scale = scales[view.colour];
  painter?.draw(now.frame, panels(), theme.colours(), camera, now.frame && scale ? scale.mapping(now.frame) : [0, 1]);
}

function tick(time) {
  requestAnimationFrame(tick);
  if (now.next && now.past === null && (!now.held || now.steps > 0)) {
    const frame = now.next;
    now.next = null;
    if (now.held) now.steps -= 1;
    acknowledge();
    now.drawn.push(time);
    if (now.frame && now.frame.stream !== frame.stream) resetAutomaticLimits();
    history.add(frame);
    scales[view.colour]?.update(frame);
    present(frame);
  }
  while (now.drawn.length && now.drawn[0] < time - 2000) now.drawn.shift();
  if (now.dirty) {
    now.dirty = false;
    draw();
  }
}
requestAnimationFrame(tick);

/** Makes a frame the one that is shown. */
function present(frame) {
  const paired = now.frame?.pair;
  now.frame = frame;
  now.predicted ||= frame.prediction.present;
  redraw();
  caption();
  arrange();
  timeline();
  if (view.colour === "error" && paired !== frame.pair) drawLegend();
}

function caption() {
  const { truth, prediction, horizon, freeRunning } = now.frame;
  const when = (side) => (side.present ? `t = ${side.stamp.toFixed(2)} s, frame ${side.sequence}` : "");
  const frames = horizon === 1 ? "frame" : "frames";
  const info = horizon ? `, ${horizon} ${frames} ahead${freeRunning ? ", free run" : ""}` : "";
  $("truth").querySelector(".when").textContent = when(truth);
  const predicted = prediction.present ? when(prediction) + info : now.metrics?.node?.rejected ? "none: frames are rejected" : now.hello?.model ? "warming up" : "no prediction";
  $("prediction").querySelector(".when").textContent = predicted;
}

function drawLegend() {
  const { hello } = now;
  if (!hello) return;
  const css = (parts) => `rgb(${parts.join(" ")})`;
  const { ghost, dark } = theme.colours();
  const dots = view.colour === "material" ? hello.materials.map(({ name, color }) => [css(color), name]) : [];
  if (view.colour === "error" && !now.frame?.pair) dots.push([ghost, "no prediction to compare with"]);
  if ($("stage").dataset.view === "over") dots.push([ghost, "truth, below the prediction"]);
  legend.show(view.colour, dots, hello.scale, dark);
}

// --- the timeline

function timeline() {
  const last = history.length - 1;
  $("timeline").hidden = last < 1;
  $("scrub").max = Math.max(last, 0);
  $("scrub").value = now.past ?? last;
  const back = now.past === null ? 0 : history.entries[last].at - history.entries[now.past].at;
  const text = `t = ${timeOf(now.frame).toFixed(2)} s${now.past === null ? "" : ` (${back.toFixed(2)} s back)`}`;
  $("scrub").setAttribute("aria-valuetext", text);
  $("moment").textContent = `${text}, last ${history.span.toFixed(1)} s`;
  $("live").setAttribute("aria-pressed", String(now.past === null && !now.held));
}

/** Shows a kept frame. Meanwhile the page requests no new ones. */
function scrub(index) {
  if (history.length < 2) return;
  if (index >= history.length - 1) return newest();
  now.past = Math.max(index, 0);
  present(history.frame(now.past));
  drawCurves();
}

/** Returns to the newest frame. */
function newest() {
  if (now.past === null) return;
  now.past = null;
  present(history.frame(history.length - 1));
  drawCurves();
}

/** Shows new frames as they arrive. */
function live() {
  if (now.held) hold(false);
  newest();
}

// --- metrics and curves

function show(metrics) {
  const rejectedBefore = Boolean(now.metrics?.node?.rejected);
  now.metrics = metrics;
  if (now.frame && rejectedBefore !== Boolean(metrics.node?.rejected)) caption();
  $("title").textContent = metrics.name ? `${now.hello.title}: ${metrics.name}` : now.hello.title;
  now.curves = metrics.curves;
  showMetrics(metrics, now.hello, now.frame, now.drawn);
  $("renderer").textContent = painter ? `renderer: ${painter.renderer}` : failure;
  if (isSettled()) showState(metrics.state);
  streams(metrics);
  if (now.past === null) drawCurves();
  legend.limits(false);
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
  const { chart } = theme.colours();
  const mark = now.past !== null && now.frame.stream === now.metrics?.stream ? timeOf(now.frame) : null;
  const { baseline } = curves;
  const time = drawChart($("error-time"), curves.time, { title: "simulation time (s)", baseline, colours: chart, gap: 0.5, mark });
  $("error-time").setAttribute("aria-label", `Error over time: ${time}`);
  $("horizon-card").hidden = curves.horizon.length < 2;
  if (curves.horizon.length >= 2) {
    const horizon = drawChart($("error-horizon"), curves.horizon, { title: "frames ahead", baseline, colours: chart, decimals: 0 });
    $("error-horizon").setAttribute("aria-label", `Error by frames ahead: ${horizon}`);
  }
}
addEventListener("resize", () => { redraw(); drawCurves(); });
// A caption that takes another line moves the panels.
new ResizeObserver(redraw).observe($("stage"));

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
/** Moves the tool: the last place that was wanted, one command at a time. */
const tool = {
  wanted: null, isMoving: false,
  to(position) {
    this.wanted = position;
    if (this.isMoving || !link.send({ do: "tool", position })) return;
    [this.wanted, this.isMoving] = [null, true];
  },
  moved({ done, message }) {
    this.isMoving = false;
    if (!done) notify(`tool: ${message}`);
    if (this.wanted) this.to(this.wanted);
  },
  /** By a share of the domain, from where it is drawn. */
  by(right, up) {
    const at = this.wanted ?? (now.frame && toolOf(now.frame));
    if (!at) return;
    const { lower, upper } = now.frame;
    this.to([right, up].map((share, axis) => at[axis] + share * STEP * (upper[axis] - lower[axis])));
  },
};
const STEP = 0.08;
const hasTool = () => now.available.has("tool") && now.past === null;
for (const plot of document.querySelectorAll(".plot")) {
  plot.addEventListener("pointermove", ({ clientX, clientY, buttons }) => {
    if (!hasTool() || !now.frame || (buttons && camera.zoom > 1)) return;
    const { lower, upper } = now.frame;
    tool.to(camera.at(plot, clientX, clientY).map((share, axis) => lower[axis] + share * (upper[axis] - lower[axis])));
  });
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
  if (now.frame) timeline();
  $("step").hidden = !(now.available.has("step") || held);
}
const actions = {
  pause() {
    if (now.available.has("pause")) pause(!now.state.paused);
    else hold(!now.held);
  },
  step() {
    if (now.past !== null) scrub(now.past + 1);
    else if (now.held) now.steps += 1;
    else if (now.available.has("step")) {
      if (!now.state.paused) pause(true);
      send("step");
    }
  },
  right: () => (hasTool() ? tool.by(1, 0) : actions.step()),
  left: () => (hasTool() ? tool.by(-1, 0) : actions.previous()),
  up: () => hasTool() && tool.by(0, 1),
  down: () => hasTool() && tool.by(0, -1),
  previous: () => scrub((now.past ?? history.length - 1) - 1),
  live,
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
    if (!predicts()) return;
    view.over = !view.over;
    $("view").value = view.over ? "over" : "beside";
    $("prediction").querySelector("b").textContent = view.over ? "Truth and prediction" : "Prediction";
    arrange();
    redraw();
    drawLegend();
  },
  colour(to) {
    const all = ["material", "speed", ...(predicts() ? ["error"] : [])];
    view.colour = to ?? all[(all.indexOf(view.colour) + 1) % all.length];
    $("colour").value = view.colour;
    const scale = scales[view.colour];
    if (now.frame) scale?.update(now.frame);
    redraw();
    drawLegend();
  },
  zoom: (factor) => camera.magnify(factor, shownPlot()),
  pan: (right, up) => camera.pan([right, up].map((share) => share * 60), shownPlot()),
  unzoom: () => camera.reset(),
  picture() {
    if (!now.frame) return notify("no frame yet");
    const { dark, chart, paper } = theme.colours();
    const { hello, metrics } = now;
    const [skill, of] = skillText(metrics?.skill);
    const lines = [`eddy ${hello.command}: ${hello.title}`];
    if (metrics?.skill && now.past === null) lines.push(`${of}: ${skill}`);
    draw();
    const picture = compose($("stage"), $("particles"), lines,
      (pen, left, y, ink) => legend.draw(pen, left, y, hello.scale, dark, ink), { ...chart, paper });
    save(picture, `eddy-${timeOf(now.frame).toFixed(2)}s.png`).then(() => notify("picture saved"));
  },
  more() {
    const open = $("controls").dataset.open !== "true";
    $("controls").dataset.open = String(open);
    $("more").setAttribute("aria-expanded", String(open));
    $("more").textContent = open ? "Less" : "More";
    redraw();
  },
  theme: theme.toggle,
  help: () => ($("keys").open ? $("keys").close() : $("keys").showModal()),
};

const shownPlot = () => [...document.querySelectorAll(".plot")].find((plot) => plot.clientWidth > 0);
for (const name of ["pause", "step", "reset", "free_run", "publish_all", "theme", "help", "picture", "more", "live", "unzoom"]) {
  $(name).addEventListener("click", () => actions[name]());
}
$("hold").addEventListener("click", () => actions.pause());
$("scrub").addEventListener("input", (event) => scrub(Number(event.target.value)));
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

/** Lists what the available controls do, for devices without tooltips. */
function listControls() {
  const controls = [...$("controls").querySelectorAll("button, label")]
    .filter((control) => !control.hidden && control.id !== "more");
  rows($("control-list"), controls.map((control) => {
    const name = control.tagName === "LABEL" ? control.querySelector("span").textContent : control.textContent;
    return [name, control.title];
  }));
}
listen(actions);
drawCurves();
