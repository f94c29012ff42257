// Motions that other programs record: the csv of Live Link Face, and blend shapes as json (a plain list of frames, or
// results of MediaPipe's FaceLandmarker). It follows src/mien/driving: live_link_face.py, blendshape_json.py, transfer.py.

import { motionFace, type Avatar, type Motion } from "./avatar";
import { AvatarError } from "./format";
import { axisAngle, multiplied, rotationMatrix, transposed } from "./rigid";
import { transfer } from "./transfer";

/** What a recording says about one timestep. */
interface Row {
  /** Scores by the names of ARKit in lower case. Missing names are 0. */
  scores: Map<string, number>;
  /** Rotation of the head, row-major. */
  head: ArrayLike<number>;
}

const STILL = [1, 0, 0, 0, 1, 0, 0, 0, 1];

/** The motion in a recording, for an avatar. Its errors complete the sentence "NAME ...". */
export function readSeries(text: string, avatar: Avatar): Motion {
  const { rows, fps } = /^\s*[[{]/.test(text) ? readJson(text) : readCsv(text);
  const known = avatar.expression_names.filter((name) => rows.some((row) => row.scores.has(name.toLowerCase())));
  if (!known.length) throw new AvatarError("has none of this avatar's expressions");
  return transferred(rows, fps, avatar);
}

function readCsv(text: string): { rows: Row[]; fps: number } {
  const lines = text.replace(/^\ufeff/, "").split(/\r?\n/).filter((line) => line.trim());
  const header = lines[0]?.split(",").map((name) => name.trim().toLowerCase()) ?? [];
  if (!header.includes("timecode") || lines.length < 2) throw new AvatarError("is no csv of Live Link Face");
  const rows: Row[] = [], times: [number, number][] = [];
  for (const [index, line] of lines.slice(1).entries()) {
    const cells = line.split(","), scores = new Map<string, number>(), before = rows[rows.length - 1];
    times.push(timecode(cells[header.indexOf("timecode")] ?? "", index + 2));
    // A lost face has a count of 0. Its row repeats the one before.
    if (cells[header.indexOf("blendshapecount")]?.trim() === "0") {
      if (before) rows.push(before);
      else times.pop();
      continue;
    }
    header.forEach((name, column) => {
      if (name === "timecode" || name === "blendshapecount") return;
      const value = Number(cells[column]);
      if (!cells[column]?.trim() || !Number.isFinite(value) || Math.abs(value) > Math.PI) throw new AvatarError(`has ${cells[column] || "nothing"} for ${name} in line ${index + 2}`);
      scores.set(name, value);
    });
    rows.push({ scores, head: turned(scores.get("headyaw") ?? 0, scores.get("headpitch") ?? 0, scores.get("headroll") ?? 0) });
  }
  if (!rows.length) throw new AvatarError("has no row with a face");
  const most = Math.max(...times.map(([, frame]) => frame)), whole = new Set(times.map(([seconds]) => seconds)).size > 1;
  const rate = whole ? [24, 25, 30, 48, 50, 60, 90, 120, 240].find((usual) => usual > most) ?? 1000 : 60;
  return { rows, fps: rateOf(times.map(([seconds, frame]) => seconds + frame / rate)) };
}

function timecode(cell: string, line: number): [number, number] {
  const found = /^(\d+):(\d+):(\d+)[:;](\d+)(\.\d+)?$/.exec(cell.trim());
  if (!found) throw new AvatarError(`has the timecode "${cell}" in line ${line}`);
  return [3600 * +found[1] + 60 * +found[2] + +found[3], +found[4] + +(found[5] ?? 0)];
}

/** Yaw, then pitch, then roll, in the signs of Unreal. */
function turned(yaw: number, pitch: number, roll: number): Float64Array {
  const turn = (x: number, y: number, z: number) => rotationMatrix([x, y, z], 0);
  return multiplied(multiplied(turn(0, -yaw, 0), turn(pitch, 0, 0)), turn(0, 0, -roll));
}

function readJson(text: string): { rows: Row[]; fps: number } {
  let content: unknown;
  try {
    content = JSON.parse(text);
  } catch {
    throw new AvatarError("is no json");
  }
  const frames = (Array.isArray(content) ? content : [content]) as Record<string, any>[];
  const rows: Row[] = [], times: number[] = [];
  for (const [index, frame] of frames.entries()) {
    const entries: [string, unknown][] | undefined = frame?.faceBlendshapes
      ? frame.faceBlendshapes[0]?.categories?.map((entry: any) => [entry.categoryName, entry.score])
      : frame?.blendshapes && Object.entries(frame.blendshapes);
    const before = rows[rows.length - 1];
    if (!entries && !before) continue;
    times.push(Number(frame?.timestamp_ms ?? frame?.timestampMs ?? (1000 * index) / 30) / 1000);
    if (!entries) {
      rows.push(before);
      continue;
    }
    const scores = new Map(entries.map(([name, score]) => [String(name).toLowerCase(), Number(score)] as [string, number]));
    if ([...scores.values(), times[times.length - 1]].some((value) => !Number.isFinite(value))) throw new AvatarError(`has a value that is no number in frame ${index}`);
    const m: number[] | undefined = frame.facialTransformationMatrixes?.[0]?.data;
    // Column by column; a rotation times one scale.
    const size = m ? Math.hypot(m[0], m[1], m[2]) || 1 : 1;
    rows.push({ scores, head: m ? [m[0], m[4], m[8], m[1], m[5], m[9], m[2], m[6], m[10]].map((x) => x / size) : STILL });
  }
  if (!rows.length) throw new AvatarError("has no frame with blend shapes");
  return { rows, fps: rateOf(times) };
}

function rateOf(seconds: number[]): number {
  const steps = seconds.slice(1).map((time, i) => time - seconds[i]).sort((a, b) => a - b);
  if (steps.length && !(steps[0] > 0)) throw new AvatarError("has times that do not increase");
  return steps.length ? 1 / steps[steps.length >> 1] : 30;
}

/** Motion relative to the recording at rest, added to the avatar at rest. At rest, coefficients are 0 and the head has its median turn. */
function transferred(rows: Row[], fps: number, avatar: Avatar): Motion {
  const { neutral } = avatar, count = rows.length;
  const heads = rows.map((row) => axisAngle(row.head));
  const median = [0, 1, 2].map((axis) => heads.map((head) => head[axis]).sort((a, b) => a - b)[(count - 1) >> 1]);
  const back = transposed(rotationMatrix(median, 0));
  const motion: Motion = {
    expression: new Float32Array(count * neutral.expression.length), joints: new Float32Array(count * neutral.joints.length),
    head_rotation: new Float32Array(3 * count), head_translation: new Float32Array(3 * count), fps,
  };
  rows.forEach(({ scores, head }, t) => transfer(scores, multiplied(back, head), avatar, motionFace(motion, t)));
  return motion;
}
