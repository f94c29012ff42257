// Opens a page in headless Chromium with software WebGL, runs scripts in it one after the other, and prints their
// results and all requests as json. tests/test_web.py and tests/test_study.py call it:
//   node browser.mjs CHROMIUM PAGE (a file, or an address on this machine) < {"width", "height", "scripts": [..], "screenshots": [path or null, ..], "downloads": folder, "webgpu": true for WebGPU in software, "lively": true for a page that may move by itself, "dark", "touch", "scale": pixels of the screen for each of the page, "whole": true for screenshots of the whole page and not of the window, "flags": [..], "opening": a script that runs before those of the page}
import { readFileSync } from "node:fs";
import { join } from "node:path";
import { pathToFileURL } from "node:url";
import { chromium } from "playwright-core";

const [executablePath, page] = process.argv.slice(2);
const { width, height, scripts, screenshots = [], downloads, webgpu, flags = [], lively, dark, touch, scale, whole, opening } = JSON.parse(readFileSync(0, "utf8"));
const args = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run",
  "--disable-background-networking", "--disable-component-update", "--disable-sync", ...flags];
if (webgpu) args.push("--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader", "--enable-features=Vulkan", "--use-vulkan=swiftshader");
const browser = await chromium.launch({ executablePath, args });
try {
  const tab = await browser.newPage({
    viewport: { width, height }, reducedMotion: lively ? "no-preference" : "reduce", colorScheme: dark ? "dark" : "light", hasTouch: touch, deviceScaleFactor: scale,
  });
  const requests = [], messages = [], results = [], files = [];
  if (downloads) tab.on("download", (file) => files.push(file.saveAs(join(downloads, file.suggestedFilename()))));
  tab.on("request", (request) => requests.push(request.url()));
  tab.on("console", (message) => messages.push(message.text()));
  tab.on("pageerror", (error) => messages.push(`${error}`));
  if (opening) await tab.addInitScript(opening);
  const [place, hash] = page.split("#");
  const address = place.startsWith("http://") ? place : pathToFileURL(place).href;
  await tab.goto(hash ? `${address}#${hash}` : address);
  for (let i = 0; i < scripts.length; ++i) {
    results.push(await tab.evaluate(scripts[i]));
    if (!screenshots[i]) continue;
    // Software WebGL has no larger pictures; below, Chromium would begin at the top again.
    const clip = whole && { x: 0, y: 0, width, height: Math.min(8192, await tab.evaluate("document.documentElement.scrollHeight")) };
    await tab.screenshot({ path: screenshots[i], fullPage: whole, timeout: 120000, ...(clip && { clip }) });
  }
  await Promise.all(files);
  console.log(JSON.stringify({ requests: requests.filter((url) => url !== address), messages, results }));
} finally {
  await browser.close();
}
