// Motions that other programs record: the csv of Live Link Face, and blend shapes as json. It follows src/mien/driving:
// motion.py and transfer.py here, live_link_face.py in series_csv.ts, json_layouts.py and blendshape_json.py in series_json.ts.

import { motionFace, type Avatar, type Motion } from "./avatar";
import { AvatarError } from "./format";
import { multiplied, rotationMatrix, transposed } from "./rigid";
import { readCsv } from "./series_csv";
import { readJson } from "./series_json";
import { headAtRest, transfer } from "./transfer";

/** What a recording says about one timestep. */
export interface Row {
  /** Scores by the names of ARKit in lower case, with the performer's sides. Missing names are 0. */
  scores: Map<string, number>;
  /** Rotation of the head as an axis-angle vector. */
  head: readonly number[];
}

/** The rows of a recording, null for one without a face, and their times in seconds. */
export interface Series {
  rows: (Row | null)[];
  seconds: number[];
  /** How far a time may go back to count as a repeat, in seconds. */
  slack: number;
}

const MAX_GAP = 60, MAX_MOMENTS = 500_000;
/** Least number of rows a second of a recording of a face. */
const SLOWEST = 5;

/** The text of a file: UTF-16 if it begins with that mark, else UTF-8. */
export function textOf(content: ArrayBuffer): string {
  const [first, second] = new Uint8Array(content, 0, Math.min(2, content.byteLength));
  const kind = first === 0xff && second === 0xfe ? "utf-16le" : first === 0xfe && second === 0xff ? "utf-16be" : "utf-8";
  return new TextDecoder(kind).decode(content);
}

/**
 * The motion in a recording, for an avatar. Its errors complete the sentence "NAME ...".
 * @param notes Takes what was assumed or left out: texts that complete this sentence, too.
 */
export function readSeries(text: string, avatar: Avatar, notes: string[] = []): Motion {
  const series = /^\s*[[{]/.test(text) ? readJson(text, notes) : readCsv(text, notes);
  const found = series.rows.filter((row): row is Row => row !== null);
  const known = avatar.expression_names.some((name) => found.some((row) => row.scores.has(name.toLowerCase())));
  if (found.length && !known) throw new AvatarError("has none of this avatar's expressions");
  const { rows, fps } = evenly(held(series.rows), series, notes);
  return transferred(rows, fps, avatar);
}

/** The rows, where each without a face repeats the one before it; at the start, the first one with a face. */
function held(rows: (Row | null)[]): Row[] {
  let last = rows.find((row) => row) as Row;
  return rows.map((row) => (last = row ?? last));
}

/** The middle of some numbers; of an even count, the mean of both. */
export function median(numbers: readonly number[]): number {
  const sorted = [...numbers].sort((a, b) => a - b), half = sorted.length >> 1;
  return sorted.length % 2 ? sorted[half] : (sorted[half - 1] + sorted[half]) / 2;
}

/** Rows at evenly spaced times. A row that repeats a time is left out, and gaps are filled. */
function evenly(rows: Row[], { seconds, slack }: Series, notes: string[]): { rows: Row[]; fps: number } {
  let latest = -Infinity;
  const kept: number[] = [];
  seconds.forEach((time, index) => {
    if (time > latest) kept.push(index);
    else if (time < latest - slack) throw new AvatarError("has times that do not increase");
    latest = Math.max(latest, time);
  });
  if (kept.length < 2 && rows.length > 1) throw new AvatarError("has times that do not increase");
  if (kept.length < rows.length) notes.push(`repeats times, so ${rows.length - kept.length} of its ${rows.length} rows are left out`);
  const own = kept.map((index) => rows[index]), times = kept.map((index) => seconds[index]);
  if (own.length < 2) return { rows: own, fps: 30 };
  const steps = times.slice(1).map((time, i) => time - times[i]), step = median(steps), span = times[times.length - 1] - times[0];
  if (steps.some((one) => one > MAX_GAP)) throw new AvatarError(`has a gap of more than ${MAX_GAP} s`);
  if (Math.max(span / step, own.length) > MAX_MOMENTS) throw new AvatarError(`has more than ${MAX_MOMENTS} moments`);
  const count = Math.round(span / step) + 1;
  const isEven = count === own.length && times.every((time, i) => Math.abs(time - times[0] - step * i) < 0.5 * step), fps = isEven ? (count - 1) / span : 1 / step;
  if (fps < SLOWEST) notes.push(`has ${Number(fps.toPrecision(2))} rows a second, and recordings of faces have at least ${SLOWEST}`);
  if (isEven) return { rows: own, fps };
  let before = 0;
  const filled = Array.from({ length: count }, (_, i) => {
    const time = times[0] + step * i;
    while (before + 2 < times.length && times[before + 1] <= time) ++before;
    return between(own[before], own[before + 1], Math.min((time - times[before]) / (times[before + 1] - times[before]), 1));
  });
  return { rows: filled, fps };
}

function between(a: Row, b: Row, share: number): Row {
  const mix = (from = 0, to = 0) => from + share * (to - from);
  const names = new Set([...a.scores.keys(), ...b.scores.keys()]);
  return { scores: new Map([...names].map((name) => [name, mix(a.scores.get(name), b.scores.get(name))])), head: a.head.map((from, k) => mix(from, b.head[k])) };
}

/** Motion relative to the recording at rest, added to the avatar at rest. At rest, coefficients are 0 and the head has its median turn. */
function transferred(rows: Row[], fps: number, avatar: Avatar): Motion {
  const { neutral } = avatar, count = rows.length;
  const middle = [0, 1, 2].map((axis) => rows.map((row) => row.head[axis]).sort((a, b) => a - b)[(count - 1) >> 1]);
  const back = transposed(rotationMatrix(headAtRest(middle), 0));
  const motion: Motion = {
    expression: new Float32Array(count * neutral.expression.length), joints: new Float32Array(count * neutral.joints.length),
    head_rotation: new Float32Array(3 * count), head_translation: new Float32Array(3 * count), fps,
  };
  rows.forEach(({ scores, head }, t) => transfer(scores, multiplied(back, rotationMatrix(head, 0)), avatar, motionFace(motion, t)));
  return motion;
}
