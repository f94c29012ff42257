"""Former findings of the fuzzers, and matrices of files, are refused in one line that names the file."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

import train_toy
from fuzzing.material import new_avatar, tiny_flame
from mien import runtime
from mien.avatar import make_portable
from mien.capture.crop import whole_picture
from mien.capture.given import GivenMattes
from mien.driving import drive
from mien.errors import UserError
from mien.export import ply, read_ply, read_usd, write_ply
from mien.face import FaceParams
from mien.face.checks import check_face_params
from mien.face.flame import read_flame
from mien.gaussians import Gaussians
from mien.limits import rigid_fault
from mien.picture_files import decode_png, png_fits
from mien.render.validation import NotFiniteError
from mien.runtime.checks import check
from mien.training import train, trainer
from toy_scene import toy_camera, toy_sequence


def still(timesteps: int = 1) -> FaceParams:
    return toy_sequence(timesteps=timesteps, size=32)[1].tracking.face


def test_a_ply_of_too_many_gaussians(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "head.ply"
    quats = torch.eye(4)
    write_ply(path, Gaussians(torch.zeros(4, 3), quats, torch.ones(4, 3), torch.ones(4), torch.zeros(4, 1, 3)))
    monkeypatch.setattr(ply, "MAX_GAUSSIANS", 3)
    with pytest.raises(UserError, match=r"head\.ply: has 4 Gaussians, more than 3"):
        read_ply(path)


def test_fewer_mattes_than_frames(tmp_path: Path) -> None:
    for index in range(2):
        assert cv2.imwrite(str(tmp_path / f"{index}.png"), np.zeros((8, 8), np.uint8))
    mattes = GivenMattes(tmp_path, (8, 8))
    with pytest.raises(UserError, match="ends before its frame 2"):
        mattes.matte(2, whole_picture(8, 8, 8))


def test_a_png_of_a_beginning_and_an_end(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\nIEND\xaeB`\x82")
    with pytest.raises(UserError, match=r"a\.png: damaged"):
        decode_png(path, (8, 8), "capture again")


def test_face_parameters_of_another_type() -> None:
    model, face = toy_sequence(timesteps=1, size=32)[0], still()
    with pytest.raises(UserError, match=r"here: expression is torch\.float64"):
        check_face_params(model, replace(face, expression=face.expression.double()), "here", "track again")


def test_a_tracking_of_another_size_names_its_folder(tmp_path: Path) -> None:
    model, sequence = toy_sequence(timesteps=5, size=32)
    face = replace(sequence.tracking.face, identity=torch.zeros(0))
    other = replace(sequence, tracking=replace(sequence.tracking, face=face), folder=tmp_path / "clip")
    with pytest.raises(UserError, match=r"clip: identity is \[0\]"):
        train([other], model, train_toy.CONFIG, train_toy.SETTINGS, tmp_path / "run")


def test_a_driver_of_another_size_is_named() -> None:
    face = still()
    with pytest.raises(UserError, match=r"^take\.csv has 0x3 joints parameters"):
        drive(replace(face, joints=face.joints[:, :0]), face, face, who="take.csv")


def test_triangles_that_face_nowhere(tmp_path: Path) -> None:
    path = tmp_path / "tiny.npz"
    arrays = tiny_flame()
    turned: dict[str, Any] = {**arrays, "f": arrays["f"][:, ::-1]}
    np.savez(path, **turned)
    with pytest.raises(UserError, match=r"tiny\.npz: 'f' has no triangle that faces outwards"):
        read_flame(path)


def test_divergence_names_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def step(*_: object) -> str:
        raise NotFiniteError("means[0] is nan")

    monkeypatch.setattr(trainer, "step", step)
    model, sequence = toy_sequence(timesteps=5, size=32)
    with pytest.raises(UserError, match=r"run: training diverged by step 0 \(means\[0\] is nan\)"):
        train([sequence], model, train_toy.CONFIG, train_toy.SETTINGS, tmp_path / "run")


def test_a_png_chunk_that_is_longer_than_its_file() -> None:
    """A decoder would allocate the 4 GB that the chunk announces."""
    data = cv2.imencode(".png", np.zeros((8, 8), np.uint8))[1].tobytes()
    assert png_fits(data)
    assert png_fits(data + b"whatever other programs add")
    place = data.index(b"IDAT") - 4
    assert not png_fits(data[:place] + b"\xff\xff\xff\xf0" + data[place + 4 :])
    assert not png_fits(data[:-12])


def test_a_prim_of_usd_without_a_name(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """USD would end the process when it is asked for the files that such a layer refers to."""
    Sdf = pytest.importorskip("pxr.Sdf", reason="usd-core is not installed")
    layer = Sdf.Layer.CreateNew(str(tmp_path / "head.usda"))
    layer.Save()

    class Damaged:
        def Traverse(self, start: object, visit: Callable[[object], None]) -> None:
            visit(Sdf.Path.emptyPath)
            visit(Sdf.Path.absoluteRootPath)

        def GetCompositionAssetDependencies(self) -> None:
            pytest.fail("USD would end the process here")

    monkeypatch.setattr(Sdf.Layer, "FindOrOpen", lambda path: Damaged())
    with pytest.raises(UserError, match="is damaged, or not a USD file"):
        read_usd(tmp_path / "head.usda")


# Matrices, which hold a rotation and a translation. `fuzzing.values` has those of cameras -----------------------------

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


def test_frames_of_ply_files(tmp_path: Path) -> None:
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
