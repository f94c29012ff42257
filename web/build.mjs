// Builds dist/ (the package), and src/mien/formats/shared/page.html, webgpu.js, webcam.html and microphone.html (the page that
// `mien export` fills, and what --webgpu, --webcam and --microphone put into it), and the pages of src/mien/studio. They are committed, so that the Python package needs no node. `node build.mjs FOLDER` writes all into FOLDER instead.
import asc from "assemblyscript/asc";
import { build, transform } from "esbuild";
import { mkdir, readFile, writeFile } from "node:fs/promises";
import { basename, dirname, join } from "node:path";
import { fileURLToPath } from "node:url";
import { gzipSync } from "node:zlib";
import { minify } from "terser";

const here = dirname(fileURLToPath(import.meta.url));
const folder = process.argv[2];
const presets = JSON.stringify(JSON.parse(await readFile(join(here, "../src/mien/runtime/presets.json"), "utf8")));
const options = { bundle: true, minify: true, target: "es2022", charset: "ascii", legalComments: "none", write: false, absWorkingDir: here, external: ["./webgpu.js", "three", "three/*", "@sparkjsdev/spark", "playcanvas", "@babylonjs/core/*"] };
/** A number of a shader with no more digits than a float has. */
const shorter = (number) => {
  const exact = Math.fround(number);
  for (let digits = 1; ; ++digits) if (Math.fround(exact.toPrecision(digits)) === exact) return String(Number(exact.toPrecision(digits)));
};
/** Long names in shaders.ts, which only its shaders use. */
const LONG = "determinant log2Opacity LOG2_ALPHA_MIN HALF_LOG2E FOV_MARGIN DILATION NEAR tangent margin clamped corner pixel reach frame scale area slope local head mean v_place v_roots v_color o_color shRest turn power place".split(" ");
/** Shaders without comments and blanks. */
const shaders = {
  name: "shaders",
  setup: (on) =>
    on.onLoad({ filter: /shaders\.ts$/ }, async ({ path }) => ({
      contents: (await readFile(path, "utf8")).replace(/(?<!:)\/\/ .*$/gm, "").replace(/^ +/gm, "").replace(/\d+\.\d{7,}/g, shorter).replace(/ *([=+*/<>?:,;{}()&|-]) */g, "$1")
        .replace(/(?<!\.)\b\w+\b/g, (word) => (path.endsWith("/shaders.ts") && LONG.includes(word) ? `_${LONG.indexOf(word).toString(36)}` : word)),
      loader: "ts",
    })),
};
/** A module of WebAssembly, compiled from AssemblyScript: src/NAME.wasm is made of wasm/NAME.ts. */
const compiled = {
  name: "compiled",
  setup: (on) => {
    on.onResolve({ filter: /\.wasm$/ }, ({ path }) => ({ path: join(here, "wasm", basename(path, ".wasm") + ".ts"), namespace: "wasm" }));
    on.onLoad({ filter: /.*/, namespace: "wasm" }, async ({ path }) => {
      let contents;
      const flags = ["-O3", "--noAssert", "--runtime", "stub", "--enable", "simd", "--importMemory"];
      const { error, stderr } = await asc.main([basename(path), "-o", "out.wasm", ...flags], {
        readFile: (name) => readFile(join(dirname(path), name), "utf8").catch(() => null),
        writeFile: (name, data) => (contents = data),
        listFiles: () => [],
      });
      if (error) throw new Error(stderr.toString());
      return { contents, loader: "binary" };
    });
  },
};
/** Files of the package that others import, instead of a copy of their own. */
const apart = {
  name: "apart",
  setup: (on) => on.onResolve({ filter: /^\.\/(index|gaussians)$/ }, ({ path }) => ({ path: path === "./index" ? "./mien.js" : `${path}.js`, external: true })),
};
const bundle = async (entry, format, define = {}, plugins = []) => {
  const result = await build({ ...options, plugins: [shaders, compiled, ...plugins], entryPoints: [entry], format, define: { PRESETS: presets, ...define } });
  // esbuild bundles; terser makes what it bundles smaller still: 3 % of a page.
  const { code } = await minify(result.outputFiles[0].text, { ecma: 2020, module: format === "esm", compress: { passes: 3 }, mangle: true, format: { ascii_only: true } });
  return code.trimEnd();
};
const write = async (path, text) => {
  await mkdir(dirname(path), { recursive: true });
  await writeFile(path, text);
  console.log(`${path}: ${text.length} bytes, ${gzipSync(text, { level: 9 }).length} gzipped`);
};

const script = await bundle("src/page.ts", "iife");
if (script.includes("</script")) throw new Error("the script would end its own element");
const detector = { DETECTOR: JSON.stringify(await bundle("src/webcam_detector.ts", "iife")) };
const studio = { studio: await bundle("src/studio/studio.ts", "iife", detector), phone: await bundle("src/studio/phone.ts", "iife") };
const camera = await bundle("src/webcam_page.ts", "iife", detector);
const voice = await bundle("src/microphone_page.ts", "iife");
if (`${camera}${voice}${studio.studio}${studio.phone}`.includes("</script")) throw new Error("a script would end its own element");
/** A page's html without blanks between its lines, and with small styles. */
const smaller = async (name) => {
  const [, before, style, after] = /^(.*<style>)(.*)(<\/style>.*)$/s.exec(await readFile(join(here, "src", name), "utf8"));
  const { code } = await transform(style, { loader: "css", minify: true, charset: "utf8" });
  return before.replace(/\n/g, "") + code.trim() + after.replace(/\n(?!$)/g, "");
};
const template = await smaller("page.html");
for (const [name, entry] of [["mien.js", "src/index.ts"], ["motion.js", "src/motion.ts"], ["element.js", "src/element.ts"], ["webgpu.js", "src/webgpu.ts"], ["webcam.js", "src/webcam.ts"]])
  await write(folder ? join(folder, name) : join(here, "dist", name), (await bundle(entry, "esm", detector)) + "\n");
for (const name of ["gaussians", "three", "spark", "playcanvas", "babylon"])
  await write(folder ? join(folder, `${name}.js`) : join(here, "dist", `${name}.js`), (await bundle(`src/${name}.ts`, "esm", {}, [apart])) + "\n");
const page = (name, text, own = name, room = "formats/shared") => write(folder ? join(folder, own) : join(here, "../src/mien", room, name), text);
await page("page.html", template.replace("{{script}}", () => script));
await page("microphone.html", (await smaller("microphone_page.html")).replace("{{script}}", () => voice));
await page("webcam.html", (await smaller("webcam_page.html")).replace("{{script}}", () => camera));
for (const [name, code] of Object.entries(studio)) await page(`${name}.html`, (await smaller(`studio/${name}.html`)).replace("{{script}}", () => code), undefined, "studio");
const gpu = await build({ ...options, plugins: [shaders], entryPoints: ["src/webgpu.ts"], format: "iife", globalName: "mienWebGpu" });
await page("webgpu.js", gpu.outputFiles[0].text, "webgpu_page.js");
