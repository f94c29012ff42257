"""A 4x4 matrix from a file is a rotation and a translation, or refused. test_recordings has those of recordings."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mien import runtime
from mien.avatar import make_portable
from mien.errors import UserError
from mien.export import read_ply, write_ply
from mien.gaussians import Gaussians
from mien.limits import rigid_fault
from mien.render.camera_paths import read_cameras
from mien.runtime.checks import check
from test_runtime import new_avatar
from toy_scene import toy_camera

TURN = np.array([[0.8, -0.6, 0, 0.1], [0.6, 0.8, 0, 0.2], [0, 0, 1, 0.7], [0, 0, 0, 1]])
SHEARED, TILTED, MIRRORED, LOST = TURN.copy(), TURN.copy(), TURN.copy(), TURN.copy()
SHEARED[0, 1] = 0.3
TILTED[3] = [0, 0, 0.5, 1]
MIRRORED[:, 0] *= -1
LOST[0, 3] = np.nan
BAD = (
    (TURN.T, "it is transposed; put the translation into the last column"),
    (TILTED, "its last row is 0 0 0.5 1; it must be 0 0 0 1"),
    (SHEARED, "not a rotation"),
    (MIRRORED, "not a rotation"),
    (LOST, "must be"),
    (TURN[:3], "must be"),
)


def test_the_form_of_a_matrix() -> None:
    assert rigid_fault(TURN) is None
    for matrix, words in BAD:
        assert words in str(rigid_fault(matrix))


@pytest.mark.parametrize(("matrix", "words"), BAD)
def test_cameras(matrix: np.ndarray, words: str, tmp_path: Path) -> None:
    """The matrix of a camera is refused with its fault."""
    entry = {"K": [[40, 0, 16], [0, 40, 16], [0, 0, 1]], "viewmat": matrix.tolist(), "width": 32, "height": 32}
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps({"format": "mien.cameras", "version": 1, "cameras": [entry]}).replace("NaN", "null"))
    with pytest.raises(UserError, match=words if words != "must be" else "viewmat"):
        read_cameras(path)


def test_frames_of_ply_files(tmp_path: Path) -> None:
    """The frame of a local .ply is a rigid pose, or the file is refused."""
    path, pose = tmp_path / "a.ply", torch.from_numpy(TURN).float()
    turned = torch.nn.functional.normalize(torch.ones(5, 4), dim=1)
    write_ply(path, Gaussians(torch.zeros(5, 3), turned, torch.ones(5, 3), torch.ones(5), torch.zeros(5, 1, 3), pose))
    assert torch.equal(read_ply(path).T_world_local, pose)  # pyright: ignore[reportArgumentType]
    words = b"T_world_local row by row: "
    head, tail = path.read_bytes().split(words)
    line, rest = tail.split(b"\n", 1)
    for matrix, _ in BAD[:4]:
        own = " ".join(str(value) for value in matrix.flatten()).encode()
        path.write_bytes(head + words + own + b"\n" + rest)
        with pytest.raises(UserError, match="has a damaged frame comment"):
            read_ply(path)
    path.write_bytes(head + words + line + b"\n" + rest)
    assert len(read_ply(path)) == 5


def test_poses_of_mien_files() -> None:
    """The pose of the bone that stands still is a rigid pose, or the .mien file is refused."""
    portable = make_portable(new_avatar("mono_gaussian_avatar"), toy_camera(32), "skinned")
    baked = portable.baked
    assert isinstance(baked, runtime.BlendSkinned)
    weights = np.full(len(baked.attributes.quats), 0.1, np.float32)
    for matrix, words in ((TURN, ""), *BAD[:4]):
        still = replace(baked, still_weights=weights, still_pose=matrix.astype(np.float32))
        if words:
            with pytest.raises(UserError, match=words):
                check(replace(portable, baked=still), "a.mien")
        else:
            check(replace(portable, baked=still), "a.mien")
