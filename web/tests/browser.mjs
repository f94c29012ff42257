// Opens a page in headless Chromium with software WebGL, and does its scripts or steps one after the other.
//   node browser.mjs CHROMIUM PAGE (a file, or an address on this machine) < {"width", "height", ..}
// prints json: results of the scripts, requests of the page, its messages, and the ratio of the canvas at each saving.
// server.mjs does the same for many pages in one browser. What can be asked for:
//   "scripts": [..], "screenshots": [path or null, ..], "whole": true for screenshots of the whole page and not of the window
//   "steps": [..] instead of scripts, each one of {"see": text}, {"click": text of a button}, {"press": selector},
//     {"keys": names}, {"tab": selector}: Tab until that has the focus, {"back": selector}: the same by Shift+Tab; the focus
//     has to be seen at each place, {"focused": selector}: wait until the page gives it the focus, {"drag": [x, y]},
//     {"fill": [label, text]}, {"give": [selector of an input, path]}, {"save": [button, path]}, {"reload": true}, {"wait": milliseconds}, {"screenshot": path},
//     {"settled": path}: a screenshot that differs from the last one and stays as it is
//   "webgpu": true for WebGPU in software, "flags": further options of Chromium, "downloads": folder, "opening": a script
//   that runs before those of the page, "lively": true for a page that may move by itself, "dark", "touch", "mobile",
//   "scale": pixels of the screen for each of the page
import { readFileSync } from "node:fs";
import { join } from "node:path";
import { pathToFileURL } from "node:url";
import { chromium } from "playwright-core";

const PATIENCE = 120000;

/** Starts Chromium. */
export function launch(executablePath, { webgpu, flags = [] }) {
  const args = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", ...flags];
  if (webgpu) args.push("--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader", "--enable-features=Vulkan", "--use-vulkan=swiftshader");
  return chromium.launch({ executablePath, args });
}

/** Opens a page, does what is asked for, and closes it. */
export async function visit(browser, page, { width, height, scripts = [], screenshots = [], steps = [], downloads, lively, dark, touch, mobile, scale, whole, opening }) {
  const context = await browser.newContext({
    viewport: { width, height }, reducedMotion: lively ? "no-preference" : "reduce", colorScheme: dark ? "dark" : "light",
    hasTouch: touch || mobile, isMobile: mobile, deviceScaleFactor: scale,
  });
  try {
    const tab = await context.newPage(), requests = [], messages = [], results = [], files = [], shapes = [];
    tab.setDefaultTimeout(PATIENCE);
    if (downloads) tab.on("download", (file) => files.push(file.saveAs(join(downloads, file.suggestedFilename()))));
    tab.on("request", (request) => requests.push(request.url()));
    if (!steps.length) tab.on("console", (message) => messages.push(message.text()));
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
      await tab.screenshot({ path: screenshots[i], fullPage: whole, ...(clip && { clip }) });
    }
    const act = actions(tab, width, height, shapes);
    for (const step of steps) {
      const [[name, given]] = Object.entries(step);
      await act[name](given);
    }
    await Promise.all(files);
    return { requests: requests.filter((url) => url !== address), messages, results, shapes };
  } finally {
    await context.close();
  }
}

/** Presses a key until a place has the focus. Each place on the way has to show that it has it; a frame shows it inside. */
async function walk(tab, key, selector) {
  const places = [];
  for (let k = 0; k < 60; ++k) {
    await tab.keyboard.press(key);
    const [there, seen, place] = await tab.evaluate((wanted) => {
      const element = document.activeElement, { outlineStyle, outlineWidth } = getComputedStyle(element), { width } = element.getBoundingClientRect();
      const marked = width > 0 && outlineStyle !== "none" && parseFloat(outlineWidth) > 1;
      return [element.matches(wanted), marked || ["BODY", "IFRAME"].includes(element.tagName), element.outerHTML.slice(0, 80)];
    }, selector);
    if (!seen) throw new Error(`the focus is not seen on ${place}`);
    if (there) return;
    places.push(place);
  }
  throw new Error(`${key} does not reach ${selector}, but ${places.join(", ")}`);
}

/** What steps do, by their names. */
function actions(tab, width, height, shapes) {
  let last = Buffer.alloc(0);
  return {
    wait: (milliseconds) => tab.waitForTimeout(milliseconds),
    see: (text) => tab.getByText(text).first().waitFor(),
    match: (pattern) => tab.getByText(new RegExp(pattern)).first().waitFor(),
    click: (text) => tab.getByText(text, { exact: true }).first().click(),
    press: (selector) => tab.locator(selector).click(),
    async keys(names) {
      for (const name of names) await tab.keyboard.press(name);
    },
    tab: (selector) => walk(tab, "Tab", selector),
    back: (selector) => walk(tab, "Shift+Tab", selector),
    focused: (selector) => tab.locator(`${selector}:focus`).waitFor(),
    fill: ([label, text]) => tab.locator(`xpath=//*[text()="${label}"]/following::input[1]`).fill(text),
    give: ([selector, path]) => tab.locator(selector).setInputFiles(path),
    screenshot: (path) => tab.screenshot({ path }),
    reload: () => tab.reload(),
    async settled(path) {
      let before = last, same = 0;
      for (const began = Date.now(); same < 2; await tab.waitForTimeout(200)) {
        if (Date.now() - began > PATIENCE) throw new Error(`the picture of ${path} does not settle`);
        const now = await tab.screenshot({ path });
        same = now.equals(before) && !now.equals(last) ? same + 1 : 0;
        before = now;
      }
      last = before;
    },
    async drag([right, down]) {
      const [x, y] = [0.3 * width, 0.5 * height];
      await tab.mouse.move(x, y);
      await tab.mouse.down();
      await tab.mouse.move(x + right, y + down, { steps: 5 });
      await tab.mouse.up();
    },
    async save([name, path]) {
      shapes.push(await tab.locator("canvas").first().evaluate((canvas) => canvas.clientWidth / canvas.clientHeight));
      const coming = tab.waitForEvent("download", { timeout: 170000 }), button = tab.getByText(name, { exact: true }).first();
      // A button in a folder that is still opening moves away from the pointer on a busy machine, so it is pressed again.
      const pressing = (async () => {
        for (let press = 0; press < 3; press++) {
          await button.click();
          if (await Promise.race([coming.then(() => true), tab.waitForTimeout(50000).then(() => false)])) return;
        }
      })();
      const [download] = await Promise.all([coming, pressing]);
      await download.saveAs(path);
    },
  };
}

if (process.argv[1]?.endsWith("browser.mjs")) {
  const [executablePath, page] = process.argv.slice(2), given = JSON.parse(readFileSync(0, "utf8"));
  const browser = await launch(executablePath, given);
  try {
    console.log(JSON.stringify(await visit(browser, page, given)));
  } finally {
    await browser.close();
  }
}
