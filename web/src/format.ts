// Reads .mien files (docs/avatar_file.md) and their packed form, which `mien export --out NAME.html` puts into pages.

import type { Avatar, BlendSkinned, Motion } from "./avatar";
import { onTriangle, skinnedFault } from "./skinned";

type Numbers = Float32Array | Int32Array;
type Tree = null | boolean | number | string | Tree[] | { [key: string]: Tree };

/** A file that cannot be read. Its message is for the user. */
export class AvatarError extends Error {}

const VERSIONS = [1, 2, 3, 4, 5, 6];
const BEYOND = "is damaged: an array lies beyond its end";

/** The avatar in a .mien file. The checksum is not checked: that is the work of `mien`. */
export function readMien(file: ArrayBuffer): Avatar {
  const header = safetensorsHeader(file);
  const told = parse((header.__metadata__ as { mien?: string } | undefined)?.mien ?? "{}") as { [key: string]: Tree };
  if (told.format !== "mien.baked") throw new AvatarError("is not a .mien file");
  if (!VERSIONS.includes(told.version as number)) {
    throw new AvatarError(`has version ${told.version} of the format; this page reads ${VERSIONS.join(", ")}`);
  }
  const start = 8 + Number(new DataView(file).getBigUint64(0, true));
  const tensor = (name: string): Numbers => {
    const entry = header[name] as { dtype: string; data_offsets: [number, number] } | undefined;
    if (!entry) throw new AvatarError(`is damaged: there is no array ${name}`);
    const [from, to] = entry.data_offsets;
    if (start + to > file.byteLength) throw new AvatarError(BEYOND);
    const bytes = file.slice(start + from, start + to);
    return entry.dtype === "I32" ? new Int32Array(bytes) : new Float32Array(bytes);
  };
  return checked(restored(told.content, tensor) as unknown as Avatar);
}

function safetensorsHeader(file: ArrayBuffer): { [key: string]: Tree } {
  const size = file.byteLength >= 8 ? Number(new DataView(file).getBigUint64(0, true)) : Infinity;
  if (8 + size > file.byteLength) throw new AvatarError("is not a .mien file");
  return parse(new TextDecoder().decode(new Uint8Array(file, 8, size))) as { [key: string]: Tree };
}

interface PackedTensor {
  shape: number[];
  bits: 8 | 16 | 32;
  integers?: true;
  axis?: "first" | "columns";
  middle: number[];
  step: number[];
  at: number;
}

/**
 * The avatar, and the motion if there is one, in the packed form (src/mien/export/packed.py): gzip around the length of
 * a json text (uint32), that text, and the arrays as integers of 8 or 16 bits.
 */
export async function readPacked(packed: Uint8Array): Promise<{ avatar: Avatar; motion: Motion | null }> {
  const stream = new Blob([packed as BlobPart]).stream().pipeThrough(new DecompressionStream("gzip"));
  const file = await new Response(stream).arrayBuffer();
  const size = new DataView(file).getUint32(0, true);
  const told = parse(new TextDecoder().decode(new Uint8Array(file, 4, size))) as { [key: string]: Tree };
  if (told.format !== "mien.packed" || told.version !== 1) throw new AvatarError("was written by another version of mien");
  const tensors = told.tensors as unknown as { [name: string]: PackedTensor };
  const tensor = (name: string) => unpack(file, 4 + size, tensors[name]);
  const content = restored(told.content, tensor) as unknown as { avatar: Avatar; motion: Motion | null };
  return { avatar: checked(content.avatar), motion: content.motion };
}

/** value = middle + integer * step, with one middle and step for each index of the first axis or for each column. */
function unpack(file: ArrayBuffer, start: number, tensor: PackedTensor): Numbers {
  const count = tensor.shape.reduce((product, size) => product * size, 1);
  const from = start + tensor.at;
  if (from + (count * tensor.bits) / 8 > file.byteLength) throw new AvatarError(BEYOND);
  if (tensor.bits === 32) {
    const bytes = file.slice(from, from + 4 * count);
    return tensor.integers ? new Int32Array(bytes) : new Float32Array(bytes);
  }
  // Integers of 16 bits have their low bytes first, all of them, then their high bytes: that compresses better.
  const low = new Uint8Array(file, from, count);
  const high = new Int8Array(file, tensor.bits === 16 ? from + count : from, count);
  const integer = tensor.bits === 16 ? (i: number) => 256 * high[i] + low[i] : (i: number) => high[i];
  if (tensor.integers) {
    // Differences of neighbours.
    const out = new Int32Array(count);
    for (let i = 0, sum = 0; i < count; ++i) out[i] = sum = (sum + integer(i)) | 0;
    return out;
  }
  const groups = tensor.middle.length, each = count / groups, out = new Float32Array(count);
  const [across, along] = tensor.axis === "columns" ? [1, groups] : [each, 1];
  for (let group = 0, i = 0; group < groups; ++group)
    for (let k = 0; k < each; ++k, ++i) out[group * across + k * along] = tensor.middle[group] + integer(i) * tensor.step[group];
  return out;
}

function parse(text: string): Tree {
  try {
    return JSON.parse(text);
  } catch {
    throw new AvatarError("is damaged: its header is no json");
  }
}

/** The tree with arrays in place of their names. */
function restored(node: Tree, tensor: (name: string) => Numbers): unknown {
  if (Array.isArray(node)) return node.map((item) => restored(item, tensor));
  if (node === null || typeof node !== "object") return node;
  if (typeof node.tensor === "string") return tensor(node.tensor);
  return Object.fromEntries(Object.entries(node).map(([key, item]) => [key, restored(item, tensor)]));
}

/** Refuses what this runtime cannot draw, and indices that lead nowhere. */
function checked(given: Avatar): Avatar {
  const isSkinned = (given.baked.kind as string) === "BlendSkinned";
  const fault = isSkinned ? skinnedFault(given.baked as unknown as BlendSkinned) : "";
  if (fault) throw new AvatarError(fault);
  const avatar = isSkinned ? onTriangle(given) : given, baked = avatar.baked;
  if (baked.kind !== "MeshBound") throw new AvatarError(`holds a ${baked.kind} avatar; this page draws MeshBound ones (gaussian_avatars)`);
  const points = baked.rig.template.length / 3, triangles = baked.faces.length / 3, count = baked.face_index.length;
  const inside = (indices: Int32Array, size: number) => indices.every((index) => index >= 0 && index < size);
  const { quats, log_scales, opacity_logits, sh } = baked.attributes;
  const fits =
    inside(baked.faces, points) && inside(baked.face_index, triangles) && baked.means.length === 3 * count &&
    quats.length === 4 * count && log_scales.length === 3 * count && opacity_logits.length === count &&
    [1, 4, 9, 16].includes(sh.length / 3 / Math.max(count, 1));
  const features = baked.changes?.features;
  if (features) {
    const { neutral, basis, own, weights, biases } = features, rank = baked.changes!.directions.length / baked.changes!.rest.length;
    const hidden = biases[0].length, inputs = (neutral.length + own.length) / Math.max(count, 1);
    const whole =
      weights.length === 2 && biases.length === 2 && basis.length === rank * neutral.length && biases[1].length === 4 &&
      weights[0].length === hidden * inputs && weights[1].length === 4 * hidden;
    if (!whole) throw new AvatarError("is damaged: its features do not fit together");
  }
  if (!fits) throw new AvatarError("is damaged: its arrays do not fit together");
  return avatar;
}
