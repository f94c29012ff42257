// Builds dist/mien.js, dist/motion.js, dist/element.js and dist/webgpu.js (the package), and src/mien/export/page.html and webgpu.js (the page that
// `mien export` fills, and what --webgpu puts into it; they are committed, so that the Python package needs no node). `node build.mjs FOLDER` writes both into FOLDER instead.
import { build } from "esbuild";
import { mkdir, readFile, writeFile } from "node:fs/promises";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";
import { gzipSync } from "node:zlib";

const here = dirname(fileURLToPath(import.meta.url));
const folder = process.argv[2];
const options = { bundle: true, minify: true, target: "es2022", charset: "ascii", legalComments: "none", write: false, absWorkingDir: here, external: ["./webgpu.js"] };
/** A number of a shader with no more digits than a float has. */
const shorter = (number) => {
  const exact = Math.fround(number);
  for (let digits = 1; ; ++digits) if (Math.fround(exact.toPrecision(digits)) === exact) return String(Number(exact.toPrecision(digits)));
};
/** Shaders without comments and blanks. */
const shaders = {
  name: "shaders",
  setup: (on) =>
    on.onLoad({ filter: /shaders\.ts$/ }, async ({ path }) => ({
      contents: (await readFile(path, "utf8")).replace(/(?<!:)\/\/ .*$/gm, "").replace(/^ +/gm, "").replace(/\d+\.\d{7,}/g, shorter).replace(/ *([=+*/<>?:,;{}()&|-]) */g, "$1"),
      loader: "ts",
    })),
};
const bundle = async (entry, format) => {
  const result = await build({ ...options, plugins: [shaders], entryPoints: [entry], format });
  return result.outputFiles[0].text.trimEnd();
};
const write = async (path, text) => {
  await mkdir(dirname(path), { recursive: true });
  await writeFile(path, text);
  console.log(`${path}: ${text.length} bytes, ${gzipSync(text, { level: 9 }).length} gzipped`);
};

const script = await bundle("src/page.ts", "iife");
if (script.includes("</script")) throw new Error("the script would end its own element");
const template = await readFile(join(here, "src/page.html"), "utf8");
for (const [name, entry] of [["mien.js", "src/index.ts"], ["motion.js", "src/motion.ts"], ["element.js", "src/element.ts"], ["webgpu.js", "src/webgpu.ts"]])
  await write(folder ? join(folder, name) : join(here, "dist", name), (await bundle(entry, "esm")) + "\n");
await write(folder ? join(folder, "page.html") : join(here, "../src/mien/export/page.html"), template.replace("{{script}}", () => script));
const gpu = await build({ ...options, plugins: [shaders], entryPoints: ["src/webgpu.ts"], format: "iife", globalName: "mienWebGpu" });
await write(folder ? join(folder, "webgpu_page.js") : join(here, "../src/mien/export/webgpu.js"), gpu.outputFiles[0].text);
