"""Avatars without torch differ from what training renders in nothing but the rounding of networks."""

import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mien import runtime
from mien.avatar import DEFAULT_METHOD, METHODS, Avatar, GaussianAvatars, MethodConfig, make_portable
from mien.camera import Camera, camera_from_fov
from mien.face import FaceModel, FaceParams, load_face_model
from mien.render import rasterize
from mien.runtime import Gaussians
from plain_settings import plain_config

EQUAL = 1e-5
GAUSSIANS, SIZE, TIMESTEPS = 30_000, 512, 2
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
    store = avatar.gaussian_store()
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
    model, camera = load_face_model("anny"), view(SIZE)
    face = talking_face(model)
    avatar = grown_avatar(model, face, plain_config(DEFAULT_METHOD, **colors), GAUSSIANS)
    assert len(avatar.gaussian_store()) == GAUSSIANS
    expected = rasterize(avatar.pose(face).gaussians, [camera] * TIMESTEPS, torch.ones(3))
    found = rendered_without_torch(avatar, face, camera, tmp_path)
    assert found["image"].shape == (TIMESTEPS, SIZE, SIZE, 3)
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
