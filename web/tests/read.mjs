// Reads an avatar as a page does, for tests/test_web.py:
//   node read.mjs MIEN.JS AVATAR   prints json: the error's message, if there is one, and the most memory in bytes
import { existsSync, readFileSync, statSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [bundle, path] = process.argv.slice(2);
const { AvatarError, Poser, readAny } = await import(pathToFileURL(bundle).href);
let message = "", bytes = null;
try {
  if (statSync(path).isFile()) bytes = new Uint8Array(readFileSync(path));
  else message = "is not a file"; // as a pipe, or /dev/zero, which has no end
} catch (error) {
  message = `cannot be opened (${error.code})`; // no matter of the reader: a page hands it bytes
}
try {
  if (bytes !== null) {
    const { avatar } = await readAny(bytes);
    new Poser(avatar.baked).pose(avatar.neutral);
  }
} catch (error) {
  message = error instanceof AvatarError ? error.message : `not told: ${error}`;
}
// The system's other count, maxRSS, begins with the memory of the process that started this one.
const status = existsSync("/proc/self/status") ? readFileSync("/proc/self/status", "utf8") : "";
const kilobytes = /VmHWM:\s+(\d+)/.exec(status)?.[1] ?? process.resourceUsage().maxRSS;
console.log(JSON.stringify({ message, memory: 1024 * kilobytes }));
