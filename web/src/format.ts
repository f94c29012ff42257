// Reads .mien files (docs/avatar_file.md) and their packed form, which `mien export --out NAME.html` puts into pages.

import type { Avatar, BlendSkinned, ExpressionChanges, Face, LinearBases, MeshBound, Motion, Rig, Static } from "./avatar";
import { WIDTHS } from "./points";
import { layoutOf } from "./rig";

type Numbers = Float32Array | Int32Array;
type Tree = null | boolean | number | string | Tree[] | { [key: string]: Tree };

/** A file that cannot be read. Its message is for the user. */
export class AvatarError extends Error {}

/** The version of both forms that is read: there is one. */
const VERSION = 1;
const BEYOND = "is damaged: an array lies beyond its end";
const DAMAGED = "is damaged: its header cannot be";
/** Most bytes of an avatar: a small file may unpack to gigabytes. */
const MOST_BYTES = 1 << 27;
/** Most bytes of the json text; it becomes many times as large. */
const MOST_TEXT = 1 << 23;

/** Of points, colours that depend on the view do not change with the face here. */
const APART = "is damaged, or not for pages: its arrays do not fit together";

const isWhole = (value: unknown, most: number): value is number => Number.isSafeInteger(value) && (value as number) >= 0 && (value as number) <= most;
const areNumbers = (values: unknown): values is number[] => Array.isArray(values) && values.every((value) => Number.isFinite(value));

/** The avatar in a .mien file. The checksum is not checked: that is the work of `mien`. */
export function readMien(file: ArrayBuffer): Avatar {
  return toldOf(() => avatarOf(file));
}

function avatarOf(file: ArrayBuffer): Avatar {
  const header = safetensorsHeader(file);
  const told = parse((header.__metadata__ as { mien?: string } | undefined)?.mien ?? "{}") as { [key: string]: Tree };
  if (told.format !== "mien.baked") throw new AvatarError("is not a .mien file");
  checkVersion(told.version);
  const start = 8 + Number(new DataView(file).getBigUint64(0, true));
  let left = file.byteLength - start;
  const tensor = (name: string): Numbers => {
    const entry = header[name] as { dtype: string; data_offsets: [number, number] } | undefined;
    if (!entry) throw new AvatarError(`is damaged: there is no array ${name}`);
    const [from, to] = Array.isArray(entry.data_offsets) ? entry.data_offsets : [];
    // Arrays share no bytes: together, they are as large as the file.
    if (!isWhole(to, file.byteLength - start) || !isWhole(from, to) || (to - from) % 4 || (left -= to - from) < 0) throw new AvatarError(BEYOND);
    const bytes = file.slice(start + from, start + to);
    return entry.dtype === "I32" ? new Int32Array(bytes) : new Float32Array(bytes);
  };
  return checked(restored(told.content, tensor) as unknown as Avatar);
}

function checkVersion(found: Tree | undefined): void {
  if (found !== VERSION) throw new AvatarError(`has version ${found} of the format, and version ${VERSION} is read; export it again with mien export`);
}

function safetensorsHeader(file: ArrayBuffer): { [key: string]: Tree } {
  const size = file.byteLength >= 8 ? Number(new DataView(file).getBigUint64(0, true)) : Infinity;
  if (8 + size > file.byteLength || size > MOST_TEXT) throw new AvatarError("is not a .mien file");
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
 * The avatar, and the motion if there is one, in the packed form (src/mien/formats/shared/packed.py): gzip around the length of
 * a json text (uint32), that text, and the arrays as integers of 8 or 16 bits.
 */
export async function readPacked(packed: Uint8Array): Promise<{ avatar: Avatar; motion: Motion | null }> {
  const stream = new Blob([packed as BlobPart]).stream().pipeThrough(new DecompressionStream("gzip"));
  const file = await readAll(stream).catch((error) => {
    throw error instanceof AvatarError ? error : new AvatarError("is damaged: it cannot be unpacked");
  });
  return toldOf(() => unpackedOf(file));
}

function unpackedOf(file: ArrayBuffer): { avatar: Avatar; motion: Motion | null } {
  const size = file.byteLength >= 4 ? new DataView(file).getUint32(0, true) : Infinity;
  if (4 + size > file.byteLength || size > MOST_TEXT) throw new AvatarError(DAMAGED);
  const told = parse(new TextDecoder().decode(new Uint8Array(file, 4, size))) as { [key: string]: Tree };
  if (told.format !== "mien.packed") throw new AvatarError("is not an avatar in packed form");
  checkVersion(told.version);
  const tensors = (told.tensors ?? {}) as unknown as { [name: string]: PackedTensor };
  let left = file.byteLength;
  const tensor = (name: string) => {
    const entry = tensors[name], count = entry && countOf(entry);
    if (!entry || !isWhole(count, file.byteLength)) throw new AvatarError(DAMAGED);
    // Arrays share no bytes: together, they are as large as the file.
    if ((left -= (count * entry.bits) / 8) < 0) throw new AvatarError(BEYOND);
    return unpack(file, 4 + size, entry, count);
  };
  const { avatar, motion } = restored(told.content, tensor) as unknown as { avatar: Avatar; motion: Motion | null };
  if (motion && !(motion.fps > 0 && isFace(motion, avatar.neutral, motion.head_rotation.length / 3))) throw new AvatarError(APART);
  return { avatar: checked(avatar), motion };
}

/** What `read` returns. Where it stumbles, something is missing in the file, or is of another kind. */
function toldOf<T>(read: () => T): T {
  try {
    return read();
  } catch (error) {
    throw error instanceof AvatarError ? error : new AvatarError(DAMAGED);
  }
}

/** The bytes of a stream. One that goes beyond MOST_BYTES is left there. */
export async function readAll(stream: ReadableStream<Uint8Array>): Promise<ArrayBuffer> {
  const parts: Uint8Array[] = [], reader = stream.getReader();
  for (let size = 0; ; ) {
    const { done, value } = await reader.read();
    if (done) return new Blob(parts as BlobPart[]).arrayBuffer();
    if ((size += value.length) > MOST_BYTES) {
      await reader.cancel();
      throw new AvatarError(`is larger than ${MOST_BYTES >> 20} MB`);
    }
    parts.push(value);
  }
}

/** The number of values of an array whose entry can be; else NaN. */
function countOf({ shape, bits, middle, step, at, integers }: PackedTensor): number {
  if (!areNumbers(shape) || !shape.every((side) => isWhole(side, MOST_BYTES)) || ![8, 16, 32].includes(bits) || !isWhole(at, MOST_BYTES)) return NaN;
  const count = shape.reduce((product, side) => product * side, 1);
  const grouped = areNumbers(middle) && areNumbers(step) && middle.length === step.length && count % Math.max(middle.length, 1) === 0;
  return bits === 32 || integers || grouped ? count : NaN;
}

/** An avatar in either form, told apart by its first bytes. */
export async function readAny(file: Uint8Array): Promise<{ avatar: Avatar; motion: Motion | null }> {
  if (file[0] === 0x1f && file[1] === 0x8b) return readPacked(file);
  return { avatar: readMien(file.slice().buffer as ArrayBuffer), motion: null };
}

/** value = middle + integer * step, with one middle and step for each index of the first axis or for each column. */
function unpack(file: ArrayBuffer, start: number, tensor: PackedTensor, count: number): Numbers {
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
  if ("length" in node) throw new AvatarError(DAMAGED); // it would be taken for a list, and be gone through without end
  return Object.fromEntries(Object.entries(node).map(([key, item]) => [key, restored(item, tensor)]));
}

/** Whether entries of an object are arrays of floats of these lengths. */
const fits = (holder: object, lengths: { [name: string]: number }): boolean =>
  Object.entries(lengths).every(([name, length]) => {
    const part = (holder as { [name: string]: unknown })[name];
    return part instanceof Float32Array && part.length === length;
  });

/** Whether arrays are those of `count` faces like another one. */
const isFace = (face: Face, { expression, joints }: Face, count: number): boolean =>
  fits(face, { expression: count * expression.length, joints: count * joints.length, head_rotation: 3 * count, head_translation: 3 * count });

/** Whether a rig's arrays fit together, and pose a face. */
function isRig(rig: Rig, { expression, joints }: Face): boolean {
  const size = rig.template.length, names = expression.length, count = rig.joint_names.length, moves = 3 * names * count;
  return (
    fits(rig, {
      template: size, expression_basis: names * size, joint_template: 3 * count, joint_rotation_basis: moves, joint_translation_basis: moves,
      skinning_weights: (size / 3) * count, ...(rig.pose_basis && { pose_basis: 3 * joints.length * size }),
    }) &&
    rig.expression_names.length === names && 3 * rig.joint_free.filter(Boolean).length === joints.length &&
    rig.joint_parents.every((parent, joint) => Number.isInteger(parent) && parent < joint)
  );
}

/** Whether changes with the face fit a face and `count` Gaussians. */
function isChanges(changes: ExpressionChanges, { expression, joints }: Face, count: number, triangles: number): boolean {
  const { rest, directions, seen, features, shares, head } = changes, rank = directions.length / rest.length;
  if (!fits(changes, { rest: expression.length + joints.length, seen: rank * Math.floor(seen.length / rank) })) return false;
  const { regions, own: ofRegion, width } = layoutOf(changes, triangles), turns = width - ofRegion;
  if (!Number.isInteger(regions) || !Number.isInteger(ofRegion) || (shares && !fits(changes, { shares: regions * triangles }))) return false;
  if (head && !fits(head, { rest: 6, directions: 6 * turns, seen: turns * Math.floor(head.seen.length / Math.max(turns, 1)) })) return false;
  if (!features) return true;
  const { neutral, own, weights, biases } = features, hidden = biases[0].length;
  return (
    weights.length === 2 && biases.length === 2 && fits(features, { basis: width * neutral.length }) && fits(biases, { 0: hidden, 1: 4 }) &&
    fits(weights, { 0: (hidden * (neutral.length + own.length)) / Math.max(count, 1), 1: 4 * hidden })
  );
}

const isIndices = (indices: Int32Array, size: number): boolean => indices instanceof Int32Array && indices.every((index) => index >= 0 && index < size);

/** Whether Gaussians fit their triangles, and a face. */
const isBound = ({ rig, faces, face_index, means, changes }: MeshBound, neutral: Face, count: number): boolean =>
  isIndices(faces, rig.template.length / 3) && isIndices(face_index, faces.length / 3) && face_index.length === count && means.length === 3 * count &&
  isRig(rig, neutral) && (!changes || isChanges(changes, neutral, count, faces.length / 3));

/** Whether points, and what changes their attributes, fit a face and `count` Gaussians. */
function isFree(baked: BlendSkinned | Static, neutral: Face, count: number): boolean {
  const { bases, network } = baked, { expression, joints } = neutral, inputs = expression.length + joints.length;
  const placed =
    baked.kind === "Static" ? fits(baked, { means: 3 * count })
    : baked.rig.template.length === 3 * count && isRig(baked.rig, neutral) && (!baked.still_weights || fits(baked, { still_weights: count, still_pose: 16 }));
  if (!placed) return false;
  for (const name in WIDTHS)
    if (bases?.[name as keyof LinearBases] && !fits(bases, { [name]: WIDTHS[name] * count * expression.length })) return false;
  if (!network) return true;
  const { base, weights, biases, outputs, along } = network, rank = along ? Math.round(along.directions.length / inputs) : 0;
  const own = Math.round(base.length / Math.max(count, 1));
  let before = own + (along ? 0 : 3);
  return (
    fits(network, { base: own * count }) && (!along || fits(along, { rest: inputs, directions: rank * inputs, basis: along.basis.length })) &&
    biases.length > 0 && biases.every((bias, layer) => fits([weights[layer], bias], { 0: before * bias.length, 1: (before = bias.length) })) &&
    before === outputs.reduce((sum, name) => sum + WIDTHS[name], 0)
  );
}

/** Refuses what this runtime cannot draw, and arrays that do not fit together. */
function checked(avatar: Avatar): Avatar {
  const { baked, neutral, camera, filmed } = avatar, inputs = neutral.expression.length + neutral.joints.length, { attributes } = baked, count = attributes.opacity_logits.length;
  const coefficients = attributes.sh.length / 3 / Math.max(count, 1);
  const whole =
    [1, 4, 9, 16].includes(coefficients) && fits(attributes, { quats: 4 * count, log_scales: 3 * count, opacity_logits: count, sh: 3 * count * coefficients }) &&
    fits(camera, { K: 9, viewmat: 16 }) && camera.width > 0 && camera.height > 0 &&
    fits(avatar, { expression_bounds: 2 * neutral.expression.length }) && isFace(neutral, neutral, 1) &&
    (!filmed || fits(filmed, { lowest: inputs, highest: inputs })) &&
    (baked.kind === "MeshBound" ? isBound(baked, neutral, count) : isFree(baked, neutral, count));
  if (!whole) throw new AvatarError(APART);
  return avatar;
}
