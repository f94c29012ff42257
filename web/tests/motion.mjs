// Reads a recording for an avatar as a page does, for tests/test_web_motion.py:
//   node motion.mjs MIEN.JS MOTION.JS AVATAR.mien RECORDING OUT   writes fps, the number of moments, the beginning of the
// motion's arrays and the notes as json
import { readFileSync, writeFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [bundle, motions, path, recording, out] = process.argv.slice(2);
const { readMien } = await import(pathToFileURL(bundle).href);
const { blinkAt, readSeries, swayAt } = await import(pathToFileURL(motions).href);
const bytes = readFileSync(path);
const avatar = readMien(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength));
let told;
try {
  const notes = [], motion = readSeries(readFileSync(recording, "utf8"), avatar, notes);
  told = Object.fromEntries(Object.entries(motion).map(([name, values]) => [name, typeof values === "number" ? values : Array.from(values.subarray(0, 100_000))]));
  told.moments = motion.head_rotation.length / 3;
  told.notes = notes;
} catch (error) {
  told = { error: error.message };
}
const times = Array.from({ length: 6000 }, (_, i) => i / 100);
writeFileSync(out, JSON.stringify({ ...told, blinks: times.map(blinkAt), sways: times.map(swayAt) }));
