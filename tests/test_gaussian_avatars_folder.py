"""GaussianAvatars' folders: what is written is read back and draws the same, and damage is named in one line."""

import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from flame_like import posed_as_flame
from fuzzing.material import tiny_flame
from known import known
from mien.avatar import Avatar
from mien.avatar.methods import METHODS
from mien.face import FaceModel, FaceParams
from mien.face.models.flame import flame_face_model, read_flame
from mien.face.models.flame_params import read_flame_params, write_flame_params
from mien.formats import read_ply
from mien.formats.gaussian_avatars import read_gaussian_avatars_folder, write_gaussian_avatars_folder
from mien.render import rasterize
from plain_settings import plain_gaussian_avatars
from refusals import refuses
from toy_scene import moved, toy_camera, toy_face, toy_face_model

CAMERA = toy_camera(64)
EQUAL = 1e-4


def new_avatar(face_model: FaceModel, face: FaceParams, **config: object) -> Avatar:
    """Return an avatar of GaussianAvatars with several Gaussians on some triangles, whose values are all random."""
    avatar = METHODS["gaussian_avatars"].avatar(plain_gaussian_avatars(**config), face_model, face)
    avatar.store.append(torch.arange(0, len(face_model.faces), 3))
    moved(avatar, 0.2)
    with torch.no_grad():
        avatar.store["opacity_logits"].add_(3)
    return avatar


@torch.no_grad()
def drawn(avatar: Avatar, face: FaceParams) -> torch.Tensor:
    gaussians = avatar.pose(face).gaussians
    return torch.stack([rasterize(gaussians.timestep(t), CAMERA, torch.ones(3)).image for t in range(len(face))])


@pytest.fixture
def flame(tmp_path: Path) -> FaceModel:
    """Return a small face model in FLAME's schema, with a licence that does not allow copies."""
    path = tmp_path / "flame.npz"
    np.savez(path, **tiny_flame())  # pyright: ignore[reportArgumentType]
    return flame_face_model(read_flame(path), "tiny")


def flame_face(model: FaceModel) -> FaceParams:
    random = torch.Generator().manual_seed(2)

    def some(*shape: int, size: float) -> torch.Tensor:
        return size * torch.randn(*shape, generator=random)

    return FaceParams(
        some(len(model.identity_basis), size=1.0), some(4, len(model.expression_basis), size=1.0),
        some(4, 4, 3, size=0.15), some(4, 3, size=0.2),
        some(4, 3, size=0.02) + torch.tensor([0.0, 0.0, -0.6]), some(len(model.template), 3, size=1e-3),
    )  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return the folder of an avatar on the toy face model."""
    model, face = toy_face_model(), toy_face(5)
    write_gaussian_avatars_folder(tmp_path / "written", new_avatar(model, face), face)
    return tmp_path / "written"


@pytest.mark.parametrize("config", [{}, {"sh_degree": 3}, {"sh_degree": 2, "sh_frame": "head"}])
def test_a_written_folder_draws_the_same(config: dict, tmp_path: Path) -> None:
    model, face = toy_face_model(), replace(toy_face(5), vertex_offsets=None)
    avatar = new_avatar(model, face, **config)
    write_gaussian_avatars_folder(tmp_path / "a", avatar, face)
    read = read_gaussian_avatars_folder(tmp_path / "a")
    assert len(read.avatar.store) == len(avatar.store) > len(model.faces)
    assert read.avatar.face_model.content_hash == model.content_hash
    pictures = drawn(avatar, face)
    assert float((pictures[0] - pictures[2]).abs().max()) > 0.05
    assert float((drawn(read.avatar, read.face) - pictures).abs().max()) < EQUAL


def test_a_folder_on_flame_draws_the_same(flame: FaceModel, tmp_path: Path) -> None:
    """Parameters become FLAME's and come back; FLAME itself is not in the folder and has to be given."""
    flame, folder = replace(flame, shareable=False), tmp_path / "a"
    face = flame_face(flame)
    avatar = new_avatar(flame, face, sh_degree=1)
    write_gaussian_avatars_folder(folder, avatar, face)
    assert sorted(path.name for path in folder.iterdir()) == ["flame_param.npz", "point_cloud.ply"]
    refuses("has no face model in it.*--face-model", read_gaussian_avatars_folder, folder)
    read = read_gaussian_avatars_folder(folder, flame)
    pictures = drawn(avatar, face)
    assert float(pictures.std()) > 0.05
    assert float((drawn(read.avatar, read.face) - pictures).abs().max()) < EQUAL


def test_parameters_are_those_of_flame(flame: FaceModel, tmp_path: Path) -> None:
    """The arrays, posed by FLAME's formulas in float64, give the vertices of mien's face model."""
    face = flame_face(flame)
    write_flame_params(tmp_path / "flame_param.npz", flame, face)
    with np.load(tmp_path / "flame_param.npz") as file:
        stored = dict(file)
    assert {name: array.shape for name, array in stored.items()} == {
        "shape": (4,), "expr": (4, 3), "rotation": (4, 3), "translation": (4, 3), "neck_pose": (4, 3),
        "jaw_pose": (4, 3), "eyes_pose": (4, 6), "static_offset": (1, len(flame.template), 3),
    }  # fmt: skip
    for t in range(len(face)):
        pose = np.concatenate([stored["rotation"][t], stored["neck_pose"][t], stored["jaw_pose"][t]])
        pose = np.concatenate([pose, stored["eyes_pose"][t]]).reshape(5, 3).astype(np.float64)
        shape = np.concatenate([stored["shape"], stored["expr"][t]]).astype(np.float64)
        expected = posed_as_flame(tiny_flame(), pose, shape, stored["translation"][t], stored["static_offset"][0])
        assert np.abs(flame(face[t])[0].numpy() - expected).max() < 2e-6


def test_offsets_without_teeth_are_padded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flame: FaceModel) -> None:
    v = len(flame.template)
    monkeypatch.setattr("mien.face.models.flame_params.TEETH", (v - 20, v))
    write_flame_params(tmp_path / "flame_param.npz", flame, flame_face(flame))
    own = known(flame_face(flame).vertex_offsets)
    change(tmp_path, static_offset=own[None, : v - 20].numpy(), dynamic_offset=np.zeros((4, v, 3), np.float32))
    offsets = known(read_flame_params(tmp_path / "flame_param.npz", flame).vertex_offsets)
    assert torch.equal(offsets[: v - 20], own[: v - 20])
    assert not offsets[v - 20 :].any()


def test_a_ply_with_local_means_is_refused_without_its_mesh(folder: Path) -> None:
    refuses(r"frames of triangles \(binding_0\).*`mien import FOLDER --out DIR`", read_ply, folder / "point_cloud.ply")


KINDS = {"int": "<i4", "int32": "<i4", "uint": "<u4", "short": "<i2", "float": "<f4", "double": "<f8"}


def edit(folder: Path, kind: str = "int", **values: float) -> None:
    """Change values of the fourth Gaussian, and write binding_0 with another type."""
    header, mark, body = (folder / "point_cloud.ply").read_bytes().partition(b"end_header\n")
    names = [line.split()[-1].decode() for line in header.split(b"\n") if line.startswith(b"property")]
    old, new = ([(name, KINDS[one] if name == "binding_0" else "<f4") for name in names] for one in ("int", kind))
    rows = np.frombuffer(body, old).astype(new)
    for name, value in values.items():
        rows[name][3] = value
    header = header.replace(b"int binding_0", f"{kind} binding_0".encode())
    (folder / "point_cloud.ply").write_bytes(header + mark + rows.tobytes())


@pytest.mark.parametrize(
    ("kind", "value"), [("float", np.nan), ("float", 2.5), ("int", -1), ("uint", 1e9), ("gone", 0)]
)
def test_a_damaged_binding_is_named(kind: str, value: float, folder: Path) -> None:
    path = folder / "point_cloud.ply"
    if kind == "gone":
        path.write_bytes(path.read_bytes().replace(b"int binding_0", b"float bonding_"))
    else:
        edit(folder, kind, binding_0=value)
    refuses(r"point_cloud.ply: (lacks )?binding_0[^\n]*; [^\n]*$", read_gaussian_avatars_folder, folder)


def change(folder: Path, **arrays: np.ndarray | None) -> None:
    """Replace arrays of flame_param.npz, or remove them."""
    path = folder / "flame_param.npz"
    with np.load(path) as file:
        changed = dict(file) | arrays
    stored: dict = {name: array for name, array in changed.items() if array is not None}
    np.savez(path, allow_pickle=True, **stored)


FAULTS = {
    "no parameters": (lambda f: (f / "flame_param.npz").unlink(), "flame_param.npz: is missing"),
    "no points": (lambda f: (f / "point_cloud.ply").unlink(), "has no point_cloud.ply"),
    "half a model": (lambda f: (f / "face_model.safetensors").unlink(), "face_model.safetensors: is missing"),
    "no archive": (lambda f: (f / "flame_param.npz").write_bytes(b"PK" * 40), "cannot be read as .npz"),
    "an array": (lambda f: change(f, expr=None), "has no 'expr'"),
    "a pickle": (lambda f: change(f, shape=np.array([{}], object)), "not plain numbers"),
    "nan": (lambda f: change(f, rotation=np.full((5, 3), np.nan, np.float32)), "'rotation' holds NaN"),
    "huge": (lambda f: change(f, translation=np.full((5, 3), 1e30, np.float32)), "'translation' holds NaN or numbers"),
    "frames": (lambda f: change(f, jaw_pose=np.zeros((4, 3), np.float32)), r"'jaw_pose' has the shape \[4, 3\]"),
    "no frames": (lambda f: change(f, expr=np.zeros((0, 2), np.float32)), r"'expr' has the shape \[0, 2\]"),
    "axes": (lambda f: change(f, shape=np.zeros((1, 2), np.float32)), r"'shape' has the shape \[1, 2\]"),
    "shape": (lambda f: change(f, shape=np.ones(3, np.float32)), "3 coefficients, but the face model has 2"),
    "offsets": (lambda f: change(f, static_offset=np.ones((1, 9, 3), np.float32)), "'static_offset' has the shape"),
    "moving": (lambda f: change(f, dynamic_offset=np.ones((5, 9, 3), np.float32)), "'dynamic_offset' is not zero"),
    "scales": (lambda f: edit(f, scale_0=1e5), "cannot be posed"),
    "means": (lambda f: edit(f, x=np.nan), "means holds NaN"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_a_damaged_folder_is_refused_in_one_line(fault: str, folder: Path) -> None:
    damage, message = FAULTS[fault]
    damage(folder)
    error = refuses(message, read_gaussian_avatars_folder, folder)
    assert str(folder) in error


@pytest.mark.parametrize("name", ["point_cloud.ply", "flame_param.npz", "face_model.json", "face_model.safetensors"])
def test_links_and_pipes_are_refused(name: str, folder: Path, tmp_path: Path) -> None:
    shutil.move(folder / name, tmp_path / name)
    (folder / name).symlink_to(tmp_path / name)
    refuses("is a link", read_gaussian_avatars_folder, folder)
    (folder / name).unlink()
    os.mkfifo(folder / name)
    refuses(name, read_gaussian_avatars_folder, folder)


def test_an_archive_that_unpacks_to_gigabytes_is_refused(folder: Path) -> None:
    np.savez_compressed(folder / "flame_param.npz", expr=np.zeros((5, 20_000_000), np.float32))
    refuses(r"400,000,000 bytes", read_gaussian_avatars_folder, folder)


def test_methods_without_triangles_are_refused(tmp_path: Path) -> None:
    """And changes with the expression, which would be lost silently. Nothing is written."""
    model, face = toy_face_model(), toy_face(2)
    headgas = METHODS["headgas"].avatar(METHODS["headgas"].config(), model, face)
    changing = new_avatar(model, face, expression_rank=2)
    for avatar, words in (
        (headgas, "bound to triangles"),
        (changing, "cannot hold Gaussians that change with the exp"),
    ):
        refuses(words, write_gaussian_avatars_folder, tmp_path / "a", avatar, face)
        assert not (tmp_path / "a").exists()
