// Mouths of what a voice sounds like at each moment [loudness, vowel, low, high, seconds], for tests/test_web_motion.py.
import { pathToFileURL } from "node:url";

export default async function voice(script, moments) {
  const { Voice } = await import(pathToFileURL(script).href);
  const one = new Voice();
  return moments.map((moment) => one.next(...moment));
}
