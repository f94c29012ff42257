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
