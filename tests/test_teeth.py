"""The teeth that VHAP and GaussianAvatars add to FLAME (Qian et al. 2024, published code), by their numbers."""

import hashlib

import numpy as np
import pytest

from mien.errors import UserError
from mien.face.flame import FlameFile
from mien.face.teeth import tooth_triangles, with_teeth


def like_flame(vertices: int = 5023) -> FlameFile:
    """Return random arrays with FLAME's counts, whose lips are rings before the origin."""
    random = np.random.default_rng(1)
    return FlameFile(
        random.normal(size=(vertices, 3)), random.integers(0, vertices, (9976, 3)),
        random.normal(size=(4, vertices, 3)), random.normal(size=(3, vertices, 3)),
        random.normal(size=(36, vertices, 3)), random.random((5, vertices)), random.random((vertices, 5)),
        random.random((5118, 2)), random.integers(0, 5118, (9976, 3)),
    )  # fmt: skip


def test_triangles_are_the_published_ones_in_their_order() -> None:
    triangles = tooth_triangles()
    digest = hashlib.sha256(triangles.astype("<i4").tobytes()).hexdigest()
    assert digest == "8cb54eda8e4edef5ff44c548d78c3e68ebc07a8eec09807f749a7248a253e752"
    row, place = triangles // 15, triangles % 15
    mirrored = {tuple(sorted(corners)) for corners in (15 * row + 14 - place).tolist()}
    assert mirrored == {tuple(sorted(corners)) for corners in triangles.tolist()}


def test_two_open_troughs() -> None:
    triangles = tooth_triangles()
    for part in (triangles[:84], triangles[84:]):
        edges = [tuple(sorted(edge)) for a, b, c in part.tolist() for edge in ((a, b), (b, c), (c, a))]
        counts = np.unique(edges, axis=0, return_counts=True)[1]
        assert (len(np.unique(part)), len(counts), len(part)) == (60, 143, 84)
        assert ((counts == 2).sum(), (counts == 1).sum()) == (109, 34)


def test_flame_with_teeth() -> None:
    flame = like_flame()
    found = with_teeth(flame, "flame2023.pkl")
    assert found.template.shape == (5143, 3)
    assert found.faces.shape == (10144, 3)
    assert found.uv is not None
    assert len(found.uv) == 5238
    assert np.array_equal(found.template[:5023], flame.template)
    rows = found.template[5023:].reshape(8, 15, 3)
    gap = np.linalg.norm(rows[0] - rows[2], axis=1).mean() / 2
    assert np.allclose(rows[0] - rows[2], (0, 2 * gap, 0))
    assert np.allclose(rows[2] - rows[3], (0, 0.2 * gap, 0.4 * gap))
    assert np.allclose(rows[:4], rows[4:][[0, 2, 1, 3]] + (0, 0, gap))
    assert np.array_equal(found.weights[5023:].sum(0), [0, 60, 60, 0, 0])
    assert not found.expression[:, 5023:].any()
    ring = (flame.identity[:, 1713] + flame.identity[:, 1576]) / 2
    assert np.allclose(found.identity[:, 5023 + 15 * np.arange(8)], ring[:, None])


def test_other_models_have_no_place_for_them() -> None:
    with pytest.raises(UserError, match=r"m.npz: has 5,024 vertices and 9,976 triangles, and teeth belong to FLAME's"):
        with_teeth(like_flame(5024), "m.npz")
