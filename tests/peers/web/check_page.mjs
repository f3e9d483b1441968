// Tests the live page in a real browser: Debian's chromium with software rendering, controlled by playwright-core.
//
//   node check_page.mjs EDDY [PICTURES]     EDDY: the built program; PICTURES: a folder for screenshots
//
// Runs `eddy demo`, inspects the pixels of the page, uses its controls, kills and restarts the program, opens ten
// tabs at once and narrow windows, and switches between light and dark. Prints the browser's frame rate and renderer.
// `eddy replay` shows a recording without predictions, one of a wide domain with them, and one with a tool.

import assert from "node:assert/strict";
import { execFileSync, spawn } from "node:child_process";
import { mkdirSync, mkdtempSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { createServer } from "node:net";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { setTimeout as sleep } from "node:timers/promises";
import { chromium } from "playwright-core";

const [eddy, pictures] = process.argv.slice(2);
const work = mkdtempSync(join(tmpdir(), "eddy-browser-"));
if (pictures) mkdirSync(pictures, { recursive: true });
// Eleven pages with software rendering on two cores are slow.
const DEADLINE = 120_000;

/** Polls until the answer is truthy. */
async function until(what, answer, patience = DEADLINE) {
  const end = Date.now() + patience;
  for (;;) {
    const found = await answer();
    if (found) return found;
    if (Date.now() > end) throw new Error(`timed out after ${patience / 1000} s: ${what}`);
    await sleep(50);
  }
}

/** A free port. */
function freePort() {
  return new Promise((resolve) => {
    const server = createServer().listen(0, "127.0.0.1", () => {
      const { port } = server.address();
      server.close(() => resolve(port));
    });
  });
}

let started = 0;
const children = [];
/** Starts `eddy` with a page. */
async function serve(...args) {
  const child = spawn(eddy, args, { stdio: ["ignore", "pipe", "inherit"] });
  children.push(child);
  let printed = "";
  child.stdout.on("data", (bytes) => { printed += bytes; });
  const url = await until("the program prints the URL of its page", () => {
    assert.equal(child.exitCode, null, `${args} ended: ${printed}`);
    return printed.match(/page: +(http:\S+)/)?.[1];
  });
  const kill = async () => {
    const ended = new Promise((resolve) => child.once("exit", resolve));
    child.kill("SIGKILL");
    await ended;
  };
  return { url, kill };
}
/** Starts `eddy demo` with its page on `port`. */
const demo = (port) => serve("demo", "--port", String(port), "--output", join(work, `demo-${started++}`));
/** Plays a bag in a loop, with a page. */
const replay = (bag, ...topics) => {
  // Topics that no other process on this machine uses.
  const remap = topics.flatMap((topic) => ["--remap", `${topic}:=/check_page_${process.pid}${topic}`]);
  return serve("replay", bag, "--to", "shm", "--loop", "--view", "0", ...remap);
};

const browser = await chromium.launch({
  executablePath: "/usr/bin/chromium",
  args: [
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
  ],
});

/** Opens the page in a tab; requests to other origins and errors are collected in `faults` and fail the test. */
const faults = [];
async function tab(url, options = {}) {
  const context = await browser.newContext({ viewport: { width: 1280, height: 1000 }, colorScheme: "light", ...options });
  const page = await context.newPage();
  page.on("request", (request) => {
    if (new URL(request.url()).host !== new URL(url).host) faults.push(`requested ${request.url()}`);
  });
  page.on("pageerror", (error) => faults.push(`threw ${error.stack}`));
  page.on("console", (message) => {
    const ours = message.type() === "error" && !/WebSocket connection/.test(message.text());
    if (ours) faults.push(`logged an error: ${message.text()}`);
  });
  page.setDefaultTimeout(DEADLINE);
  await page.goto(url);
  return page;
}

/** The shares of an element's pixels that are within `near` of each colour in `palette`. */
const easel = await (await browser.newContext()).newPage();
async function colours(page, selector, palette, near = 40) {
  const png = (await page.locator(selector).screenshot()).toString("base64");
  return easel.evaluate(async ([png, palette, near]) => {
    const bytes = Uint8Array.from(atob(png), (letter) => letter.charCodeAt(0));
    const picture = await createImageBitmap(new Blob([bytes], { type: "image/png" }));
    const pen = new OffscreenCanvas(picture.width, picture.height).getContext("2d");
    pen.drawImage(picture, 0, 0);
    const { data } = pen.getImageData(0, 0, picture.width, picture.height);
    const counts = palette.map(() => 0);
    for (let at = 0; at < data.length; at += 4) {
      palette.forEach((colour, which) => {
        if (Math.hypot(...colour.map((part, i) => part - data[at + i])) < near) counts[which] += 1;
      });
    }
    return counts.map((count) => count / (data.length / 4));
  }, [png, palette, near]);
}

/** The mean place of an element's pixels that have a colour, 0 to 1 from its upper left corner; null if they are few. */
async function middle(page, selector, colour) {
  const png = (await page.locator(selector).screenshot()).toString("base64");
  return easel.evaluate(async ([png, colour]) => {
    const bytes = Uint8Array.from(atob(png), (letter) => letter.charCodeAt(0));
    const picture = await createImageBitmap(new Blob([bytes], { type: "image/png" }));
    const { width, height } = picture;
    const pen = new OffscreenCanvas(width, height).getContext("2d");
    pen.drawImage(picture, 0, 0);
    const { data } = pen.getImageData(0, 0, width, height);
    let [count, x, y] = [0, 0, 0];
    for (let at = 0; at < data.length; at += 4) {
      if (Math.hypot(...colour.map((part, i) => part - data[at + i])) > 12) continue;
      const pixel = at / 4;
      [count, x, y] = [count + 1, x + (pixel % width), y + Math.floor(pixel / width)];
    }
    return count < 50 ? null : [x / count / width, y / count / height];
  }, [png, colour]);
}

/** Width and height of a PNG. */
const sizeOf = (png) => [png.readUInt32BE(16), png.readUInt32BE(20)];
const VIRIDIS = [[68, 1, 84], [59, 81, 139], [33, 144, 141], [92, 200, 99], [253, 231, 37]];
const GHOST = [185, 192, 201];
const LIQUID = [0, 114, 178];
const TOOL = [95, 100, 110];
const FORCE = [190, 30, 45];
/** Liquid, snow, jelly, rope. */
const MATERIALS = [LIQUID, [86, 180, 233], [230, 159, 0], [213, 94, 0]];
/** The share of an element's pixels that have the colour of a material. */
const matter = async (page, selector, near) => (await colours(page, selector, MATERIALS, near)).reduce((sum, share) => sum + share);
const metric = (page, name) => page.locator(`dd[data-name="${name}"]`).first().textContent({ timeout: DEADLINE });
const caption = (page, side) => page.locator(`#${side} .when`).textContent();
const frame = async (page) => Number((await caption(page, "truth")).match(/frame (\d+)/)?.[1] ?? -1);
const open = (page) => until("the page is connected", async () => (await page.locator("#connection").getAttribute("data-state")) === "open");
const draws = (page) => until("both sides are drawn", async () => {
  const sides = await Promise.all(["#truth .plot", "#prediction .plot"].map((plot) => matter(page, plot)));
  return sides.every((share) => share > 0.02) && sides;
});
const snap = (page, name) => pictures && page.screenshot({ path: join(pictures, `${name}.png`), fullPage: true });

try {
  const port = await freePort();
  let running = await demo(port);
  const page = await tab(running.url);
  await open(page);

  const [truth, prediction] = await draws(page);
  const percent = (share) => `${(100 * share).toFixed(1)} %`;
  console.log(`draws: matter covers ${percent(truth)} of the truth, ${percent(prediction)} of the prediction`);
  await until("a prediction meets its truth", async () => /error/.test(await page.locator("#error-time").getAttribute("aria-label")));
  await sleep(3000);
  await snap(page, "light");
  console.log(`rate: ${await metric(page, "display rate")}, ${await page.locator("#renderer").textContent()}`);
  // The rate depends on the load of the machine; test only that drawing continues.
  const drawn = await frame(page);
  await until("drawing continues", async () => (await frame(page)) !== drawn);

  // Controls act on the program, not only on the page.
  await page.keyboard.press("Space");
  await until("it pauses", async () => (await page.locator("#pause").textContent()) === "Resume");
  // The page counts a little later than it draws.
  const counted = async () => [await frame(page), Number((await metric(page, "frames sent to this page")).replaceAll(",", ""))];
  const [paused, observed] = await until("frames stop", async () => {
    const first = await counted();
    await sleep(1500);
    return String(await counted()) === String(first) && first;
  });
  await page.keyboard.press("ArrowRight");
  await until("one frame arrives", async () => (await frame(page)) === paused + 1);
  await sleep(1500);
  assert.deepEqual(await counted(), [paused + 1, observed + 1], "a step is one frame");

  await page.locator("#horizon").fill("10");
  await page.locator("#horizon").press("Enter");
  await page.locator("#horizon").blur();
  await page.locator("#pause").click();
  await until("predictions are ten frames ahead", async () => /, 10 frames ahead$/.test(await caption(page, "prediction")));
  // Only horizons that are predicted at present are in the curve: one is no curve.
  await sleep(1000);
  assert.ok(await page.locator("#horizon-card").isHidden(), "no curve by frames ahead of one horizon");
  await page.locator("#publish_all").click();
  await until("the curve by horizon appears", () => page.locator("#horizon-card").isVisible());
  await sleep(1500);
  await snap(page, "ahead");
  await page.locator("#publish_all").click();
  await page.locator("#free_run").click();
  await until("the model runs free", async () => /free run/.test(await caption(page, "prediction")));
  await sleep(1500);
  await page.keyboard.press("o");
  await sleep(200);
  await snap(page, "overlaid-free-run");
  await page.keyboard.press("o");
  const resets = async () => {
    await page.locator("details").first().evaluate((details) => { details.open = true; });
    return Number(await metric(page, "resets"));
  };
  const before = await resets();
  await page.locator("#free_run").click();
  await until("it observes again", async () => !/free run/.test(await caption(page, "prediction")));
  await page.keyboard.press("r");
  await until("the resets are counted", async () => (await resets()) >= before + 2);
  console.log("controls: pause, step, horizon, all frames, free run, reset");

  // Colours by speed and by error: limits from percentiles, or typed.
  for (const colour of ["speed", "error"]) {
    await page.locator("#colour").selectOption(colour);
    await until(`it is coloured by ${colour}, in many colours`, async () => {
      const shares = await colours(page, "#prediction .plot", VIRIDIS, 60);
      return shares.filter((share) => share > 0.002).length >= 3 && await matter(page, "#prediction .plot", 15) < 0.05;
    });
    const limits = await Promise.all(["#low", "#high"].map(async (field) => Number(await page.locator(field).inputValue())));
    assert.ok(limits[0] < limits[1], `limits ${limits}`);
    await snap(page, colour);
  }
  await page.locator("#colour").selectOption("speed");
  await page.locator("#high").fill("1000");
  await page.locator("#high").press("Enter");
  await until("all is slow on the typed scale", async () => {
    const [slow, ...others] = await colours(page, "#prediction .plot", VIRIDIS, 60);
    return slow > 0.01 && others.every((share) => share < 0.002);
  });
  await page.locator("#low").fill("2000");
  await page.locator("#low").press("Enter");
  await until("limits in the wrong order are refused", async () => /expected the lower one first/.test(await page.locator("#message").textContent()));
  // The message is in the header, and covers nothing.
  assert.ok(await page.locator("#message").isVisible());
  const [bar, toast] = await Promise.all(["header", "#message"].map((one) => page.locator(one).boundingBox()));
  assert.ok(toast.y >= bar.y && toast.y + toast.height <= bar.y + bar.height, "the message is in the header");
  await page.locator("#auto").click();
  await until("the limits are automatic again", async () => Number(await page.locator("#high").inputValue()) < 100);

  // Errors are grey without a prediction of the same instant.
  await page.locator("#colour").selectOption("error");
  await page.locator("#colour").blur();
  await page.locator("#horizon").fill("1");
  await page.locator("#horizon").press("Enter");
  await page.locator("#horizon").blur();
  await until("predictions are one frame ahead", async () => /, 1 frame ahead$/.test(await caption(page, "prediction")));
  await page.locator("#pause").click();
  await until("it pauses", async () => (await page.locator("#pause").textContent()) === "Resume");
  // A slow node has frames in its queue.
  const received = () => metric(page, "received");
  await until("the node has seen all frames", async () => {
    const count = await received();
    await sleep(1500);
    return (await received()) === count;
  });
  await page.keyboard.press("r");
  await until("the streams are reset", async () => /Reset/.test(await page.locator("#message").textContent()));
  // The next frame has a prediction from before the reset.
  let grey = false;
  for (let step = 0; step < 4 && !grey; step++) {
    const last = await frame(page);
    await page.keyboard.press("ArrowRight");
    await until("the next frame is drawn", async () => (await frame(page)) !== last);
    await sleep(300);
    const [ghost, ...others] = await colours(page, "#truth .plot", [GHOST, ...VIRIDIS], 25);
    grey = ghost > 0.01 && others.every((share) => share < 0.001);
  }
  assert.ok(grey, "errors are grey while the model warms up");
  assert.match(await page.locator("#swatches").textContent(), /no prediction to compare with/);
  await snap(page, "error-without-prediction");
  await page.locator("#colour").selectOption("material");
  await page.locator("#colour").blur();
  await page.locator("#pause").click();
  await draws(page);
  await until("the skill is a number", async () => /^[+−][\d.]+$/.test(await page.locator("#skill b").textContent()));
  console.log(`colour scales; skill ${await page.locator("#skill").textContent()}`);

  // The timeline: back by keys and slider while the source goes on, and live again.
  const moment = () => page.locator("#moment").textContent();
  const back = async () => Number((await moment()).match(/\(([\d.]+) s back\)/)?.[1] ?? 0);
  const shown = async () => (await Promise.all(["#truth .when", "#moment"].map((one) => page.locator(one).textContent()))).join();
  for (let step = 0; step < 5; step++) await page.keyboard.press("ArrowLeft");
  const past = await shown();
  assert.equal(await page.locator("#live").getAttribute("aria-pressed"), "false");
  await sleep(500);
  assert.equal(await shown(), past, "the past does not move");
  await page.keyboard.press("ArrowLeft");
  assert.notEqual(await shown(), past, "one frame back");
  await page.locator("#scrub").evaluate((slider) => { slider.value = 0; slider.dispatchEvent(new Event("input")); });
  assert.ok((await back()) > 0.2, `the timeline goes back: ${await moment()}`);
  await snap(page, "scrubbed");
  await page.locator("#live").click();
  const resumed = await shown();
  assert.equal(await page.locator("#live").getAttribute("aria-pressed"), "true");
  await until("it is live again", async () => (await shown()) !== resumed && (await back()) === 0);
  const kept = Number((await moment()).match(/last ([\d.]+) s/)[1]);
  assert.ok(kept > 0 && kept < 20.5, `${kept} s are kept`);

  // Zoom and pan: wheel, dragging, keys, double click.
  const covered = () => matter(page, "#truth .plot");
  const plot = await page.locator("#truth .plot").boundingBox();
  const zoom = async () => Number((await page.locator("#unzoom").textContent()).match(/^([\d.]+)×/)?.[1] ?? 1);
  await page.keyboard.press("Space");
  await sleep(500);
  const whole = await covered();
  await page.mouse.move(plot.x + plot.width / 2, plot.y + 0.85 * plot.height);
  await page.mouse.wheel(0, -700);
  await until("the wheel zooms", async () => (await zoom()) > 2 && (await page.locator("#unzoom").isVisible()));
  assert.notEqual((await covered()).toFixed(3), whole.toFixed(3), "another part of the domain");
  await snap(page, "zoomed");
  const pixels = async () => (await page.locator("#prediction .plot").screenshot()).toString("base64");
  let seen = await pixels();
  await page.mouse.down();
  await page.mouse.move(plot.x + plot.width / 2 - 150, plot.y + 0.6 * plot.height, { steps: 4 });
  await page.mouse.up();
  await until("dragging pans both panels", async () => (await pixels()) !== seen);
  seen = await pixels();
  await page.keyboard.press("Shift+ArrowLeft");
  await until("keys pan", async () => (await pixels()) !== seen);
  const before2 = await zoom();
  await page.keyboard.press("z");
  await until("keys zoom", async () => (await zoom()) > before2);
  await page.mouse.dblclick(plot.x + plot.width / 2, plot.y + plot.height / 2);
  await until("a double click shows the whole domain", () => page.locator("#unzoom").isHidden());
  await until("as before", async () => Math.abs((await covered()) - whole) < 0.002);

  // The picture has both panels.
  const [download] = await Promise.all([page.waitForEvent("download"), page.locator("#picture").click()]);
  assert.match(download.suggestedFilename(), /^eddy-[\d.]+s\.png$/);
  const png = readFileSync(await download.path());
  const [wide, high] = sizeOf(png);
  assert.ok(wide > 2 * plot.width && high > plot.height, `a picture of ${wide} x ${high} pixels`);
  if (pictures) writeFileSync(join(pictures, "picture.png"), png);
  await easel.setContent(`<img src="data:image/png;base64,${png.toString("base64")}">`);
  for (const left of [0.05, 0.55]) {
    const clip = { x: 8 + left * wide, y: 8 + 0.1 * high, width: 0.4 * wide, height: 0.7 * high };
    await easel.setViewportSize({ width: wide + 20, height: high + 20 });
    const half = await easel.screenshot({ clip });
    assert.ok(half.length > 5000, `half of the picture from ${left} has ${half.length} bytes`);
  }
  await page.keyboard.press("Space");
  console.log(`timeline of ${kept} s, zoom, a picture of ${wide} x ${high} pixels`);

  // Light and dark colour schemes.
  const ground = () => page.evaluate(() => getComputedStyle(document.body).backgroundColor);
  const light = await ground();
  await page.keyboard.press("t");
  assert.notEqual(await ground(), light, "dark differs from light");
  const [dark] = await colours(page, "#truth .plot", [[11, 13, 17]], 12);
  assert.ok(dark > 0.2, `the background of the particles is dark: ${dark}`);
  await draws(page);
  await snap(page, "dark");
  const system = await tab(running.url, { colorScheme: "dark" });
  assert.notEqual(await system.evaluate(() => getComputedStyle(document.body).backgroundColor), light, "the page follows the system's colour scheme");
  await system.context().close();
  console.log("light and dark");

  // The list of keys, and names for screen readers.
  await page.keyboard.press("?");
  assert.ok(await page.locator("#keys").isVisible());
  assert.ok((await page.locator("#key-list dt").count()) >= 8);
  await page.keyboard.press("Escape");
  const unnamed = await page.evaluate(() => [...document.querySelectorAll("button, input, select, canvas")]
    .filter((one) => !one.ariaHidden && !(one.ariaLabel || one.textContent.trim() || one.closest("label")?.textContent.trim()))
    .map((one) => one.id));
  assert.deepEqual(unnamed, [], "all controls have names");
  const silent = await page.evaluate(() => [...document.querySelectorAll("main button, main input, main select, header button")]
    .filter((one) => !(one.title || one.closest("label")?.title)).map((one) => one.id));
  assert.deepEqual(silent, [], "all controls have tooltips");

  // A narrow screen.
  for (const width of [320, 360, 390]) {
    const phone = await tab(running.url, { viewport: { width, height: 780 }, hasTouch: true });
    await draws(phone);
    const [content, window] = await phone.evaluate(() => [document.documentElement.scrollWidth, innerWidth]);
    assert.ok(content <= window, `${content} pixels in a window of ${window}`);
    const [one, other] = await Promise.all(["#truth", "#prediction"].map((side) => phone.locator(side).boundingBox()));
    assert.ok(other.y >= one.y + one.height, "the panels are stacked");
    const controls = (await phone.locator("#controls").boundingBox()).height;
    assert.ok(width < 360 || controls < 120, `the controls take ${controls} pixels`);
    await snap(phone, `narrow-${width}`);
    assert.ok(await phone.locator("#horizon").isHidden());
    await phone.locator("#more").click();
    assert.ok(await phone.locator("#horizon").isVisible(), "more controls");
    // Two fingers zoom.
    await phone.locator("#truth .plot").scrollIntoViewIfNeeded();
    const { x, y, width: side } = await phone.locator("#truth .plot").boundingBox();
    const touch = await phone.context().newCDPSession(phone);
    for (const [type, apart] of [["touchStart", 20], ["touchMove", 40], ["touchMove", 60], ["touchMove", 80]]) {
      const touchPoints = [-1, 1].map((sign, id) => ({ x: x + side / 2 + sign * apart, y: y + 100, id }));
      await touch.send("Input.dispatchTouchEvent", { type, touchPoints });
    }
    await touch.send("Input.dispatchTouchEvent", { type: "touchEnd", touchPoints: [] });
    await until("two fingers zoom", () => phone.locator("#unzoom").isVisible());
    await phone.context().close();
  }
  console.log("narrow screens");

  // Ten tabs at once.
  const tabs = await Promise.all(Array.from({ length: 10 }, () => tab(running.url, { viewport: { width: 700, height: 500 } })));
  await Promise.all(tabs.map(open));
  // Every third is looked at: each takes a quarter of a minute while all are drawn by software on two cores.
  for (const one of tabs.filter((_, number) => number % 3 === 0)) {
    // Background tabs are rendered rarely, and a screenshot waits for two rendered frames.
    await one.bringToFront();
    await draws(one);
  }
  await until("eleven pages are counted", async () => (await metric(tabs[0], "open pages")) === "11");
  await Promise.all(tabs.map((one) => one.context().close()));
  await until("the closed pages are no longer counted", async () => (await metric(page, "open pages")) === "1");
  console.log("ten tabs at once");

  // The program is killed and restarted on the same port.
  await page.bringToFront();
  await running.kill();
  await until("the page reports the lost connection", async () => /retrying/.test(await page.locator("#connection").textContent()));
  await snap(page, "lost");
  running = await demo(port);
  await open(page);
  await until("frames arrive again", async () => {
    const first = await frame(page);
    await sleep(300);
    return first >= 0 && (await frame(page)) > first;
  });
  await draws(page);
  console.log("reconnects");
  await running.kill();

  // A recording without predictions has no panel for them; wide domains are stacked.
  const scene = join(work, "wide.toml");
  writeFileSync(scene, `domain = [8.0, 1.0]\nframes.duration = 1.5\n[[bodies]]\nmaterial = "liquid"\n`
    + `shape.rectangle.size = [2.0, 0.4]\nposition = [3.0, 0.3]\nvelocity = [1.0, 0.0]\n`);
  const run = (...args) => execFileSync(eddy, [...args, "--quiet"], { stdio: ["ignore", "ignore", "inherit"] });
  const [truthBag, predictedBag, both] = ["wide", "predicted", "both"].map((name) => join(work, name));
  run("simulate", "--scene", scene, "--output", truthBag);
  const recording = join(truthBag, "scene_0000");
  run("predict", "--input", recording, "--output", predictedBag);
  run("bag", "merge", recording, predictedBag, "--output", both);
  const alone = await replay(recording, "/particles");
  const single = await tab(alone.url);
  await until("the recording is drawn", async () => (await colours(single, "#truth .plot", [LIQUID]))[0] > 0.01);
  assert.ok(await single.locator("#prediction").isHidden(), "no empty panel");
  assert.ok(await single.locator("#time-card").isHidden(), "no empty chart");
  await snap(single, "replay-alone");
  await single.context().close();
  await alone.kill();
  const compared = await replay(both, "/particles", "/prediction");
  for (const width of [1280, 360]) {
    const stacked = await tab(compared.url, { viewport: { width, height: 900 }, colorScheme: "dark" });
    await until("both sides are drawn", async () => {
      const shares = await Promise.all(["#truth .plot", "#prediction .plot"].map((one) => colours(stacked, one, [LIQUID])));
      return shares.every(([liquid]) => liquid > 0.01);
    });
    const [one, other] = await Promise.all(["#truth .plot", "#prediction .plot"].map((side) => stacked.locator(side).boundingBox()));
    assert.ok(other.y >= one.y + one.height, "wide domains are stacked");
    assert.ok(one.height >= 70 && one.width > 0.9 * (width - 40), `a panel of ${one.width} x ${one.height} pixels`);
    await snap(stacked, `wide-${width}`);
    await stacked.context().close();
  }
  await compared.kill();
  console.log("replays: without predictions, of a wide domain");

  // A blade follows the mouse and the arrow keys, and is drawn in recordings.
  const output = join(work, "pushed");
  const pushing = await serve("demo", "--scene", "push", "--port", "0", "--output", output);
  const bench = await tab(pushing.url);
  await open(bench);
  await draws(bench);
  await until("the blade is drawn", () => middle(bench, "#truth .plot", TOOL));
  const field = await bench.locator("#truth .plot").boundingBox();
  const at = async () => (await middle(bench, "#truth .plot", TOOL)) ?? [NaN, NaN];
  for (const [x, y] of [[0.5, 0.4], [0.3, 0.3]]) {
    await bench.mouse.move(field.x + x * field.width, field.y + y * field.height);
    await until("the blade is where the mouse is", async () => {
      const found = await at();
      return Math.hypot(found[0] - x, found[1] - y) < 0.03;
    });
  }
  await snap(bench, "pushing");
  const [start] = await at();
  for (let press = 0; press < 4; press++) {
    await bench.keyboard.press("ArrowRight");
    await sleep(500);
  }
  await until("the blade has followed the keys", async () => (await at())[0] > start + 0.1);
  await bench.context().close();
  await pushing.kill();
  const pushed = join(work, "pushes");
  run("simulate", "--preset", "push", "--scenes", "1", "--seed", "1", "--output", pushed);
  const replayed = await replay(join(pushed, "scene_0000"), "/particles", "/tools", "/tools/description");
  const rerun = await tab(replayed.url);
  await until("the blade of a recording is drawn", () => middle(rerun, "#truth .plot", TOOL));
  await until("and the force on it", async () => (await colours(rerun, "#truth .plot", [FORCE], 20))[0] > 0.0005);
  await snap(rerun, "replayed-tools");
  await rerun.context().close();
  await replayed.kill();
  console.log("a blade follows mouse and keys; tools and forces of recordings");

  assert.deepEqual(faults, []);
  console.log("no requests to other origins, no errors");
} finally {
  children.forEach((child) => child.kill("SIGKILL"));
  await browser.close();
  rmSync(work, { recursive: true, force: true });
}
