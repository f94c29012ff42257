"""The perceptual loss: its features, its crops and its steps."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn.functional import conv2d, interpolate, max_pool2d

import train_toy
from mien.avatar import PerceptualLoss, Photometric
from mien.errors import UserError
from mien.face import FaceModel
from mien.perceptual import load_training_features
from mien.perceptual.weights import weights_path
from mien.render.rendering import Rendering
from mien.training import Sequence, TrainSettings, read_curves, train
from mien.training.footage.frames import crop_random
from mien.training.footage.sequence import Target, Targets
from mien.training.losses import drawn_crop, perceptual_goal, perceptual_loss, person_box
from toy_scene import toy_sequence
from train_toy import silence


def some_picture(seed: int, side: int = 32) -> torch.Tensor:
    coarse = torch.rand(1, 3, side // 4, side // 4, generator=torch.Generator().manual_seed(seed))
    return interpolate(coarse, (side, side), mode="bilinear")[0].permute(1, 2, 0).contiguous()


def by_torchs_layers(image: torch.Tensor, target: torch.Tensor) -> float:
    """Return the distance by two blocks, with torch's own pooling and the blur kernel from the file."""
    state = torch.load(weights_path("st-lpips-vgg"), map_location="cpu", weights_only=True)

    def maps(picture: torch.Tensor) -> list[torch.Tensor]:
        values = (picture.permute(2, 0, 1)[None] * 2 - 1 - state["scaling_layer.shift"]) / state["scaling_layer.scale"]
        found = []
        for slice_, layers in ((1, (0, 2)), (2, (6, 8))):
            if slice_ == 2:
                values = conv2d(max_pool2d(values, 2, 1), state["net.slice2.5.filt"], stride=2, groups=64)
            for layer in layers:
                name = f"net.slice{slice_}.{layer}"
                values = conv2d(values, state[f"{name}.weight"], state[f"{name}.bias"], padding=1).relu()
            found.append(values / values.norm(dim=1, keepdim=True).clamp_min(1e-5))
        return found

    pairs = zip(maps(image), maps(target), strict=True)
    factors = (state[f"lin{index}.model.1.weight"] for index in range(2))
    return sum(float(conv2d((a - b).square(), factor).mean()) for (a, b), factor in zip(pairs, factors, strict=True))


def test_distance_is_that_of_the_networks_layers() -> None:
    features = load_training_features(blocks=2)
    image, target = some_picture(0), some_picture(1)
    assert float(features(target, target)) == 0
    assert float(features(image, target)) == pytest.approx(by_torchs_layers(image, target), rel=1e-3)


def some_target(parts: tuple[tuple[int, int, int, int], ...], height: int = 60, width: int = 80) -> Target:
    picture = torch.zeros(height, width, 3, dtype=torch.uint8)
    return Target(picture, picture[..., 0], (10, 5, 50, 50), torch.ones(3), parts)


def test_crops_lie_in_the_picture_and_visit_every_part() -> None:
    target, settings = some_target(((20, 10, 30, 10), (70, 50, 8, 8))), TrainSettings()
    crops, again = ([drawn_crop(target, 24, crop_random(settings, step)) for step in range(200)] for _ in range(2))
    assert crops == again
    assert all(x >= 0 and y >= 0 and x + 24 <= 80 and y + 24 <= 60 for x, y, _, _ in crops)
    assert {crop[2:] for crop in crops} == {(24, 24)}
    near_mouth = sum(crop[:2] == (56, 36) for crop in crops)
    assert 30 < near_mouth < 110, "a third of the crops is drawn around the part at the corner"
    assert len(set(crops)) > 80, "the others differ"
    assert drawn_crop(target, 512, crop_random(settings, 0)) == (0, 0, 80, 60)


def loss_of(width: int, settings: PerceptualLoss) -> tuple[float, torch.Size]:
    """The loss of a gray picture of height 64 in place of a darker one, and the size of what is compared."""
    image, radii = torch.full((64, width, 3), 0.5), torch.zeros(1, dtype=torch.int32)
    rendering = Rendering(image, torch.ones(64, width), radii, torch.zeros(1, 2))
    target = replace(some_target((), 64, width), picture=torch.full((64, width, 3), 90, dtype=torch.uint8))
    goal = perceptual_goal(target, settings, crop_random(TrainSettings(), 0))
    return float(perceptual_loss(rendering, goal, settings)), target.picture[goal.crop].shape


def whole(side: int) -> float:
    """The distance of a square of both grays."""
    return float(load_training_features()(torch.full((side, side, 3), 0.5), torch.full((side, side, 3), 90 / 255)))


def test_weight_of_a_pixel_is_that_of_the_whole_picture() -> None:
    """The same crop counts half as much in a picture that is twice as large."""
    losses = [loss_of(width, PerceptualLoss(weight=2.0, crop=32))[0] for width in (64, 128)]
    assert losses == pytest.approx([0.5 * whole(32), 0.25 * whole(32)], rel=1e-5)
    # A picture of 128 x 64 has no square of 100 pixels, so the crop is 100 wide and 64 high.
    assert loss_of(128, PerceptualLoss(crop=100))[1] == (64, 100, 3)


def test_the_whole_person_counts_fully() -> None:
    """The box of the person is compared, which is never too small. Its share of the picture does not matter."""
    found = [loss_of(width, PerceptualLoss(weight=2.0, region="person", crop=16)) for width in (64, 128)]
    assert found == [(pytest.approx(2.0 * whole(50), rel=1e-5), (50, 50, 3))] * 2
    boxes = {(10, 5, 50, 40): (10, 5, 50, 40), (0, 0, 0, 0): (0, 0, 16, 16), (78, 59, 2, 1): (64, 44, 16, 16)}
    assert {box: person_box(replace(some_target(()), box=box)) for box in boxes} == boxes


CONFIG = replace(
    train_toy.CONFIG, photometric=Photometric(part_weight=1.0, perceptual=PerceptualLoss(0.5, 0.1, 2, 16, 1))
)


@pytest.fixture(scope="module")
def scene() -> tuple[FaceModel, Sequence]:
    """The toy head has lips: its triangles in front and below."""
    face_model, sequence = toy_sequence(timesteps=5, size=32)
    middle = face_model.template[face_model.faces].mean(1)
    lips = (middle[:, 2] > 0.05) & (middle[:, 1] < 0)
    return replace(face_model, region_names=("skin", "lips"), face_regions=lips.long()), sequence


def test_targets_have_parts_if_they_are_asked_for(scene: tuple[FaceModel, Sequence]) -> None:
    sequence, white = toy_sequence(timesteps=2, size=64)[1], np.full(3, 255, np.uint8)
    none, (mouth,), (half,) = (
        Targets(sequence, size, face_model=model).target(0, 0, white, keep=False).parts
        for size, model in ((0, None), (0, scene[0]), (32, scene[0]))
    )
    assert none == ()
    assert all(abs(2 * small - large) <= 1 for small, large in zip(half, mouth, strict=True))


@pytest.mark.unchecked
def test_the_loss_is_recorded_at_its_steps(scene: tuple[FaceModel, Sequence], tmp_path: Path) -> None:
    for name, config in (("whole", CONFIG), ("plain", train_toy.CONFIG)):
        train([scene[1]], scene[0], config, replace(train_toy.SETTINGS, steps=12), tmp_path / name, silence)
    curves = read_curves(tmp_path / "whole")
    assert [value > 0 for value in curves["perceptual"].tolist()] == [True, False] * 2, "0 at steps without it"
    assert "perceptual" not in read_curves(tmp_path / "plain")
    for name in ("avatar/avatar.safetensors", "face_track.safetensors"):
        assert (tmp_path / "plain" / name).read_bytes() != (tmp_path / "whole" / name).read_bytes(), name


def test_missing_features_are_told_before_the_run_begins(scene, tmp_path, monkeypatch) -> None:
    load_training_features.cache_clear()
    monkeypatch.setitem(sys.modules, "stlpips_pytorch", None)
    with pytest.raises(UserError, match="pip install stlpips-pytorch"):
        train([scene[1]], scene[0], CONFIG, train_toy.SETTINGS, tmp_path / "run", silence)
    assert not (tmp_path / "run").exists()
