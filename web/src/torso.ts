// A torso that stands still in the world while the head moves (mien/runtime/torso.py).
import type { Avatar, Face } from "./avatar";
import { axisAngle, moved, multiplied, rigid, rotationMatrix, transposed } from "./rigid";

/** How far a neck lets the head go from the torso's place, in metres: freely, and how much further it can ever get. */
const FREE = 0.02, ROOM = 0.03;
const NECK_SHARE = 0.5;

/** Puts a face on the torso of the person at rest, in place. The avatar may have none. */
export function standStill(face: Face, { baked, neutral, expression_names: names, joint_names: joints }: Avatar): void {
  const rig = "rig" in baked ? baked.rig : null, torso = 3 * joints.indexOf("torso"), neck = 3 * joints.indexOf("neck");
  const first = names.indexOf("torsoX"), joint = 3 * (rig?.joint_names.indexOf("torso") ?? -1);
  if (!rig || torso < 0 || neck < 0 || first < 0 || joint < 0) return;
  const origin = [0, 1, 2].map((k) => rig.joint_template[joint + k]), shift = [0, 1, 2].map((k) => neutral.expression[first + k]);
  const upright = rotationMatrix(neutral.head_rotation, 0), back = transposed(rotationMatrix(face.head_rotation, 0));
  const place = moved(rigid(upright, neutral.head_translation), origin.map((x, k) => x + shift[k]));
  const turn = axisAngle(multiplied(back, multiplied(upright, rotationMatrix(neutral.joints, torso))));
  const inHead = moved(rigid(back, [0, 0, 0]), place.map((x, k) => x - face.head_translation[k]));
  const away = inHead.map((x, k) => x - origin[k]), length = Math.hypot(...away), over = length - FREE;
  const kept = over > 0 ? (FREE + (ROOM * over) / (ROOM + over)) / length : 1;
  face.joints.set(turn, torso);
  face.joints.set(turn.map((angle) => NECK_SHARE * angle), neck);
  face.expression.set(away.map((x) => kept * x), first);
}
