"""Avatars without torch draw the same pictures but for the rounding of networks, and report damaged files."""

import json
import re
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy
import torch

from mien import runtime
from mien.avatar import Avatar
from mien.avatar.baking import make_portable
from mien.avatar.gaussian_avatars.avatar import GaussianAvatars
from mien.avatar.methods import DEFAULT_METHOD, METHODS
from mien.avatar.settings import MethodConfig
from mien.camera import Camera, camera_from_fov
from mien.face import FaceModel, FaceParams, load_face_model
from mien.render import rasterize
from mien.runtime.posing import Gaussians, run_network
from plain_settings import plain_config
from refusals import refuses
from toy_scene import moved, runtime_face, toy_camera, toy_sequence

SIZE = 64
method = pytest.mark.parametrize("method", METHODS)


def new_avatar(method: str, **config: object) -> Avatar:
    """Return an avatar of the toy head whose parameters all differ from their initial values."""
    face_model, sequence = toy_sequence(5, SIZE)
    torch.manual_seed(0)
    settings = replace(plain_config(method), **config)  # type: ignore[arg-type]
    return moved(METHODS[method].avatar(settings, face_model, sequence.tracking.face), 0.1)


def export(avatar: Avatar, path: Path) -> runtime.Avatar:
    runtime.write_portable(path, make_portable(avatar, toy_camera(SIZE), "toy"))
    return runtime.load(path)


@method
def test_a_file_holds_the_avatar_and_the_subject(method: str, tmp_path: Path) -> None:
    """What training draws is compared below."""
    avatar = new_avatar(method)
    loaded = export(avatar, tmp_path / "a.mien")
    subject = runtime.pose(loaded.portable.baked, runtime_face(avatar.subject))
    np.testing.assert_allclose(loaded.pose().means, subject.means)
    assert (loaded.expression_names, loaded.joint_names) == (("drop", "swell"), ("neck",))
    assert loaded.portable.about.method == method
    runtime.write_portable(tmp_path / "b.mien", loaded.portable)
    assert (tmp_path / "a.mien").read_bytes() == (tmp_path / "b.mien").read_bytes()


def test_names_and_their_mistakes(tmp_path: Path) -> None:
    portable = export(new_avatar(DEFAULT_METHOD), tmp_path / "toy.mien")
    rest = portable.face()
    face = portable.face({"drop": 0.7}, {"neck": (0.1, 0, 0)}, head_rotation=(0, 0.2, 0))
    assert face.expression.tolist() == [np.float32(0.7), rest.expression[1]]
    assert face.joints.tolist() == [[np.float32(0.1), 0, 0]]
    assert face.head_translation.tolist() == rest.head_translation.tolist()
    for wrong, part in (
        ({"expression": {"dorp": 1.0}}, "no expression 'dorp'; did you mean drop?"),
        ({"expression": np.zeros(3, np.float32)}, "expected \\(2,\\)"),
        ({"expression": {"drop": float("nan")}}, "not finite"),
        ({"joints": {"nose": (0, 0, 0)}}, "did you mean neck"),
        ({"head_rotation": (0, 1)}, "three finite numbers"),
    ):
        with pytest.raises(ValueError, match=part):
            portable.pose(**wrong)  # pyright: ignore[reportArgumentType]


@torch.no_grad()
def test_the_features_network_equals_its_reference_in_numpy_and_has_directions_that_fit(tmp_path: Path) -> None:
    whole = export(new_avatar("headgas", directions=2), tmp_path / "a.mien").portable
    assert isinstance(whole.baked, runtime.Static)
    network = whole.baked.network
    assert network is not None
    for timestep in range(3):
        face = runtime_face(toy_sequence(5, SIZE)[1].tracking.face[timestep])
        posed = runtime.pose(whole.baked, face)
        by_hand = run_network(network, np.zeros_like(whole.baked.means), face)
        np.testing.assert_allclose(by_hand[:, :-1].reshape(posed.sh.shape), posed.sh, rtol=0, atol=2e-6)
        np.testing.assert_allclose(1 / (1 + np.exp(-by_hand[:, -1])), posed.opacities, rtol=0, atol=5e-7)
    along = network.along
    assert along is not None
    for wrong, part in (
        (replace(along, rest=along.rest[1:], directions=along.directions[1:]), "along.rest has the shape"),
        (replace(along, basis=np.repeat(along.basis, 9, 2)), "288 features, but"),
        (replace(along, basis=along.basis[1:]), "along.basis has the shape"),
        (None, "the input features, which does not fit its directions"),
    ):
        baked = replace(whole.baked, network=replace(network, along=wrong))
        refuses(part, runtime.write_portable, tmp_path / "a.mien", replace(whole, baked=baked))


def test_files_with_other_content_are_told(tmp_path: Path) -> None:
    """Files with other content are reported, although another program wrote a right checksum."""
    path = tmp_path / "a.mien"
    whole = export(new_avatar(DEFAULT_METHOD), path).portable
    bound = whole.baked
    assert isinstance(bound, runtime.MeshBound)
    many = replace(bound.rig, expression_names=tuple(f"e{index}" for index in range(300)))
    nan = np.full_like(whole.neutral.expression, np.nan)
    for wrong, part in (
        (replace(whole, neutral=replace(whole.neutral, expression=nan)), "NaN"),
        (replace(whole, baked=replace(bound, face_index=bound.face_index + 10**6)), "that does not exist"),
        (replace(whole, expression_names=("drop",)), "name different expressions"),
        (replace(whole, joint_names=()), "name different expressions or joints"),
        (replace(whole, baked=replace(bound, rig=replace(bound.rig, joint_parents=(2, 0, 0)))), "before its parent"),
        (replace(whole, baked=replace(bound, rig=many)), "300 expressions and 1 free joints, more than can be posed"),
    ):
        refuses(part, runtime.write_portable, path, wrong)
    arrays = safetensors.numpy.load_file(path)
    for version in (0, 2, "1", None):
        safetensors.numpy.save_file(arrays, path, {"mien": json.dumps({"format": "mien.baked", "version": version})})
        told = f"version {version!r}, expected 'mien.baked' version 1; export it again with `mien export`"
        refuses(re.escape(told), runtime.load, path)
    safetensors.numpy.save_file(arrays, path)
    (tmp_path / "b.mien").write_text("{}")
    for name, told in (
        ("a.mien", r"is not a \.mien file"),
        ("b.mien", r"is damaged, or not a \.mien file .*"),
        ("none.mien", "no such file"),
    ):
        refuses(f"{told}; write one with `mien export", runtime.load, tmp_path / name)


def test_face_models_that_may_not_be_passed_on_are_not() -> None:
    avatar = new_avatar(DEFAULT_METHOD)
    avatar.face_model = replace(avatar.face_model, name="flame", shareable=False)
    refuses("not known to allow", make_portable, avatar, toy_camera(SIZE), "toy")


EQUAL = 1e-5
GAUSSIANS, WIDE, TIMESTEPS = 30_000, 512, 2
RENDER_WITHOUT_TORCH = """
import sys
import numpy as np
from mien import runtime
avatar, faces = runtime.load(sys.argv[1]), np.load(sys.argv[2])
names = ("expression", "joints", "head_rotation", "head_translation")
pictures = [avatar.render(avatar.pose(*(faces[name][t] for name in names))) for t in range(len(faces["joints"]))]
np.savez(sys.argv[3], image=[image for image, _ in pictures], alpha=[alpha for _, alpha in pictures])
avatar.pose({"jawOpen": 0.5}, {"left_eye": (0, 0.1, 0)})
heavy = {"torch", "cv2", "av", "mediapipe", "rich", "tyro"} & set(sys.modules)
assert not heavy, heavy
"""


def noise(seed: int, *shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def talking_face(model: FaceModel) -> FaceParams:
    """Return a person half a metre away, with every expression, every joint and the head in motion."""
    still = model.neutral(TIMESTEPS)
    low, high = model.expression_bounds.unbind(-1)
    chance = torch.rand(still.expression.shape, generator=torch.Generator().manual_seed(1))
    return FaceParams(
        identity=0.5 * noise(2, *still.identity.shape), expression=low + 0.4 * chance * (high - low),
        joints=0.1 * noise(3, *still.joints.shape), head_rotation=0.2 * noise(4, TIMESTEPS, 3),
        head_translation=torch.tensor([0.0, 0.0, -0.5]) + 0.01 * noise(5, TIMESTEPS, 3),
        vertex_offsets=0.001 * noise(6, *model.template.shape),
    )  # fmt: skip


def grown_avatar(model: FaceModel, face: FaceParams, config: MethodConfig, count: int) -> Avatar:
    """Return an avatar as training leaves it: several Gaussians per triangle, small, coloured, mostly opaque."""
    avatar = METHODS[DEFAULT_METHOD].avatar(config, model, face)
    store = avatar.store
    store.append(torch.arange(count - len(store)) % len(store))
    store.assign("means", 0.3 * noise(7, count, 3))
    store.assign("quats", noise(8, count, 4))
    store.assign("log_scales", 0.4 * noise(9, count, 3) - 0.7)
    store.assign("opacity_logits", 2 * noise(10, count) + 1)
    store.assign("sh_constant", noise(11, count, 1, 3))
    for name in sorted({"color_basis", "opacity_basis", "offset_basis"} & set(store.names())):
        store.assign(name, 0.1 * noise(12, *store[name].shape))
    for name in sorted({"feature_bases", "neutral_features"} & set(store.names())):
        store.assign(name, noise(13, *store[name].shape))
        assert isinstance(avatar, GaussianAvatars)
        assert avatar.appearance is not None
        for seed, weight in enumerate(avatar.appearance.parameters()):
            weight.copy_(0.3 * noise(14 + seed, *weight.shape))
    return avatar


def view(size: int) -> Camera:
    return camera_from_fov(0.6, size, size, torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])))


def rendered_without_torch(avatar: Avatar, face: FaceParams, camera: Camera, folder: Path) -> dict[str, np.ndarray]:
    """Return pictures by a process that has never imported torch."""
    runtime.write_portable(folder / "a.mien", make_portable(avatar, camera, "someone"))
    names = ("expression", "joints", "head_rotation", "head_translation")
    np.savez(folder / "faces.npz", allow_pickle=False, **{name: getattr(face, name).numpy() for name in names})
    files = [str(folder / name) for name in ("a.mien", "faces.npz", "pictures.npz")]
    subprocess.run([sys.executable, "-W", "error", "-c", RENDER_WITHOUT_TORCH, *files], check=True)
    with np.load(files[2]) as pictures:
        return dict(pictures)


@pytest.mark.exact
@pytest.mark.parametrize("colors", [
    {}, {"sh_degree": 2}, {"sh_degree": 1, "sh_frame": "head"}, {"sh_degree": 1, "expression_rank": 7},
    {"expression_rank": 4, "appearance": "features"},
], ids=str)  # fmt: skip
@torch.no_grad()
@pytest.mark.unchecked
def test_every_pixel_equals_that_of_training(colors: dict[str, Any], tmp_path: Path) -> None:
    """Every pixel equals that of training: 30,000 Gaussians at 512x512, no pixel left out."""
    model, camera = load_face_model("anny"), view(WIDE)
    face = talking_face(model)
    avatar = grown_avatar(model, face, plain_config(DEFAULT_METHOD, **colors), GAUSSIANS)
    assert len(avatar.store) == GAUSSIANS
    expected = rasterize(avatar.pose(face).gaussians, [camera] * TIMESTEPS, torch.ones(3))
    found = rendered_without_torch(avatar, face, camera, tmp_path)
    assert found["image"].shape == (TIMESTEPS, WIDE, WIDE, 3)
    assert (expected.alpha > 0.5).float().mean() > 0.2
    assert (expected.image[0] - expected.image[1]).abs().mean() > 0.02
    for name, picture in (("image", expected.image.numpy()), ("alpha", expected.alpha.numpy())):
        assert found[name].tobytes() == picture.tobytes(), "both sides run the same operations, so they round alike"


POINTS = 6_000
"""Number of Gaussians at the start, where a method can choose it."""
ROUNDING = {"means": 5e-7, "quats": 2e-6, "scales": 5e-9, "opacities": 5e-7, "sh": 2e-6}
"""Largest differences: metres, components of a unit quaternion, metres, 0..1, coefficients."""


@pytest.mark.parametrize("method", METHODS)
@torch.no_grad()
@pytest.mark.unchecked
def test_networks_may_round_differently_and_nothing_more(method: str, tmp_path: Path) -> None:
    """Matrix products of torch and numpy do. docs/avatar_file.md has the exact rule."""
    model, camera = load_face_model("anny"), view(256)
    face = talking_face(model)
    torch.manual_seed(0)
    config: Any = plain_config(method)
    if "points" in {field.name for field in fields(config)}:
        config = replace(config, points=POINTS)
    avatar = METHODS[method].avatar(config, model, face)
    sizes = {"weight": 0.02, "feature": 0.3, "log_scales": 0.3, "means": 0.001}
    for index, (name, parameter) in enumerate(avatar.named_parameters()):
        size = next((size for part, size in sizes.items() if part in name), 0.1)
        parameter.add_(size * noise(100 + index, *parameter.shape))
    runtime.write_portable(tmp_path / "a.mien", make_portable(avatar, camera, "someone"))
    portable = runtime.load(tmp_path / "a.mien")
    gaussians = avatar.pose(face).gaussians
    for timestep in range(TIMESTEPS):
        now, theirs = face[timestep], gaussians.timestep(timestep)
        pose = (now.expression, now.joints, now.head_rotation, now.head_translation)
        ours = portable.pose(*(tensor[0].numpy() for tensor in pose))
        for name, bound in ROUNDING.items():
            found, expected = getattr(ours, name), getattr(theirs, name).numpy()
            if name == "quats":
                found, expected = (q / np.linalg.norm(q, axis=-1, keepdims=True) for q in (found, expected))
            assert np.abs(found - expected).max() <= bound, name
        # The same Gaussians give the same bytes, so differences arise before rendering.
        same = Gaussians(*(getattr(theirs, name).numpy() for name in (*ROUNDING, "T_world_local")))
        picture = rasterize(theirs, camera, torch.ones(3)).image.numpy()
        assert portable.render(same)[0].tobytes() == picture.tobytes()
        difference = np.abs(portable.render(ours)[0] - picture).max(-1)
        assert picture.std() > 0.05, "the noise hides the head: tensors of metres have `means` in their name"
        assert (difference > EQUAL).mean() <= 1e-3
        assert difference.max() <= 1 / 255
