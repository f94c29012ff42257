// Poses an avatar into arrays, for tests/test_web_engines.py. Returns centres, covariances, rotations, scales and colours.
import { readFileSync } from "node:fs";
import { join } from "node:path";
import { pathToFileURL } from "node:url";

export default async function gaussians(built, path, face, transform, eye, simd) {
  const [{ readAny }, { GaussianSource }] = await Promise.all(["mien.js", "gaussians.js"].map((name) => import(pathToFileURL(join(built, name)).href)));
  const { avatar } = await readAny(new Uint8Array(readFileSync(path)));
  const source = new GaussianSource(avatar, simd), n = source.count, first = 2;
  const into = Object.fromEntries([["centres", 3], ["covariances", 6], ["rotations", 4], ["scales", 3], ["colors", 4]].map(([name, width]) => [name, new Float32Array(width * (n + first))]));
  const numbers = Object.fromEntries(Object.entries(face).map(([name, values]) => [name, Float32Array.from(values)]));
  source.pose(avatar.neutral, into, { first });
  source.pose(numbers, into, { first, transform, eye });
  return Object.values(into).map((array) => Array.from(array.subarray((first * array.length) / (n + first))));
}
