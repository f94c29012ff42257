"""Nothing of a held-out frame reaches an avatar: neither its pixels nor how its face was tracked."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from mien.avatar import METHODS, MethodConfig
from mien.face import FaceParams
from mien.training import Sequence, TrainSettings, train
from plain_settings import plain_config
from toy_scene import toy_sequence

TIMESTEPS, SHOWN = 10, 8
SETTINGS = TrainSettings(steps=6, split="tail", checkpoint_every=12)
pytestmark = pytest.mark.unchecked
SMALL: dict[str, dict[str, Any]] = {
    "gaussian_avatars": {},
    "headgas": {"points": 60, "judged_expressions": 4, "directions": 3},
    "mono_gaussian_avatar": {"points": 60, "max_points": 120, "pretraining": 5},
    "point_avatar": {"points": 60, "max_points": 120, "pretraining": 5},
    "textured_mesh": {"surfels": 300},
}


def absurd(sequence: Sequence) -> Sequence:
    """The same sequence, whose held-out frames have other faces, other pixels and another matte."""
    face = sequence.tracking.face
    shift = torch.zeros(TIMESTEPS, 1)
    shift[SHOWN:] = 3.0
    strange = FaceParams(
        identity=face.identity,
        expression=face.expression + shift,
        joints=face.joints + shift[..., None],
        head_rotation=face.head_rotation - shift,
        head_translation=face.head_translation + 10 * shift,
        vertex_offsets=face.vertex_offsets,
    )
    images, scoring = sequence.capture.images.copy(), sequence.scoring.copy()
    images[SHOWN:], scoring[SHOWN:] = 255 - images[SHOWN:], 0
    return replace(
        sequence,
        tracking=replace(sequence.tracking, face=strange),
        capture=replace(sequence.capture, images=images),
        scoring=scoring,
    )


@pytest.mark.parametrize("plain", [True, False], ids=["plain", "default"])
@pytest.mark.parametrize("method", SMALL)
def test_held_out_frames_change_no_byte_of_an_avatar(method: str, plain: bool, tmp_path: Path) -> None:
    config: MethodConfig = plain_config(method) if plain else METHODS[method].config()
    config = replace(config, **SMALL[method])
    face_model, sequence = toy_sequence(TIMESTEPS, 32)
    avatars = [
        train([one], face_model, config, SETTINGS, tmp_path / str(index))
        for index, one in enumerate((sequence, absurd(sequence)))
    ]
    first, second = (avatar.state_dict() for avatar in avatars)
    assert first.keys() == second.keys()
    for name, tensor in first.items():
        assert torch.equal(tensor, second[name]), name
    for name, tensor in avatars[0].subject.tensors().items():
        assert torch.equal(tensor, avatars[1].subject.tensors()[name]), name
    assert avatars[0].filmed is not None
    assert avatars[1].filmed is not None
    for one, other in zip(vars(avatars[0].filmed).values(), vars(avatars[1].filmed).values(), strict=True):
        assert torch.equal(torch.as_tensor(one), torch.as_tensor(other))


def test_timesteps_that_are_left_out_change_no_byte_of_an_avatar(tmp_path: Path) -> None:
    """`mien analyze --parts diversity` trains on a part of the timesteps, and calls the others not valid."""

    def part(sequence: Sequence) -> Sequence:
        valid = sequence.tracking.valid.clone()
        valid[SHOWN:] = False
        return replace(sequence, tracking=replace(sequence.tracking, valid=valid))

    face_model, sequence = toy_sequence(TIMESTEPS, 32)
    config, settings = plain_config("gaussian_avatars"), replace(SETTINGS, split="none")
    first, second = (
        train([part(one)], face_model, config, settings, tmp_path / str(index)).state_dict()
        for index, one in enumerate((sequence, absurd(sequence)))
    )
    assert all(torch.equal(tensor, second[name]) for name, tensor in first.items())
