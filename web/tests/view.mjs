// Opens a viewer's address in headless Chromium, does steps, and prints all requests and errors of the page as json, and the
// width divided by the height of the canvas at each saving.
// tests/test_viewer_page.py calls it:
//   node view.mjs CHROMIUM ADDRESS < {"width", "height", "steps": [..]}
// A narrow window is that of a phone. A step is one of: {"see": text}, {"wait": milliseconds}, {"click": text of a button}, {"drag": [x, y]},
// {"fill": [label, text]}, {"save": [button, path]}, {"screenshot": path}, {"reload": true}.
import { readFileSync } from "node:fs";
import { chromium } from "playwright-core";

const [executablePath, address] = process.argv.slice(2);
const { width, height, steps } = JSON.parse(readFileSync(0, "utf8"));
const args = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run",
  "--disable-background-networking", "--disable-component-update", "--disable-sync"];
const browser = await chromium.launch({ executablePath, args });
try {
  const context = await browser.newContext({ viewport: { width, height }, isMobile: width < 600, acceptDownloads: true });
  const requests = [], errors = [], shapes = [];
  const tab = await context.newPage();
  tab.on("request", (request) => requests.push(request.url()));
  tab.on("pageerror", (error) => errors.push(`${error}`));
  tab.setDefaultTimeout(60000);
  await tab.goto(address);
  const act = async (step) => {
    if (step.wait) return tab.waitForTimeout(step.wait);
    if (step.see) return tab.getByText(step.see).first().waitFor();
    if (step.click) return tab.getByText(step.click, { exact: true }).first().click();
    if (step.fill) return tab.locator(`xpath=//*[text()="${step.fill[0]}"]/following::input[1]`).fill(step.fill[1]);
    if (step.screenshot) return void (await tab.screenshot({ path: step.screenshot }));
    if (step.reload) return void (await tab.reload());
    if (step.drag) {
      const [x, y] = [0.3 * width, 0.5 * height];
      await tab.mouse.move(x, y);
      await tab.mouse.down();
      await tab.mouse.move(x + step.drag[0], y + step.drag[1], { steps: 5 });
      return tab.mouse.up();
    }
    if (step.save) {
      shapes.push(await tab.locator("canvas").first().evaluate((canvas) => canvas.clientWidth / canvas.clientHeight));
      const coming = tab.waitForEvent("download", { timeout: 170000 });
      const button = tab.getByText(step.save[0], { exact: true }).first();
      const pressing = (async () => {
        // A button in a folder that is still opening moves away from the pointer on a busy machine, so it is pressed again.
        for (let press = 0; press < 3; press++) {
          await button.click();
          if (await Promise.race([coming.then(() => true), tab.waitForTimeout(50000).then(() => false)])) return;
        }
      })();
      const [download] = await Promise.all([coming, pressing]);
      return download.saveAs(step.save[1]);
    }
    throw new Error(`no such step: ${JSON.stringify(step)}`);
  };
  for (const step of steps) await act(step);
  console.log(JSON.stringify({ requests, errors, shapes }));
} finally {
  await browser.close();
}
