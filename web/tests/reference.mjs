// Poses the avatar of a .glb by the reference of docs/spec, for tests/test_web_engines.py.
import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

export default async function reference(script, path, face) {
  const { readAvatar, pose } = await import(pathToFileURL(script).href), bytes = readFileSync(path);
  const glb = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength), posed = pose(readAvatar(glb), face);
  const json = JSON.parse(new TextDecoder().decode(new Uint8Array(glb, 20, new DataView(glb).getUint32(12, true))));
  const parts = ["centre", "covariance", "color", "opacity"].map((name) => posed.map((one) => [one[name]].flat(2)).map((row) => (name === "opacity" ? row[0] : row)));
  return { gaussians: parts, extension: json.extensions.MIEN_gaussian_avatar };
}
