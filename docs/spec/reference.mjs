// A reference of EXT_gaussian_avatar in plain JavaScript: reads a .glb, and poses its Gaussians. The numbers (1) to (20) are
// those of the formulas in README.md. Apache-2.0.

const EXTENSIONS = ["EXT_gaussian_avatar", "MIEN_gaussian_avatar"];

/** The avatar of a .glb: the tree of the extension with arrays in place of their names. */
export function readAvatar(glb) {
  const view = new DataView(glb), length = view.getUint32(12, true);
  if (view.getUint32(0, true) !== 0x46546c67) throw new Error("this is no .glb");
  const json = JSON.parse(new TextDecoder().decode(new Uint8Array(glb, 20, length))), start = 28 + length;
  const extension = EXTENSIONS.map((name) => json.extensions?.[name]).find(Boolean);
  if (extension?.version !== 1) throw new Error(`the file has no ${EXTENSIONS[0]} of version 1`);
  const tensor = (name) => {
    const { dtype, shape, bufferView } = extension.tensors[name], count = shape.reduce((product, side) => product * side, 1);
    const from = count ? start + (json.bufferViews[bufferView].byteOffset ?? 0) : 0, bytes = glb.slice(from, from + 4 * count);
    return dtype === "int32" ? new Int32Array(bytes) : new Float32Array(bytes);
  };
  const restore = (node) => {
    if (Array.isArray(node)) return node.map(restore);
    if (node === null || typeof node !== "object") return node;
    return typeof node.tensor === "string" ? tensor(node.tensor) : Object.fromEntries(Object.entries(node).map(([key, item]) => [key, restore(item)]));
  };
  return restore(extension.avatar.content);
}

const range = (count) => Array.from({ length: count }, (_, i) => i);
const dot = (a, b) => a.reduce((sum, x, i) => sum + x * b[i], 0);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const minus = (a, b) => a.map((x, i) => x - b[i]);
const norm = (a) => Math.sqrt(dot(a, a));
const row3 = (array, i) => Array.from(array.slice(3 * i, 3 * i + 3));
const times = (A, B) => A.map((row) => range(B[0].length).map((j) => dot(row, B.map((other) => other[j]))));
const transposed = (A) => A[0].map((_, j) => A.map((row) => row[j]));

/** (1) The matrix of an axis-angle vector. */
function rotation([x, y, z]) {
  const angle = Math.hypot(x, y, z), s = angle < 1e-4 ? 1 : Math.sin(angle) / angle, c = angle < 1e-4 ? 0.5 : (1 - Math.cos(angle)) / angle ** 2;
  const K = [[0, -z, y], [z, 0, -x], [-y, x, 0]], KK = times(K, K);
  return range(3).map((i) => range(3).map((j) => (i === j ? 1 : 0) + s * K[i][j] + c * KK[i][j]));
}

/** Points of the mesh: (2) shaped, (3) corrected, (4) joints chained, (5) skinned. */
function posePoints(rig, face) {
  const m = rig.template.length / 3, joints = rig.joint_names.length, shaped = Float64Array.from(rig.template);
  face.expression.forEach((weight, e) => {
    if (weight) for (let i = 0; i < 3 * m; ++i) shaped[i] += weight * rig.expression_basis[3 * m * e + i];
  });
  if (rig.pose_basis)
    for (let j = 0; 3 * j < face.joints.length; ++j)
      rotation(row3(face.joints, j)).flat().forEach((value, c) => {
        const weight = value - (c % 4 ? 0 : 1);
        if (weight) for (let i = 0; i < 3 * m; ++i) shaped[i] += weight * rig.pose_basis[3 * m * (9 * j + c) + i];
      });
  const transforms = [];
  for (let j = 0, free = 0; j < joints; ++j) {
    const along = (basis) => range(3).map((axis) => face.expression.reduce((sum, weight, e) => sum + weight * basis[3 * (e * joints + j) + axis], 0));
    const R = rotation(rig.joint_free[j] ? row3(face.joints, free++) : along(rig.joint_rotation_basis));
    const at = row3(rig.joint_template, j), shift = along(rig.joint_translation_basis), t = range(3).map((i) => at[i] + shift[i] - dot(R[i], at));
    const local = [...R.map((row, i) => [...row, t[i]]), [0, 0, 0, 1]], parent = rig.joint_parents[j];
    transforms.push(parent < 0 ? local : times(transforms[parent], local));
  }
  return range(m).map((v) => {
    const point = [shaped[3 * v], shaped[3 * v + 1], shaped[3 * v + 2], 1], out = [0, 0, 0];
    transforms.forEach((T, j) => {
      const weight = rig.skinning_weights[v * joints + j];
      if (weight) for (let i = 0; i < 3; ++i) out[i] += weight * dot(T[i], point);
    });
    return out;
  });
}

/** The frame of a triangle: (6) its axes, (7) its size, (8) its middle. */
function frame([a, b, c]) {
  let first = minus(b, a), second = minus(c, a);
  if (norm(first) < 1e-7 || norm(cross(first, second)) < 1e-7 * norm(first)) [first, second] = [[1e-7, 0, 0], [0, 1e-7, 0]];
  const edge = norm(first), x = first.map((v) => v / edge), area = cross(x, second), height = norm(area), y = area.map((v) => v / height), z = cross(x, y);
  return { R: transposed([x, y, z]), k: (edge + height) / 2, T: range(3).map((i) => (a[i] + b[i] + c[i]) / 3) };
}

/** (9) Activations along directions, (10) shortened where they go beyond what was seen. */
function activate(inputs, rest, directions, seen, regions) {
  const rank = directions.length / inputs.length, block = rank / regions, out = range(rank).map((k) => inputs.reduce((sum, x, i) => sum + (x - rest[i]) * directions[i * rank + k], 0));
  for (let begin = 0; seen.length && begin < rank; begin += block) {
    const own = out.slice(begin, begin + block), along = range(seen.length / rank).map((row) => dot(own, seen.subarray(row * rank + begin)));
    const furthest = Math.max(1e-6, ...along), ratio = dot(own, own) / furthest, over = ratio - 1;
    if (over > 0) own.forEach((x, k) => (out[begin + k] = (x * (1 + (0.1 * over) / (0.1 + over))) / ratio));
  }
  return out;
}

/** (11) How the head moved from its pose at rest: sines of its turns about its own axes, and its shift. */
function headMotion(rest, face) {
  const back = transposed(rotation(row3(rest, 0))), R = times(back, rotation(Array.from(face.head_rotation))), shift = minus(Array.from(face.head_translation), row3(rest, 1));
  return [(R[2][1] - R[1][2]) / 2, (R[0][2] - R[2][0]) / 2, (R[1][0] - R[0][1]) / 2, ...back.map((row) => dot(row, shift))];
}

/** (12) The activations of each triangle: regions and the head in turn, blended by the triangle's shares. */
function activationsOf({ rest, directions, seen, shares, head }, face, triangles) {
  const regions = shares ? shares.length / triangles : 1, inputs = [...face.expression, ...face.joints], own = activate(inputs, rest, directions, seen, regions), each = own.length / regions;
  const turns = head ? activate(headMotion(head.rest, face), new Float32Array(6), head.directions, head.seen, 1) : [];
  const table = range(regions).map((g) => range(Math.max(each, turns.length)).flatMap((k) => [...(k < each ? [own[g * each + k]] : []), ...(k < turns.length ? [turns[k]] : [])]));
  return (f) => table[0].map((_, k) => range(regions).reduce((sum, g) => sum + (shares ? shares[f * regions + g] : 1) * table[g][k], 0));
}

/** (14) Features blended, (15) the hidden layer, (16) what it adds to the colour and the raw opacity. */
function network({ neutral, basis, own, weights, biases }, i, n, a) {
  const width = neutral.length / n, more = own.length / n, blended = range(width).map((f) => a.reduce((sum, x, k) => sum + x * basis[(i * a.length + k) * width + f], neutral[i * width + f]));
  const inputs = [...blended, ...own.subarray(i * more, (i + 1) * more)], hidden = range(biases[0].length).map((h) => biases[0][h] + dot(inputs, weights[0].subarray(h * inputs.length)));
  return range(4).map((o) => biases[1][o] + hidden.reduce((sum, x, h) => sum + weights[1][o * hidden.length + h] * (x < 0 ? 0.01 * x : x), 0));
}

/** The Gaussians of a face, in the frame of the head: centres, covariances (row by row), colours and opacities. */
export function pose(avatar, face) {
  const { rig, faces, face_index, means, attributes, changes } = avatar.baked, n = face_index.length, width = attributes.sh.length / n;
  const points = posePoints(rig, face), frames = range(faces.length / 3).map((f) => frame(row3(faces, f).map((v) => points[v])));
  const activations = changes && activationsOf(changes, face, frames.length);
  return range(n).map((i) => {
    const { R, k, T } = frames[face_index[i]], a = activations?.(face_index[i]) ?? [], q = Array.from(attributes.quats.subarray(4 * i, 4 * i + 4)), size = norm(q);
    const mean = row3(means, i), color = Array.from(attributes.sh.subarray(i * width, i * width + 3));
    let logit = attributes.opacity_logits[i];
    // (13) Changes along bases.
    const change = (part, row) => (part ? range(part.length / (part === changes.opacity_logits ? n : 3 * n)).reduce((sum, c, _, all) => sum + part[row * all.length + c] * a[c], 0) : 0);
    if (changes) {
      for (let axis = 0; axis < 3; ++axis) {
        mean[axis] += change(changes.means, 3 * i + axis);
        color[axis] += change(changes.color, 3 * i + axis);
      }
      logit += change(changes.opacity_logits, i);
      const added = changes.features ? network(changes.features, i, n, a) : [0, 0, 0, 0];
      added.forEach((x, o) => (o < 3 ? (color[o] += x) : (logit += x)));
    }
    const [w, x, y, z] = q.map((v) => v / size), turn = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]];
    const M = times(R, turn).map((row) => row.map((v, c) => k * v * Math.exp(attributes.log_scales[3 * i + c])));
    return {
      centre: R.map((row, axis) => k * dot(row, mean) + T[axis]), // (17)
      covariance: times(M, transposed(M)), // (18)
      color: color.map((c) => Math.max(0, 0.5 + 0.28209479177387814 * c)), // (19)
      opacity: 1 / (1 + Math.exp(-logit)), // (20)
    };
  });
}
