// Tests the live page in a real browser: Debian's chromium with software rendering, controlled by playwright-core.
//
//   node check_page.mjs EDDY [PICTURES]     EDDY: the built program; PICTURES: a folder for screenshots
//
// Runs `eddy demo`, inspects the pixels of the page, uses its controls, kills and restarts the program, opens ten
// tabs at once and narrow windows, and switches between light and dark. Prints the browser's frame rate and renderer.

import assert from "node:assert/strict";
import { spawn } from "node:child_process";
import { mkdirSync, mkdtempSync, rmSync } from "node:fs";
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
/** Starts `eddy demo` with its page on `port`. */
async function demo(port) {
  const output = join(work, `demo-${started++}`);
  const child = spawn(eddy, ["demo", "--port", String(port), "--output", output], { stdio: ["ignore", "pipe", "inherit"] });
  children.push(child);
  let printed = "";
  child.stdout.on("data", (bytes) => { printed += bytes; });
  const url = await until("the demo prints the URL of its page", () => {
    assert.equal(child.exitCode, null, `the demo ended: ${printed}`);
    return printed.match(/page: +(http:\S+)/)?.[1];
  });
  const kill = async () => {
    const ended = new Promise((resolve) => child.once("exit", resolve));
    child.kill("SIGKILL");
    await ended;
  };
  return { url, kill };
}

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

const LIQUID = [0, 114, 178];
const JELLY = [230, 159, 0];
const metric = (page, name) => page.locator(`dd[data-name="${name}"]`).first().textContent({ timeout: DEADLINE });
const caption = (page, side) => page.locator(`#${side} .when`).textContent();
const frame = async (page) => Number((await caption(page, "truth")).match(/frame (\d+)/)?.[1] ?? -1);
const open = (page) => until("the page is connected", async () => (await page.locator("#connection").getAttribute("data-state")) === "open");
const draws = (page) => until("both sides are drawn", async () => {
  const sides = await Promise.all(["#truth .plot", "#prediction .plot"].map((plot) => colours(page, plot, [LIQUID, JELLY])));
  return sides.every(([liquid, jelly]) => liquid > 0.01 && jelly > 0.01) && sides;
});
const snap = (page, name) => pictures && page.screenshot({ path: join(pictures, `${name}.png`), fullPage: true });

try {
  const port = await freePort();
  let running = await demo(port);
  const page = await tab(running.url);
  await open(page);

  const [truth, prediction] = await draws(page);
  console.log(`draws: liquid and jelly cover ${truth.map((share) => (100 * share).toFixed(1))} % of the truth, `
    + `${prediction.map((share) => (100 * share).toFixed(1))} % of the prediction`);
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
  const paused = await until("frames stop", async () => {
    const first = await frame(page);
    await sleep(400);
    return (await frame(page)) === first && first;
  });
  const observed = Number((await metric(page, "frames sent to this page")).replaceAll(",", ""));
  await page.keyboard.press("ArrowRight");
  await until("one frame arrives", async () => (await frame(page)) === paused + 1);
  await sleep(400);
  assert.equal(await frame(page), paused + 1, "a step is one frame");
  assert.equal(Number((await metric(page, "frames sent to this page")).replaceAll(",", "")), observed + 1, "one frame was sent");

  await page.locator("#horizon").fill("10");
  await page.locator("#horizon").press("Enter");
  await page.locator("#horizon").blur();
  await page.locator("#pause").click();
  await until("predictions are ten frames ahead", async () => /, 10 frames ahead$/.test(await caption(page, "prediction")));
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
    await page.locator("details").evaluate((details) => { details.open = true; });
    return Number(await metric(page, "resets"));
  };
  const before = await resets();
  await page.locator("#free_run").click();
  await until("it observes again", async () => !/free run/.test(await caption(page, "prediction")));
  await page.keyboard.press("r");
  await until("the resets are counted", async () => (await resets()) >= before + 2);
  console.log("controls: pause, step, horizon, all frames, free run, reset");

  for (const [colour, palette] of [["speed", [[68, 1, 84], [59, 81, 139]]], ["error", [[33, 144, 141], [59, 81, 139], [92, 200, 99]]]]) {
    await page.locator("#colour").selectOption(colour);
    await until(`it is coloured by ${colour}`, async () => {
      const shares = await colours(page, "#prediction .plot", palette, 70);
      const [liquid, jelly] = await colours(page, "#prediction .plot", [LIQUID, JELLY], 15);
      return shares.some((share) => share > 0.01) && liquid + jelly < 0.05;
    });
    await snap(page, colour);
  }
  await page.locator("#colour").selectOption("material");
  await page.locator("#colour").blur();

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
    .filter((one) => !(one.ariaLabel || one.textContent.trim() || one.closest("label")?.textContent.trim()))
    .map((one) => one.id));
  assert.deepEqual(unnamed, [], "all controls have names");

  // A narrow screen.
  for (const width of [320, 390]) {
    const phone = await tab(running.url, { viewport: { width, height: 780 } });
    await draws(phone);
    const [content, window] = await phone.evaluate(() => [document.documentElement.scrollWidth, innerWidth]);
    assert.ok(content <= window, `${content} pixels in a window of ${window}`);
    const [one, other] = await Promise.all(["#truth", "#prediction"].map((side) => phone.locator(side).boundingBox()));
    assert.ok(other.y >= one.y + one.height, "the panels are stacked");
    await snap(phone, `narrow-${width}`);
    await phone.context().close();
  }
  console.log("narrow screens");

  // Ten tabs at once.
  const tabs = await Promise.all(Array.from({ length: 10 }, () => tab(running.url, { viewport: { width: 700, height: 500 } })));
  await Promise.all(tabs.map(open));
  for (const one of tabs) {
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

  assert.deepEqual(faults, []);
  console.log("no requests to other origins, no errors");
} finally {
  children.forEach((child) => child.kill("SIGKILL"));
  await browser.close();
  rmSync(work, { recursive: true, force: true });
}
