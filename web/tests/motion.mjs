// Reads a recording for an avatar as a page does, for tests/test_web_motion.py: fps, the number of moments, the beginning of
// the motion's arrays and the notes, or the error; and a minute of blinks and sways.
import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

export default async function motion(bundle, motions, path, recording) {
  const { readMien } = await import(pathToFileURL(bundle).href);
  const { blinkAt, readSeries, swayAt } = await import(pathToFileURL(motions).href);
  const bytes = readFileSync(path);
  const avatar = readMien(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength));
  try {
    const notes = [], read = readSeries(readFileSync(recording, "utf8"), avatar, notes);
    const told = Object.fromEntries(Object.entries(read).map(([name, values]) => [name, typeof values === "number" ? values : Array.from(values.subarray(0, 100_000))]));
    const times = Array.from({ length: 6000 }, (_, i) => i / 100);
    return { ...told, moments: read.head_rotation.length / 3, notes, blinks: times.map(blinkAt), sways: times.map(swayAt) };
  } catch (error) {
    return { error: error.message };
  }
}
