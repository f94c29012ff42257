// From a driver's face to an avatar's, as src/mien/driving/transfer.py does it: what moves relative to the driver at rest
// is added to the avatar at rest, within the limits that the avatar has.

import type { Avatar, Face } from "./avatar";
import { turnEye } from "./named";
import { axisAngle, multiplied, rotationMatrix } from "./rigid";

/** Limits of a turn of the head at rest, in radians: up to the first it is at rest, from the second on it is motion (src/mien/driving/rest.py). */
const HEAD = [0.524, 0.785];

/** The part of a size that belongs to a person at rest: 1 up to the first limit, 0 from the second on. */
export function keptShare(size: number, [first, second]: readonly number[]): number {
  return Math.min(Math.max((second - size) / (second - first), 0), 1);
}

/** The axis-angle vector of a head at rest: as it mostly is, unless it is far from facing the camera. */
export function headAtRest(usual: readonly number[]): number[] {
  const share = keptShare(Math.hypot(...usual), HEAD);
  return usual.map((angle) => share * angle);
}

/**
 * Fills `face` with a driver's face.
 * @param scores Coefficients by the names of ARKit in lower case; missing names are 0, as the driver at rest.
 * @param turn Rotation of the head relative to the driver at rest, row-major.
 * @param shift Motion of the head relative to the driver at rest, in the axes of the head at rest, in metres.
 */
export function transfer(scores: ReadonlyMap<string, number>, turn: ArrayLike<number>, avatar: Avatar, face: Face, shift: readonly number[] = [0, 0, 0]): void {
  const { neutral, expression_names: names, expression_bounds: bounds } = avatar;
  const score = (name: string) => scores.get(name) ?? 0;
  names.forEach((name, e) => {
    face.expression[e] = Math.min(Math.max(neutral.expression[e] + score(name.toLowerCase()), bounds[2 * e]), bounds[2 * e + 1]);
  });
  face.joints.set(neutral.joints);
  for (const side of ["left", "right"]) turnEye(avatar, face, side, score);
  const rest = rotationMatrix(neutral.head_rotation, 0);
  face.head_rotation.set(axisAngle(multiplied(rest, turn)));
  face.head_translation.set(neutral.head_translation.map((at, k) => at + rest[3 * k] * shift[0] + rest[3 * k + 1] * shift[1] + rest[3 * k + 2] * shift[2]));
}
