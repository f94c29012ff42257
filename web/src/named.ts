// Names beside those of expressions, as src/mien/runtime/named.py has them: ARKit's names of gaze, which turn the eyes,
// and preset faces.

import type { Avatar, Face } from "./avatar";
import { axisAngle, multiplied, rotationMatrix } from "./rigid";

/** The table src/mien/runtime/presets.json, which build.mjs puts here. */
declare const PRESETS: Record<string, Record<string, number>>;
/** Preset faces: coefficients by ARKit's names, which are added to the face at rest. */
export const presets = PRESETS;

/** Angle of the eyes at a coefficient eyeLook of 1, in radians. */
const LOOK_ANGLE = Math.PI / 6;
/** Pitch that eyes come near but do not exceed, up and down, in radians: beyond it, the lids would cover the iris. */
const MOST_UP = (14 * Math.PI) / 180, MOST_DOWN = (18 * Math.PI) / 180;
/** ARKit's eight names of gaze, without side. */
export const WAYS = ["Up", "Down", "In", "Out"];

/** The eye that a name of gaze turns: "left", "right", or nothing. */
const eyeOf = ({ joint_names }: Avatar, name: string): string | undefined => {
  const side = /^eyeLook(?:Up|Down|In|Out)(Left|Right)$/.exec(name)?.[1].toLowerCase();
  return joint_names.includes(`${side}_eye`) ? side : undefined;
};

/** Turns the eyes of one side from where they look at rest. `look` gives the coefficient of a name of gaze, in lower case. */
export function turnEye(avatar: Avatar, face: Face, side: string, look: (name: string) => number): void {
  const j = 3 * avatar.joint_names.indexOf(`${side}_eye`), way = (name: string) => LOOK_ANGLE * look(`eyelook${name}${side}`);
  if (j < 0) return;
  const [left, right] = side === "left" ? ["out", "in"] : ["in", "out"];
  const pitch = way("down") - way("up"), most = pitch < 0 ? MOST_UP : MOST_DOWN;
  const gaze = rotationMatrix([most * Math.tanh(pitch / most), way(left) - way(right), 0], 0);
  face.joints.set(axisAngle(multiplied(rotationMatrix(avatar.neutral.joints, j), gaze)), j);
}

/** Lowest and highest value of a name, or nothing if it does nothing. */
export function rangeOf(avatar: Avatar, name: string): [number, number] | undefined {
  const index = avatar.expression_names.indexOf(name), [least, most] = avatar.expression_bounds.subarray(2 * index, 2 * index + 2);
  if (index >= 0 && least < most) return [least, most];
  const preset = Object.hasOwn(presets, name) && presets[name];
  return eyeOf(avatar, name) || (preset && Object.keys(preset).every((part) => rangeOf(avatar, part))) ? [0, 1] : undefined;
}

/** How far a preset goes beyond what was filmed, at its coefficient that goes furthest; 0 if nobody knows what was. */
export function beyondFilmed(avatar: Avatar, name: string): number {
  const { filmed, neutral, expression_names } = avatar;
  const over = Object.entries(presets[name]).map(([part, value]) => {
    const index = expression_names.indexOf(part);
    return filmed && index >= 0 ? Math.min(neutral.expression[index] + value, highestOf(avatar, part, index)) - filmed.highest[index] : 0;
  });
  return Math.max(0, ...over);
}

/** Coefficient of a blink from which a clip shows the lids shut. A mesh that closes them further tears them. */
const SHUT = 0.5;

/** The highest value of an expression in presets and blinks: that of a blink is where the person's own lids are shut, if the clip shows it. */
export function highestOf({ filmed, expression_bounds }: Avatar, name: string, index: number): number {
  const seen = filmed && name.startsWith("eyeBlink") ? filmed.highest[index] : 0, most = expression_bounds[2 * index + 1];
  return seen >= SHUT ? Math.min(seen, most) : most;
}

/**
 * Sets an expression, a gaze or a whole face by name, within its range.
 * @param look Coefficients of the gaze so far, by name in lower case; those of `name` are put into it.
 * @returns False if the name does nothing.
 */
export function setNamed(avatar: Avatar, face: Face, look: Map<string, number>, name: string, value: number): boolean {
  const range = rangeOf(avatar, name), side = eyeOf(avatar, name), index = avatar.expression_names.indexOf(name);
  if (!range) return false;
  value = Math.min(Math.max(value, range[0]), range[1]);
  if (side) {
    look.set(name.toLowerCase(), value);
    turnEye(avatar, face, side, (of) => look.get(of) ?? 0);
  } else if (index >= 0) face.expression[index] = value;
  else
    for (const [part, most] of Object.entries(presets[name])) {
      const index = avatar.expression_names.indexOf(part), rest = avatar.neutral.expression[index];
      setNamed(avatar, face, look, part, eyeOf(avatar, part) ? value * most : Math.min(rest + value * most, highestOf(avatar, part, index)));
    }
  return true;
}
