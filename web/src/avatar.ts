// What a .mien file holds, as src/mien/runtime/baked.py documents it. Letters in shapes mean what they mean there.

/** m points of one person that move with expressions and joints. Arrays are row by row. */
export interface Rig {
  template: Float32Array; // [m, 3], metres, head frame
  expression_names: string[];
  expression_basis: Float32Array; // [e, m, 3]
  joint_names: string[];
  joint_parents: number[];
  joint_free: boolean[];
  joint_template: Float32Array; // [k, 3]
  joint_rotation_basis: Float32Array; // [e, k, 3]
  joint_translation_basis: Float32Array; // [e, k, 3]
  skinning_weights: Float32Array; // [m, k]
  pose_basis: Float32Array | null; // [9 j, m, 3]
}

/** Raw values of n Gaussians, independent of how they are bound. */
export interface Attributes {
  quats: Float32Array; // [n, 4], wxyz, not of unit length
  log_scales: Float32Array; // [n, 3]
  opacity_logits: Float32Array; // [n]
  sh: Float32Array; // [n, s, 3]
}

/** Features of w numbers that the activations blend, and a network of two layers that makes changes of them. */
export interface FeatureChanges {
  neutral: Float32Array; // [n, w]
  basis: Float32Array; // [n, a, w]
  own: Float32Array; // [n, _], further inputs of the network
  weights: Float32Array[]; // of both layers, [out, in]
  biases: Float32Array[];
}

/** q activations of the head's pose. */
export interface HeadActivations {
  rest: Float32Array; // [6], axis-angle vector and place of the head at rest
  directions: Float32Array; // [6, q]
  seen: Float32Array; // [s, q]
}

/** Changes of the raw values with the expression, of low rank. */
export interface ExpressionChanges {
  rest: Float32Array; // [i]
  directions: Float32Array; // [i, r]: r / g activations of each of g regions of the face
  seen: Float32Array; // [s, r], activations that training saw
  shares: Float32Array | null; // [f, g], of each region in each triangle. Null if the face is one region
  head: HeadActivations | null;
  color: Float32Array | null; // [n, 3, c], where the first c of a Gaussian's a activations count
  opacity_logits: Float32Array | null; // [n, c]
  means: Float32Array | null; // [n, 3, c]
  features: FeatureChanges | null;
}

/** Changes of the raw values per unit of each expression coefficient. Null means no change. */
export interface LinearBases {
  means: Float32Array | null; // [e, n, 3]
  log_scales: Float32Array | null; // [e, n, 3]
  opacity_logits: Float32Array | null; // [e, n]
  sh: Float32Array | null; // [e, n, s, 3]
}

/** Directions of the face, along which features change. */
export interface FeatureDirections {
  rest: Float32Array; // [i]
  directions: Float32Array; // [i, k]
  basis: Float32Array; // [n, k, w]
}

/** A small network, the same for all Gaussians: rows of `base` with an addition are its inputs. */
export interface AttributeNetwork {
  input: "features" | "displacement";
  base: Float32Array; // [n, _]
  weights: Float32Array[]; // of each layer: [out, in]
  biases: Float32Array[];
  activation: "relu" | "leaky_relu" | "softplus";
  outputs: string[];
  along: FeatureDirections | null;
}

/** Gaussians in the frames of a mesh's triangles. A single triangle is no mesh: it never moves. */
export interface MeshBound {
  kind: "MeshBound";
  rig: Rig;
  faces: Int32Array; // [f, 3]
  face_index: Int32Array; // [n]
  means: Float32Array; // [n, 3], in the triangle's frame and units
  attributes: Attributes;
  sh_frame: "world" | "head";
  changes: ExpressionChanges | null;
}

/** Gaussians that have their own blend directions and skinning weights. */
export interface BlendSkinned {
  kind: "BlendSkinned";
  rig: Rig; // of the centres
  attributes: Attributes;
  scale_activation: "exp" | "sigmoid";
  scale_gain: number;
  scale_offset: number; // metres
  color_activation: "sh" | "sigmoid";
  bases: LinearBases | null;
  network: AttributeNetwork | null;
  still_weights: Float32Array | null; // [n]
  still_pose: Float32Array | null; // [4, 4]
}

/** Gaussians that do not move in the head frame. */
export interface Static {
  kind: "Static";
  means: Float32Array; // [n, 3]
  attributes: Attributes;
  expression_names: string[];
  joint_names: string[];
  bases: LinearBases | null;
  network: AttributeNetwork | null;
}

/** The closed family of records. Whoever reads them asks for `kind`. */
export type Baked = MeshBound | BlendSkinned | Static;

/** A pinhole camera, OpenCV convention: +x right, +y down, +z forward. */
export interface Camera {
  K: Float32Array; // [3, 3], pixels
  viewmat: Float32Array; // [4, 4], world to camera
  width: number;
  height: number;
}

/** Face parameters of one timestep. */
export interface Face {
  expression: Float32Array; // [e]
  joints: Float32Array; // [j, 3], axis-angle, radians
  head_rotation: Float32Array; // [3], axis-angle, radians
  head_translation: Float32Array; // [3], metres
}

/** Timesteps of a packed motion: every array of `Face` with a leading axis. */
export interface Motion extends Face {
  fps: number;
}

/** What training saw: the smallest and largest value of each expression, then of each joint's angles in radians. */
export interface Filmed {
  lowest: Float32Array; // [e + 3 j]
  highest: Float32Array;
}

export interface Avatar {
  baked: Baked;
  expression_names: string[];
  expression_bounds: Float32Array; // [e, 2]
  joint_names: string[];
  neutral: Face;
  camera: Camera;
  about: { name: string; method: string; face_model: string; licence: string };
  filmed?: Filmed | null;
}

/** A copy of a face, so that changing it leaves the original alone. */
export function copyFace(face: Face): Face {
  return {
    expression: face.expression.slice(),
    joints: face.joints.slice(),
    head_rotation: face.head_rotation.slice(),
    head_translation: face.head_translation.slice(),
  };
}

/** Number of timesteps of a motion. */
export const motionLength = (motion: Motion): number => motion.head_rotation.length / 3;

/** One timestep of a motion. Its arrays are views. */
export function motionFace(motion: Motion, timestep: number): Face {
  const count = motionLength(motion);
  const row = (values: Float32Array) => {
    const width = values.length / count;
    return values.subarray(timestep * width, (timestep + 1) * width);
  };
  return {
    expression: row(motion.expression),
    joints: row(motion.joints),
    head_rotation: row(motion.head_rotation),
    head_translation: row(motion.head_translation),
  };
}
