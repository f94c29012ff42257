// What the validator of glTF says about a .glb file, for tests/test_glb.py.
import { readFileSync } from "node:fs";
import validator from "gltf-validator";

export default (path) => validator.validateBytes(new Uint8Array(readFileSync(path)), { maxIssues: 1000 });
