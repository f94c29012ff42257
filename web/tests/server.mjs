// Serves a worker of the tests: a line of json is a question, and a line of json the answer, {"told"} or {"error"}.
//   node server.mjs CHROMIUM < {"page": PAGE, ..}   opens a page as browser.mjs does; the browser stays for the next one
//                              {"run": "pose.mjs", "given": [..]}   calls the function of a script of this folder
import { createInterface } from "node:readline";
import { launch, visit } from "./browser.mjs";

const [executablePath] = process.argv.slice(2);
/** The browser without options of its own, and the last one with others. */
const browsers = new Map();

async function browserFor({ webgpu, flags = [] }) {
  const kind = webgpu || flags.length ? "other" : "usual", options = JSON.stringify([webgpu, flags]);
  const there = browsers.get(kind);
  if (there?.options === options && there.browser.isConnected()) return there.browser;
  await there?.browser.close();
  browsers.set(kind, { options, browser: await launch(executablePath, { webgpu, flags }) });
  return browsers.get(kind).browser;
}

for await (const line of createInterface({ input: process.stdin })) {
  const { page, run, given, ...more } = JSON.parse(line);
  let answer;
  try {
    answer = { told: run ? await (await import(`./${run}`)).default(...given) : await visit(await browserFor(more), page, more) };
  } catch (error) {
    answer = { error: `${error?.stack ?? error}` };
  }
  process.stdout.write(`${JSON.stringify(answer)}\n`);
}
for (const { browser } of browsers.values()) await browser.close();
process.exit();
