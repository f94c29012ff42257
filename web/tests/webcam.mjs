// Follows what a detector found, without a camera, for tests/test_web_webcam.py:
//   node webcam.mjs WEBCAM.JS < {"mirrored", "found": [..], "recalibrate": index or null, "smooth": {"smoothing", "values", "step"}}
// prints the readings (null without one), and the smoothed values, as json.
import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const { Follower, OneEuro } = await import(pathToFileURL(process.argv[2]).href);
const { mirrored, found, recalibrate, smooth } = JSON.parse(readFileSync(0, "utf8"));
const follower = new Follower();
follower.mirrored = mirrored;
const readings = found.map((one, i) => {
  if (i === recalibrate) follower.calibrate();
  const reading = follower.follow(one);
  return reading && { ...reading, scores: Object.fromEntries(reading.scores), turn: [...reading.turn], calibrating: follower.calibrating };
});
const filter = new OneEuro(smooth?.smoothing);
console.log(JSON.stringify({ readings, smoothed: smooth?.values.map((value, i) => filter.next(value, i * smooth.step)) }));
