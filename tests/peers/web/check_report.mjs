// Tests the page of `eddy eval` in a real browser: values under the pointer, sorted tables, and everything without scripts.
//
//   node check_report.mjs REPORT [PICTURES]     REPORT: report.html; PICTURES: a folder for screenshots and the printed page

import assert from "node:assert/strict";
import { mkdirSync } from "node:fs";
import { join, resolve } from "node:path";
import { chromium } from "playwright-core";

const [report, pictures] = process.argv.slice(2);
if (pictures) mkdirSync(pictures, { recursive: true });
const browser = await chromium.launch({
  executablePath: "/usr/bin/chromium",
  args: ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run"],
});
const faults = [];
async function open(options) {
  const context = await browser.newContext({ viewport: { width: 1280, height: 900 }, ...options });
  const page = await context.newPage();
  page.on("request", (request) => /^(file|data):/.test(request.url()) || faults.push(`requested ${request.url()}`));
  page.on("pageerror", (error) => faults.push(`threw ${error.stack}`));
  await page.goto(`file://${resolve(report)}`);
  return page;
}
const names = (table) => table.evaluate((one) => [...one.tBodies[0].rows].map((row) => row.cells[0].textContent));

try {
  const page = await open({});
  // The pointer and the arrow keys show the values of a column of points.
  const plot = page.locator("svg[data-plot]").first();
  await plot.scrollIntoViewIfNeeded();
  const { x, y, width, height } = await plot.boundingBox();
  await page.mouse.move(x + width / 2, y + height / 2);
  const tip = page.locator(".tip");
  assert.match(await tip.innerText(), /^\d+ frames ahead\n.+: [-\d.]+/);
  assert.ok((await plot.locator(".hover circle").count()) > 0);
  if (pictures) await page.screenshot({ path: join(pictures, "report.png") });
  await plot.focus();
  await page.keyboard.press("ArrowRight");
  const moved = await tip.innerText();
  await page.keyboard.press("ArrowLeft");
  assert.notEqual(await tip.innerText(), moved, "arrow keys move along the curves");
  await page.mouse.move(0, 0);
  await plot.blur();
  assert.ok(await tip.isHidden());

  // A click sorts, a second one reverses, a third one restores; rows of counts stay in their place.
  const table = page.locator(".table > table").first();
  const before = await names(table);
  const values = () => table.evaluate((one) => [...one.tBodies[0].rows].slice(1).map((row) => parseFloat(row.cells[1].textContent)));
  const title = table.locator("thead th").nth(1);
  await title.locator("button").click();
  const ascending = await values();
  assert.deepEqual(ascending, [...ascending].sort((a, b) => a - b));
  assert.equal(await title.getAttribute("aria-sort"), "ascending");
  assert.equal((await names(table))[0], before[0], "the first row is fixed");
  await title.locator("button").click();
  assert.deepEqual(await values(), [...ascending].reverse());
  await title.locator("button").click();
  assert.deepEqual(await names(table), before);
  assert.ok((await page.evaluate(() => document.documentElement.scrollWidth)) <= 1280);
  if (pictures) await page.pdf({ path: join(pictures, "report.pdf"), preferCSSPageSize: true });

  // Without scripts everything is there.
  const plain = await open({ javaScriptEnabled: false });
  assert.equal(await plain.locator("thead button").count(), 0);
  assert.ok((await plain.locator("tbody tr").count()) > 10);
  assert.ok(await plain.locator("svg[data-plot]").first().isVisible());
  const narrow = await open({ viewport: { width: 360, height: 780 }, colorScheme: "dark" });
  assert.ok((await narrow.evaluate(() => document.documentElement.scrollWidth)) <= 360, "nothing is wider than a phone");
  if (pictures) await narrow.screenshot({ path: join(pictures, "report-360.png") });
  assert.deepEqual(faults, []);
  console.log("report: values under the pointer, sorted tables, complete without scripts");
} finally {
  await browser.close();
}
