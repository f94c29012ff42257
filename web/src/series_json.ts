// Blend shapes as json, in the layouts of several programs. It follows src/mien/driving/sources/json_layouts.py and blendshape_json.py.

import { AvatarError } from "./format";
import { axisAngle } from "./rigid";
import { median, type Row, type Series } from "./series";

type Json = Record<string, any>;
/** Names and scores of a frame, null without a face; the rows of its matrix; its time, and the units of that in a second. */
interface Frame {
  scores: [string, unknown][] | null;
  matrix?: number[][];
  time?: unknown;
  units: number;
}

/** ARKit's names in the order of Azure's speech service. The rolls of head and eyes after them are not read. */
const AZURE = (
  "eyeBlinkLeft eyeLookDownLeft eyeLookInLeft eyeLookOutLeft eyeLookUpLeft eyeSquintLeft eyeWideLeft eyeBlinkRight eyeLookDownRight " +
  "eyeLookInRight eyeLookOutRight eyeLookUpRight eyeSquintRight eyeWideRight jawForward jawLeft jawRight jawOpen mouthClose " +
  "mouthFunnel mouthPucker mouthLeft mouthRight mouthSmileLeft mouthSmileRight mouthFrownLeft mouthFrownRight mouthDimpleLeft " +
  "mouthDimpleRight mouthStretchLeft mouthStretchRight mouthRollLower mouthRollUpper mouthShrugLower mouthShrugUpper mouthPressLeft " +
  "mouthPressRight mouthLowerDownLeft mouthLowerDownRight mouthUpperUpLeft mouthUpperUpRight browDownLeft browDownRight browInnerUp " +
  "browOuterUpLeft browOuterUpRight cheekPuff cheekSquintLeft cheekSquintRight noseSneerLeft noseSneerRight tongueOut"
).split(" ");
const SHORTEST = 1 / 500, LONGEST = 3;

export function readJson(text: string, notes: string[]): Series {
  let content: any;
  try {
    content = JSON.parse(text);
  } catch {
    throw new AvatarError("is no json");
  }
  const [frames, rate] = framesOf(content);
  if (!frames.some((frame) => frame.scores)) throw new AvatarError("has no frame with blend shapes");
  const heads = headsOf(frames, notes);
  const rows = frames.map(({ scores }, index): Row | null => scores && { scores: scoresOf(scores, index), head: heads[index] });
  return { rows, seconds: secondsOf(frames, rate, notes), slack: 0 };
}

/** The frames of any layout, and their rate if the file states it. */
function framesOf(content: any): [Frame[], number | undefined] {
  const named = (names: unknown, weights: unknown): [string, unknown][] | null => {
    if (!Array.isArray(names) || (weights && (weights as unknown[]).length !== names.length)) throw new AvatarError("has other numbers of names and weights");
    return weights ? names.map((name, i) => [name, (weights as unknown[])[i]]) : null;
  };
  if (Array.isArray(content?.weightMat)) {
    const names = content.facsNames ?? content.faceNames;
    return [content.weightMat.map((weights: unknown) => ({ scores: named(names, weights), units: 1 })), rateOf(content.exportFps)];
  }
  if (content?.names && Array.isArray(content.frames))
    return [content.frames.map((frame: Json) => ({ scores: named(content.names, frame?.weights), ...timeOf(frame) })), rateOf(content.metadata?.fps)];
  const pieces = (Array.isArray(content) ? content : [content]) as Json[];
  if (pieces.every((piece) => Array.isArray(piece?.BlendShapes) && Number.isInteger(piece.FrameIndex)))
    return [pieces.flatMap(({ FrameIndex, BlendShapes }) => BlendShapes.map((row: unknown[], i: number): Frame => ({ scores: named(AZURE, row?.slice(0, AZURE.length)), time: (FrameIndex + i) / 60, units: 1 }))), undefined];
  return [pieces.map(oneFrame), undefined];
}

function rateOf(fps: unknown): number | undefined {
  if (fps === undefined || fps === null) return undefined;
  if (typeof fps !== "number" || !(fps >= 1 && fps <= 500)) throw new AvatarError(`has ${fps} frames per second`);
  return fps;
}

/** A frame of a plain list, or a result of FaceLandmarker in JavaScript or Python. */
function oneFrame(frame: Json): Frame {
  const faces = frame?.faceBlendshapes ?? frame?.face_blendshapes;
  const entries = faces?.[0] && (faces[0].categories ?? faces[0]);
  const found: [string, unknown][] | undefined = faces ? entries?.map((entry: Json) => [entry.categoryName ?? entry.category_name, entry.score]) : frame?.blendshapes && Object.entries(frame.blendshapes);
  const pose = frame?.facialTransformationMatrixes?.[0] ?? frame?.facial_transformation_matrixes?.[0];
  const flat: number[] | undefined = pose && (pose.data ?? pose.flat());
  const rows = flat && [0, 1, 2, 3].map((row) => [0, 1, 2, 3].map((column) => Number(pose.data ? flat[4 * column + row] : flat[4 * row + column])));
  return { scores: found ?? null, matrix: rows, ...timeOf(frame) };
}

function timeOf(frame: Json): { time: unknown; units: number } {
  const milliseconds = frame?.timestamp_ms ?? frame?.timestampMs;
  return milliseconds === undefined ? { time: frame?.time, units: 1 } : { time: milliseconds, units: 1000 };
}

/** Scores by ARKit's names in lower case. Apple's own _L and _R become left and right. */
function scoresOf(entries: [string, unknown][], index: number): Map<string, number> {
  const scores = new Map(entries.map(([name, score]) => [String(name).toLowerCase().replace(/_l$/, "left").replace(/_r$/, "right"), Number(score)] as [string, number]));
  if ([...scores.values()].some((value) => !Number.isFinite(value))) throw new AvatarError(`has a value that is no number in frame ${index}`);
  return scores;
}

/** Rotations of heads as axis-angle vectors. All matrices decide together whether they are transposed, since one without translation does not tell. */
function headsOf(frames: Frame[], notes: string[]): number[][] {
  const near = (value: number, wanted: number) => Math.abs(value - wanted) <= 0.01;
  const given = frames.filter((frame) => frame.matrix).map((frame) => frame.matrix as number[][]);
  const upright = (m: number[][]) => m[3].every((value, k) => near(value, +(k === 3)));
  const turned = (m: number[][]) => m[0].map((_, k) => m.map((row) => row[k]));
  const transposed = !given.every(upright) && given.every((m) => upright(turned(m)));
  if (transposed) notes.push("has transposed matrices, and is read so");
  return frames.map(({ matrix }, index) => {
    if (!matrix) return [0, 0, 0];
    const m = transposed ? turned(matrix) : matrix, size = Math.hypot(m[0][0], m[1][0], m[2][0]);
    if (!upright(m)) throw new AvatarError(`has a matrix whose last row is not 0 0 0 1 in frame ${index}`);
    const [x, y, z] = [0, 1, 2].map((k) => m.slice(0, 3).map((row) => row[k] / size));
    const dot = (a: number[], b: number[]) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    const across = [x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]];
    if (!(dot(across, z) > 0.7 && Math.max(...[dot(x, y), dot(y, z), dot(z, x), dot(y, y) - 1, dot(z, z) - 1].map(Math.abs)) < 0.4)) throw new AvatarError(`has a matrix that is not a rotation in frame ${index}`);
    return axisAngle([0, 1, 2].flatMap((k) => [x[k], y[k], z[k]]));
  });
}

/** Times in seconds. Those whose unit is another one than their name says are refused. */
function secondsOf(frames: Frame[], rate: number | undefined, notes: string[]): number[] {
  if (frames.every(({ time }) => time === undefined || time === null)) {
    if (rate === undefined && frames.length > 1) notes.push('has no times ("timestamp_ms", or "time" in seconds), so 30 frames a second are assumed');
    return frames.map((_, index) => index / (rate ?? 30));
  }
  const seconds = frames.map(({ time, units }, index) => {
    if (typeof time !== "number" || !Number.isFinite(time)) throw new AvatarError(`has a time that is no number in frame ${index}`);
    return time / units;
  });
  const steps = seconds.slice(1).map((time, i) => time - seconds[i]).filter((step) => step > 0);
  if (!steps.length) return seconds;
  const step = median(steps), isMilliseconds = frames[0].units > 1;
  if (step < SHORTEST) throw new AvatarError(`has ${Math.round(1 / step)} frames in a second; ${isMilliseconds ? 'give milliseconds, or call seconds "time"' : "give seconds"}`);
  if (step > LONGEST) throw new AvatarError(`has frames of ${Math.round(step)} s; ${isMilliseconds ? "give milliseconds" : 'give seconds, or call milliseconds "timestamp_ms"'}`);
  return seconds;
}
