// Poses an avatar as a page does, for tests/web_case.py. OUT gets float32 arrays, face by face: points of the mesh, centres, raw
// opacities, first colours; then, of Gaussians on no mesh, rotations and scales.
import { readFileSync, writeFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

export default async function pose(bundle, path, given, out) {
  const { Poser, readMien, readPacked, standStill } = await import(pathToFileURL(bundle).href);
  const bytes = readFileSync(path);
  const whole = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength);
  const avatar = path.endsWith(".mien") ? readMien(whole) : (await readPacked(new Uint8Array(whole))).avatar;
  const faces = given.map((face) => Object.fromEntries(Object.entries(face).map(([name, values]) => [name, Float32Array.from(values)])));
  const poser = new Poser(avatar.baked);
  const written = faces.flatMap((face) => {
    standStill(face, avatar);
    poser.pose(face);
    const shapes = poser.free ? [poser.free.quats, poser.free.scales] : [];
    return [poser.points, poser.centres(), poser.opacityLogits, poser.colors, ...shapes].map((array) => Buffer.from(array.slice().buffer));
  });
  writeFileSync(out, Buffer.concat(written));
}
