"""Every former finding of the fuzzers is refused when it is read, in one line that names the file."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import safetensors.torch
import torch

import train_toy
from bounded_memory import MIB, allocating_at_most
from fuzzing.material import tiny_flame
from mien.avatar import load_avatar
from mien.capture.crop import whole_picture
from mien.capture.given import GivenMattes
from mien.driving import drive, read_blendshape_json, read_live_link_face
from mien.errors import UserError
from mien.export import ply, read_ply, read_usd
from mien.face import FaceParams
from mien.face.checks import check_face_params
from mien.face.flame import read_flame
from mien.face.loading import read_landmarks
from mien.files import read_arrays
from mien.picture_files import decode_png, png_fits
from mien.render.validation import NotFiniteError
from mien.storage import file_digest, read_json, read_tensors, write_json, write_tensors
from mien.tracking import Scoring, read_scoring, write_scoring
from mien.training import read_curves, train, trainer
from mien.training.checkpoint import checkpoint_files, resume
from toy_scene import toy_sequence


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    train_toy.main(folder, 4)
    return folder


def still(timesteps: int = 1) -> FaceParams:
    return toy_sequence(timesteps=timesteps, size=32)[1].tracking.face


def test_a_pipe_is_no_recording_and_no_ply(tmp_path: Path) -> None:
    """A pipe is not a recording or a .ply. Opening a pipe would wait for a writer, and a device never ends."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for read in (read_live_link_face, read_blendshape_json, read_ply):
        with pytest.raises(UserError, match="pipe.* ordinary file"):
            read(pipe)


def test_a_ply_of_too_many_gaussians(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A .ply that announces too many Gaussians is refused."""
    path = tmp_path / "head.ply"
    ply.write_ply(path, train_toy_gaussians())
    monkeypatch.setattr(ply, "_MAX_GAUSSIANS", 3)
    with pytest.raises(UserError, match=r"head\.ply: has 4 Gaussians, more than 3"):
        read_ply(path)


def train_toy_gaussians() -> ply.Gaussians:
    return ply.Gaussians(torch.zeros(4, 3), torch.eye(4), torch.ones(4, 3), torch.full((4,), 0.5), torch.zeros(4, 1, 3))


def test_fewer_mattes_than_frames(tmp_path: Path) -> None:
    """Fewer mattes than frames are refused with the missing frame."""
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


@pytest.mark.parametrize(
    "text",
    [
        b"{", b"\xff", b"[" * 2000, b"[]", b'{"topology_hash": 3}',
        b'{"topology_hash": "HASH", "landmarks": {"a": {"faces": ["x"], "barycentric": [[1, 0, 0]]}}}',
        b'{"topology_hash": "HASH", "landmarks": {"a": {"faces": [99999], "barycentric": [[1, 0, 0]]}}}',
        b'{"topology_hash": "HASH", "landmarks": {"a": {"faces": [0], "barycentric": [[1, 0]]}}}',
        b'{"topology_hash": "HASH", "landmarks": {"a": {"faces": [0], "barycentric": [[1e300, 0, 0]]}}}',
        b'{"topology_hash": "HASH", "landmarks": {"a": []}}',
    ],
)  # fmt: skip
def test_landmarks_of_an_added_face_model(text: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Damaged landmarks of an added face model are refused by their file."""
    monkeypatch.setenv("MIEN_CACHE", str(tmp_path))
    model = toy_sequence(timesteps=1, size=32)[0]
    path = tmp_path / "face_models" / "added" / "mine.landmarks.json"
    path.parent.mkdir(parents=True)
    path.write_bytes(text.replace(b"HASH", model.topology_hash.encode()))
    with pytest.raises(UserError, match=r"mine\.landmarks\.json") as error:
        read_landmarks("mine", model)
    assert "\n" not in str(error.value)


def test_landmarks_of_gigabytes_are_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MIEN_CACHE", str(tmp_path))
    path = tmp_path / "face_models" / "added" / "mine.landmarks.json"
    path.parent.mkdir(parents=True)
    path.touch()
    os.truncate(path, 1 << 30)
    model = toy_sequence(timesteps=1, size=32)[0]
    with (
        allocating_at_most(64 * MIB),
        pytest.raises(UserError, match=r"mine\.landmarks\.json: .*at most 4,194,304 are"),
    ):
        read_landmarks("mine", model)


def test_face_parameters_of_another_type() -> None:
    """Face parameters of another type are refused."""
    model, face = toy_sequence(timesteps=1, size=32)[0], still()
    with pytest.raises(UserError, match=r"here: expression is torch\.float64"):
        check_face_params(model, replace(face, expression=face.expression.double()), "here", "track again")


@pytest.mark.parametrize("index", [2**32, -(2**63), -1])
def test_indices_that_baking_would_narrow_to_some_that_exist(index: int, run: Path, tmp_path: Path) -> None:
    """Indices are refused that would exist only after narrowing to 32 bits."""
    folder = tmp_path / "avatar"
    folder.mkdir()
    for file in (run / "avatar").iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    tensors = read_tensors(folder / "avatar.safetensors")
    tensors["avatar.store.face_index"][0] = index
    write_tensors(folder / "avatar.safetensors", tensors)
    seal(folder)
    with pytest.raises(UserError, match="holds numbers that are not indices"):
        load_avatar(folder)


def test_an_avatar_of_no_method_names_its_file(run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "avatar"
    folder.mkdir()
    for file in (run / "avatar").iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    content = read_json(folder / "avatar.json", "mien.avatar", 1)
    write_json(folder / "avatar.json", "mien.avatar", 1, {**content, "kind": "../../x"})
    with pytest.raises(UserError, match=r"avatar\.json: no method '\.\./\.\./x'"):
        load_avatar(folder)


def seal(folder: Path) -> None:
    """Update the hash in the json after a change of the tensors."""
    content = read_json(folder / "avatar.json", "mien.avatar", 1)
    digest = file_digest(folder / "avatar.safetensors")
    write_json(folder / "avatar.json", "mien.avatar", 1, {**content, "tensors_sha256": digest})


def test_curves_that_lack_one(run: Path, tmp_path: Path) -> None:
    """Curves are refused if one is missing."""
    curves = read_tensors(run / "curves.safetensors")
    curves.pop("psnr")
    write_tensors(tmp_path / "curves.safetensors", curves)
    with pytest.raises(UserError, match=r"curves\.safetensors: lacks psnr"):
        read_curves(tmp_path)


def test_curves_that_no_plot_can_show(run: Path, tmp_path: Path) -> None:
    curves = read_tensors(run / "curves.safetensors")
    curves["step"][-1] = 1e300
    write_tensors(tmp_path / "curves.safetensors", curves)
    with pytest.raises(UserError, match=r"curves\.safetensors: holds numbers beyond 1e\+12"):
        read_curves(tmp_path)


def test_a_curve_without_a_number(run: Path, tmp_path: Path) -> None:
    """A curve without a finite number is refused."""
    curves = read_tensors(run / "curves.safetensors")
    curves["loss"].fill_(torch.nan)
    write_tensors(tmp_path / "curves.safetensors", curves)
    with pytest.raises(UserError, match="has a curve without any finite number"):
        read_curves(tmp_path)


def test_a_crop_that_misses_its_mask(tmp_path: Path) -> None:
    """A crop that holds nothing of its mask is refused."""
    masks, crops = np.full((2, 1, 8, 8), 255, np.uint8), np.array([[[0, 0, 8, 8]], [[0, 0, 0, 0]]])
    write_scoring(tmp_path / "scoring", Scoring(masks, crops), "of a capture")
    with pytest.raises(UserError, match=r"crops\.safetensors: a crop is empty although its mask is not"):
        read_scoring(tmp_path / "scoring")


def test_moments_of_another_type(run: Path, tmp_path: Path) -> None:
    """Moments of another type are refused when a run resumes."""
    newest = checkpoint_files(run / "checkpoints")[-1]
    tensors = read_tensors(newest)
    tensors["store.means:first"] = tensors["store.means:first"].to(torch.int8)
    write_tensors(tmp_path / newest.name, tensors)
    model, sequence = toy_sequence(timesteps=5, size=32)
    state = trainer.start([sequence], model, train_toy.CONFIG, train_toy.SETTINGS)
    with pytest.raises(UserError, match="the moments of means have another type"):
        resume(tmp_path, state, first_record=1)


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
    """A head without a triangle that faces outwards is refused."""
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
    """A PNG chunk that is longer than its file is refused.

    A decoder would allocate the 4 GB that the chunk announces.
    """
    data = cv2.imencode(".png", np.zeros((8, 8), np.uint8))[1].tobytes()
    assert png_fits(data)
    assert png_fits(data + b"whatever other programs add")
    place = data.index(b"IDAT") - 4
    assert not png_fits(data[:place] + b"\xff\xff\xff\xf0" + data[place + 4 :])
    assert not png_fits(data[:-12])


def test_numbers_of_a_type_that_numpy_lacks(tmp_path: Path) -> None:
    file = tmp_path / "arrays.safetensors"
    file.write_bytes(safetensors.torch.save({"points": torch.zeros(4).to(torch.float8_e5m2)}))
    with pytest.raises(UserError, match="arrays.safetensors: damaged safetensors file"):
        read_arrays(file)


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
