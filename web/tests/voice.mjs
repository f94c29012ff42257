// Mouths of what a voice sounds like at each moment, for tests/test_web_microphone.py:
//   node voice.mjs VOICE.JS < [[loudness, vowel, low, high, seconds], ..] prints them as json.
import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const { Voice } = await import(pathToFileURL(process.argv[2]).href);
const voice = new Voice();
console.log(JSON.stringify(JSON.parse(readFileSync(0, "utf8")).map((moment) => voice.next(...moment))));
