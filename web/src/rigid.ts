// Rotations and rigid transforms. A transform is twelve numbers: the rows of [R | t].

/** The row-major matrix of the axis-angle vector at `at`, in radians (Rodrigues' formula). */
export function rotationMatrix(vectors: ArrayLike<number>, at: number): Float64Array {
  const x = vectors[at], y = vectors[at + 1], z = vectors[at + 2], squared = x * x + y * y + z * z;
  const small = squared < 1e-8, angle = Math.sqrt(squared);
  const s = small ? 1 - squared / 6 : Math.sin(angle) / angle;
  const c = small ? 0.5 - squared / 24 : (1 - Math.cos(angle)) / squared;
  return Float64Array.of(
    1 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y,
    c * x * y + s * z, 1 - c * (x * x + z * z), c * y * z - s * x,
    c * x * z - s * y, c * y * z + s * x, 1 - c * (x * x + y * y),
  );
}

export function rigid(R: ArrayLike<number>, t: ArrayLike<number>): Float64Array {
  return Float64Array.of(R[0], R[1], R[2], t[0], R[3], R[4], R[5], t[1], R[6], R[7], R[8], t[2]);
}

/** The transform that applies `second`, then `first`. */
export function chained(first: ArrayLike<number>, second: ArrayLike<number>): Float64Array {
  const out = new Float64Array(12);
  for (let row = 0; row < 12; row += 4)
    for (let column = 0; column < 4; ++column)
      out[row + column] =
        first[row] * second[column] + first[row + 1] * second[4 + column] + first[row + 2] * second[8 + column] + (column === 3 ? first[row + 3] : 0);
  return out;
}

/** A transform of a point. */
export function moved(T: ArrayLike<number>, p: ArrayLike<number>): [number, number, number] {
  const row = (r: number) => T[r] * p[0] + T[r + 1] * p[1] + T[r + 2] * p[2] + T[r + 3];
  return [row(0), row(4), row(8)];
}

/** The product of two row-major 3x3 matrices. */
export function multiplied(a: ArrayLike<number>, b: ArrayLike<number>): Float64Array {
  return Float64Array.from({ length: 9 }, (_, i) => {
    const row = 3 * Math.floor(i / 3), column = i % 3;
    return a[row] * b[column] + a[row + 1] * b[column + 3] + a[row + 2] * b[column + 6];
  });
}

export const transposed = (m: ArrayLike<number>): Float64Array => Float64Array.of(m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]);

/** The axis-angle vector of a row-major rotation matrix, by the largest component of its quaternion. */
export function axisAngle(m: ArrayLike<number>): [number, number, number] {
  const rows = [
    [1 + m[0] + m[4] + m[8], m[7] - m[5], m[2] - m[6], m[3] - m[1]],
    [m[7] - m[5], 1 + m[0] - m[4] - m[8], m[1] + m[3], m[2] + m[6]],
    [m[2] - m[6], m[1] + m[3], 1 - m[0] + m[4] - m[8], m[5] + m[7]],
    [m[3] - m[1], m[2] + m[6], m[5] + m[7], 1 - m[0] - m[4] + m[8]],
  ];
  const q = rows.reduce((best, row, k) => (row[k] > best[0][best[1]] ? ([row, k] as const) : best), [rows[0], 0] as readonly [number[], number])[0];
  const sign = q[0] >= 0 ? 1 : -1, length = Math.hypot(q[1], q[2], q[3]), whole = Math.hypot(q[0], length);
  const scale = length > 1e-9 * whole ? (2 * Math.atan2(length, sign * q[0]) * sign) / length : (2 * sign) / whole;
  return [scale * q[1], scale * q[2], scale * q[3]];
}
