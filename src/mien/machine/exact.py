"""Arithmetic that gives the same bits on every processor: sums of products in a fixed order, in numpy.

Matrix products of a library (BLAS), its decompositions, and sums that use the width of the processor's vectors add in
an order that differs between machines. Here each product is rounded by itself and added in the order of its index.
Sums, products, quotients and square roots of two numbers are the same everywhere (IEEE 754). So are numpy's `sum`,
`mean` and `cumsum`, because their order comes from one source for all processors. Functions such as `exp` and `sin` may
differ in their last bit: code that needs equal results computes them in float64 and then rounds to float32.

Results have the dtype that numpy gives to products of the arguments.
"""

import numpy as np
from jaxtyping import Float, Int


def dot(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Dot products over the last axis, of any length; the other axes broadcast."""
    total = first[..., 0] * second[..., 0]
    for index in range(1, first.shape[-1]):
        total = total + first[..., index] * second[..., index]
    return np.asarray(total)


def length(vectors: Float[np.ndarray, "*b c"]) -> np.ndarray:
    """Euclidean norms over the last axis."""
    return np.asarray(np.sqrt(dot(vectors, vectors)))


def product(first: Float[np.ndarray, "*#b n k"], second: Float[np.ndarray, "*#b k m"]) -> np.ndarray:
    """`first @ second`, for a small inner dimension k: one pass over the result for each of the k terms."""
    total = first[..., :, 0, None] * second[..., None, 0, :]
    for index in range(1, first.shape[-1]):
        total = total + first[..., :, index, None] * second[..., None, index, :]
    return total


def rotated(
    points: Float[np.ndarray, "*b 3"], rotation: Float[np.ndarray, "3 3"], shift: np.ndarray | None = None
) -> np.ndarray:
    """Points rotated and then shifted: `rotation @ p + shift` for each row p."""
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    rows = [x * row[0] + y * row[1] + z * row[2] for row in rotation]
    if shift is not None:
        rows = [row + offset for row, offset in zip(rows, shift, strict=True)]
    return np.stack(rows, axis=-1)


def mixed(weights: Float[np.ndarray, "*b k"], values: Float[np.ndarray, "*b k c"]) -> np.ndarray:
    """Weighted sums of `values` over their last axis but one, for example points from barycentric coordinates."""
    total = weights[..., 0, None] * values[..., 0, :]
    for index in range(1, weights.shape[-1]):
        total = total + weights[..., index, None] * values[..., index, :]
    return total


def combined(coefficients: Float[np.ndarray, " k"], fields: Float[np.ndarray, "k ..."]) -> np.ndarray:
    """Sum of coefficient times field, in float64. Fields with a coefficient of zero are not read."""
    total = np.zeros(fields.shape[1:])
    for index in np.flatnonzero(coefficients):
        total += np.float64(coefficients[index]) * fields[index]
    return total


def vertex_normals(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "v 3"]:
    """Unit normals like those of `mien.render.mesh.vertex_normals`, float32, summed triangle by triangle in float64."""
    a, b, c = (vertices[faces[:, corner]].astype(np.float64) for corner in range(3))
    areas = np.cross(b - a, c - a)
    corners = faces.T.reshape(-1)
    summed = np.stack(
        [np.bincount(corners, np.tile(areas[:, axis], 3), len(vertices)) for axis in range(3)], axis=-1
    )  # fmt: skip
    return (summed / np.maximum(length(summed), 1e-20)[:, None]).astype(np.float32)


class Parabola:
    """The least-squares parabola through points, built from polynomials that are orthogonal on these points."""

    def __init__(self, x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]) -> None:
        x, y = x.astype(np.float64), y.astype(np.float64)
        self._center = x.mean()
        linear = x - self._center
        square = linear * linear
        self._mean, self._slope = square.mean(), (square * linear).sum() / (linear * linear).sum()
        square = square - self._mean - self._slope * linear
        self._factors = y.mean(), (y * linear).sum() / (linear * linear).sum(), (y * square).sum() / (square**2).sum()

    def __call__(self, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """The parabola's values at `x`, in float64."""
        linear = x - self._center
        square = linear * linear - self._mean - self._slope * linear
        constant, first, second = self._factors
        return constant + first * linear + second * square
