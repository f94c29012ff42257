"""Avatars in scenes of three.js, Spark, PlayCanvas and Babylon.js, and the arrays of Gaussians that they get."""

import gzip
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import web_case as web
from mien import runtime
from mien.rotation import matrix_from_axis_angle, matrix_from_quaternion
from test_web import points
from web_case import WEB, drawn_head, faces_of, package

ENGINES = {"three": "three", "spark": "@sparkjsdev/spark", "playcanvas": "playcanvas", "babylon": "@babylonjs/core"}
TURN = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]], np.float32)
"""A rotation of the object that no axis shares."""
PLACE, SIZE, EYE = np.array([0.1, -0.2, 0.3], np.float32), np.float32(1.5), (0.3, 0.2, 1.0)


def matrices(quats: np.ndarray) -> np.ndarray:
    """Return rotation matrices of quaternions wxyz."""
    return matrix_from_quaternion(torch.from_numpy(np.ascontiguousarray(quats, np.float32))).numpy()


@pytest.mark.parametrize(
    ("head", "equal"),
    [(lambda: drawn_head(300, 3), 2e-5), (lambda: drawn_head(300, sh=4, sh_frame="world"), 2e-5),
     (lambda: drawn_head(300, 5, columns=2, features=16), 2e-5), (lambda: points(100)["points, softplus"], 1e-3)],
)  # fmt: skip
def test_arrays_have_the_gaussians_of_python(built: Path, tmp_path: Path, head, equal: float) -> None:
    """All five arrays, in a place of the scene, for any record."""
    portable = web.stored(tmp_path / "a.packed", head())
    (face,) = faces_of(portable, 1)
    posed = runtime.pose(portable.baked, face)
    transform = np.eye(4, dtype=np.float32)
    transform[:3, :3], transform[:3, 3] = SIZE * TURN, PLACE
    told = web.run_node(
        "gaussians.mjs", built, tmp_path / "a.packed", web.as_json([face])[0], transform.T.reshape(-1).tolist(), EYE
    )
    n = len(posed.opacities)
    centres, covariances, rotations, scales, colors = (np.array(part, np.float32).reshape(n, -1) for part in told)
    # Python poses some records in the world: this takes them back to the head.
    local = np.linalg.inv(head_of(face) if is_world(portable) else np.eye(4)).astype(np.float32)
    means = posed.means @ local[:3, :3].T + local[:3, 3]
    turns = TURN @ local[:3, :3] @ matrices(posed.quats)
    np.testing.assert_allclose(centres, SIZE * means @ TURN.T + PLACE, rtol=0, atol=2e-5)
    np.testing.assert_allclose(scales, SIZE * posed.scales, rtol=1e-3, atol=1e-7)
    np.testing.assert_allclose(matrices(rotations[:, [3, 0, 1, 2]]), turns, rtol=0, atol=2e-3)
    expected = np.einsum("nij,nj,nkj->nik", turns, (SIZE * posed.scales) ** 2, turns)
    upper = expected[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    np.testing.assert_allclose(covariances, upper, rtol=0, atol=2e-3 * np.abs(upper).max())
    np.testing.assert_allclose(colors[:, 3], posed.opacities, rtol=0, atol=equal)
    seen = TURN.T @ (np.array(EYE, np.float32) - PLACE) / SIZE
    np.testing.assert_allclose(colors[:, :3], seen_colors(posed.sh, means - seen, local), rtol=0, atol=2 * equal)


def is_world(portable: runtime.PortableAvatar) -> bool:
    return isinstance(portable.baked, runtime.MeshBound) and portable.baked.sh_frame == "world"


def head_of(face: runtime.Face) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = matrix_from_axis_angle(torch.from_numpy(face.head_rotation)).numpy()
    T[:3, 3] = face.head_translation
    return T


def seen_colors(sh: np.ndarray, directions: np.ndarray, local: np.ndarray) -> np.ndarray:
    """Return colours along directions of the head frame."""
    x, y, z = (directions / np.linalg.norm(directions, axis=1, keepdims=True) @ local[:3, :3]).T[:, :, None]
    color = 0.5 + 0.28209479177387814 * sh[:, 0]
    if sh.shape[1] > 1:
        color = color + 0.4886025119029199 * (-y * sh[:, 1] + z * sh[:, 2] - x * sh[:, 3])
    return color.clip(0)


def test_adapters_are_small(built: Path) -> None:
    for engine in ENGINES:
        assert len(gzip.compress((built / f"{engine}.js").read_bytes(), 9)) <= 4000
        assert (WEB / "src" / f"{engine}.ts").read_text().count("\n") <= 200


def write_set(folder: Path) -> None:
    options = ["--gaussians", "3000", "--side", "160", "--faces", "2", "--people", "2"]
    made = [sys.executable, str(WEB / "conformance" / "make.py"), "--out", str(folder / "set"), *options]
    subprocess.run(made, check=True, capture_output=True)


@pytest.fixture(scope="module")
def site(built: Path, made_once, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the conformance page, with a set of few small pictures."""
    folder = Path(
        shutil.copytree(made_once("conformance", write_set), tmp_path_factory.mktemp("site"), dirs_exist_ok=True)
    )
    shutil.copy(WEB / "conformance" / "index.html", folder)
    for name in (*(name for name, needed in ENGINES.items() if package(needed)), "run"):
        bundled(built, WEB / "conformance" / f"{name}.js", folder / "built" / f"{name}.js")
    return folder


def bundled(built: Path, source: Path, out: Path) -> None:
    names = ("motion", "gaussians", *ENGINES)
    aliases = [f"--alias:mien-web/{name}={built / name}.js" for name in names]
    web.bundle(source, out, f"--alias:mien-web={built / 'mien.js'}", *aliases)


END = "while (!window.rows && !window.failed) await new Promise((done) => setTimeout(done, 100)); return window.rows ?? window.failed;"


@pytest.mark.unchecked
@pytest.mark.parametrize("engine", ENGINES)
def test_the_conformance_page_passes(site: Path, engine: str) -> None:
    """Faces, a box before and behind the head, two avatars, and what objects of a scene do: as in mien's own renderer."""
    with web.served(site) as address:
        told = web.browse(f"{address}/index.html?engine={engine}", [web.script(END)], size=(400, 600))
    (rows,) = told["results"]
    assert isinstance(rows, list), rows
    assert len(rows) == 2 * 2 + 2 + 1 + 5
    assert [row for row in rows if not row["passed"]] == []
