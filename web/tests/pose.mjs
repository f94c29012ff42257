// Poses an avatar as a page does, for tests/test_web.py:
//   node pose.mjs MIEN.JS AVATAR (.mien or packed) FACES.JSON OUT   writes float32 arrays, face by face:
//     points of the mesh, centres, raw opacities, first colours; then, of Gaussians on no mesh, rotations and scales
//   node pose.mjs MIEN.JS AVATAR FACES.JSON   prints milliseconds: least of posing and sorting, over all faces
import { readFileSync, writeFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [bundle, path, facesPath, out] = process.argv.slice(2);
const { DepthSorter, Poser, readMien, readPacked } = await import(pathToFileURL(bundle).href);
const bytes = readFileSync(path);
const whole = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength);
const avatar = path.endsWith(".mien") ? readMien(whole) : (await readPacked(new Uint8Array(whole))).avatar;
const faces = JSON.parse(readFileSync(facesPath, "utf8")).map((face) =>
  Object.fromEntries(Object.entries(face).map(([name, values]) => [name, Float32Array.from(values)])));
const poser = new Poser(avatar.baked);
if (out) {
  const written = faces.flatMap((face) => {
    poser.pose(face);
    const shapes = poser.free ? [poser.free.quats, poser.free.scales] : [];
    return [poser.points, poser.centres(), poser.opacityLogits, poser.colors, ...shapes].map((array) => Buffer.from(array.slice().buffer));
  });
  writeFileSync(out, Buffer.concat(written));
} else {
  const count = poser.faceIndex.length, depths = new Float32Array(count), sorter = new DepthSorter(count);
  const times = Array.from({ length: 60 }, (_, i) => {
    const began = performance.now();
    poser.pose(faces[i % faces.length]);
    poser.depths([0.1, 0.2, 0.9, 0.8], depths);
    sorter.sort(depths);
    return performance.now() - began;
  });
  console.log(JSON.stringify(Math.min(...times)));
}
