// Follows what a detector found, without a camera, for tests/test_web_webcam.py: the readings (null without one),
// and the smoothed values.
import { pathToFileURL } from "node:url";

export default async function webcam(script, { mirrored, found, recalibrate, smooth }) {
  const { Follower, OneEuro } = await import(pathToFileURL(script).href);
  const follower = new Follower();
  follower.mirrored = mirrored;
  const readings = found.map((one, i) => {
    if (i === recalibrate) follower.calibrate();
    const reading = follower.follow(one);
    return reading && { ...reading, scores: Object.fromEntries(reading.scores), turn: [...reading.turn], calibrating: follower.calibrating };
  });
  const filter = new OneEuro(smooth?.smoothing);
  return { readings, smoothed: smooth?.values.map((value, i) => filter.next(value, i * smooth.step)) };
}
