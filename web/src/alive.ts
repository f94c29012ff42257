// Signs of life: blinks, a head that is never quite still, and eyes that follow the pointer.

import type { Avatar, Face } from "./avatar";
import { highestOf } from "./named";
import { axisAngle, multiplied, rotationMatrix } from "./rigid";

/** Mean time between blinks, and the times to close and to open, in seconds. */
const BETWEEN = 3.5, CLOSING = 0.08, OPENING = 0.17;
/** Largest turn of the eyes towards the pointer: sideways, up and down, in radians. */
const MOST_GAZE = [0.45, 0.3];
/** Share of this turn by which the head follows the eyes. */
const HEAD_SHARE = 0.2;

/** A number from 0 to 1 that an integer decides. */
function random(seed: number): number {
  const x = Math.sin(12.9898 * seed + 78.233) * 43758.5453;
  return x - Math.floor(x);
}

/** How closed the lids are at a time, 0 to 1. There is one blink in each stretch of time. */
export function blinkAt(seconds: number): number {
  const stretch = Math.floor(seconds / BETWEEN), start = BETWEEN * (stretch + 0.7 * random(stretch));
  const since = seconds - start;
  if (since < 0 || since > CLOSING + OPENING) return 0;
  return since < CLOSING ? since / CLOSING : 1 - (since - CLOSING) / OPENING;
}

/** The turn of a head that is never quite still, axis-angle in radians: sums of slow waves. */
export function swayAt(seconds: number): [number, number, number] {
  const wave = (k: number) => Math.sin(seconds * 0.61 * (1 + 0.37 * k) + 2.1 * k) + 0.6 * Math.sin(seconds * 1.13 * (1 + 0.21 * k) + 4.3 * k);
  return [0.012 * wave(0), 0.02 * wave(1), 0.008 * wave(2)];
}

export interface Life {
  /** Whether it blinks and moves. */
  idle: boolean;
  /** Where the eyes look: to the right and up in the picture, -1 to 1. Null leaves them. */
  pointer: [number, number] | null;
}

/** Adds signs of life to a face: blinks, a head that is never quite still, and eyes that look aside. */
export function enliven(face: Face, avatar: Avatar, life: Life, seconds: number): void {
  const { expression_names: names, joint_names: joints } = avatar;
  /** Turns an axis-angle vector further. */
  const turn = (vectors: Float32Array, at: number, by: number[]) =>
    vectors.set(axisAngle(multiplied(rotationMatrix(vectors, at), rotationMatrix(by, 0))), at);
  const [right, up] = life.pointer ?? [0, 0];
  if (life.idle) {
    const blink = blinkAt(seconds);
    for (const name of ["eyeBlinkLeft", "eyeBlinkRight"]) {
      const e = names.indexOf(name), open = face.expression[e];
      if (e >= 0) face.expression[e] = open + Math.max(Math.min(1, highestOf(avatar, name, e)) - open, 0) * blink;
    }
    turn(face.head_rotation, 0, swayAt(seconds).map((angle, k) => angle + HEAD_SHARE * [-MOST_GAZE[1] * up, MOST_GAZE[0] * right, 0][k]));
  }
  for (const name of ["left_eye", "right_eye"]) {
    const j = 3 * joints.indexOf(name);
    if (j >= 0 && life.pointer) turn(face.joints, j, [-MOST_GAZE[1] * up, MOST_GAZE[0] * right, 0]);
  }
}
