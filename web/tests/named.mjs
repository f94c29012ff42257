// Sets faces by names, and prints each as json: whether every name works, its expression and its joints.
// tests/test_face_loading.py calls it:
//   node named.mjs MIEN.JS AVATAR.mien FACES.json
import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [script, file, faces] = process.argv.slice(2);
const { copyFace, readMien, setNamed } = await import(pathToFileURL(script).href);
const bytes = readFileSync(file), avatar = readMien(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length));
const told = JSON.parse(readFileSync(faces, "utf8")).map((names) => {
  const face = copyFace(avatar.neutral), look = new Map();
  const works = Object.entries(names).map(([name, value]) => setNamed(avatar, face, look, name, value)).every(Boolean);
  return { works, expression: [...face.expression], joints: [...face.joints] };
});
console.log(JSON.stringify(told));
