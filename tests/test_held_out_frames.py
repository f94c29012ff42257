"""Nothing of a held-out frame reaches an avatar: neither its pixels nor how its face was tracked."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from mien.avatar.methods import METHODS
from mien.avatar.settings import MethodConfig
from mien.training import TrainSettings, train
from mien.training.footage.sequence import Sequence
from mien.training.run import read_face_track
from plain_settings import plain_config
from toy_scene import toy_sequence

TIMESTEPS, SHOWN = 10, 8
SETTINGS = TrainSettings(steps=6, split="tail", checkpoint_every=12)
pytestmark = pytest.mark.unchecked
SMALL: dict[str, dict[str, Any]] = {
    "gaussian_avatars": {}, "headgas": {"points": 60, "judged_expressions": 4, "directions": 3},
    "mono_gaussian_avatar": {"points": 60, "max_points": 120, "pretraining": 5},
    "point_avatar": {"points": 60, "max_points": 120, "pretraining": 5}, "textured_mesh": {"surfels": 300},
}  # fmt: skip


def absurd(sequence: Sequence) -> Sequence:
    """The same sequence, whose held-out frames have other faces, other pixels and another matte."""
    face = sequence.tracking.face
    shift = torch.zeros(TIMESTEPS, 1)
    shift[SHOWN:] = 3.0
    strange = replace(
        face, expression=face.expression + shift, joints=face.joints + shift[..., None],
        head_rotation=face.head_rotation - shift, head_translation=face.head_translation + 10 * shift,
    )  # fmt: skip
    images, scoring = sequence.capture.images.copy(), sequence.scoring.copy()
    images[SHOWN:], scoring[SHOWN:] = 255 - images[SHOWN:], 0
    tracking, capture = replace(sequence.tracking, face=strange), replace(sequence.capture, images=images)
    return replace(sequence, tracking=tracking, capture=capture, scoring=scoring)


@pytest.mark.parametrize("plain", [True, False], ids=["plain", "default"])
@pytest.mark.parametrize("method", [*SMALL, "timesteps that are left out"])
def test_held_out_frames_change_no_byte_of_an_avatar(method: str, plain: bool, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("mien.training.trainer.STEADY_EVERY", 2)
    face_model, sequence = toy_sequence(TIMESTEPS, 32)
    pair, settings = (sequence, absurd(sequence)), SETTINGS
    if method not in SMALL:
        # `mien analyze --parts diversity` trains on a part of the timesteps, and calls the others not valid.
        method, settings, valid = "gaussian_avatars", replace(SETTINGS, split="none"), torch.arange(TIMESTEPS) < SHOWN
        pair = tuple(replace(one, tracking=replace(one.tracking, valid=valid)) for one in pair)
    config: MethodConfig = plain_config(method) if plain else METHODS[method].config()
    config = replace(config, **SMALL[method])
    first, second = (
        train([one], face_model, config, settings, tmp_path / str(index)) for index, one in enumerate(pair)
    )
    face, other = (read_face_track(tmp_path / str(index), face_model)[:SHOWN] for index in range(2))
    for ours, theirs in (
        (first.state_dict(), second.state_dict()), (first.subject.tensors(), second.subject.tensors()),
        (vars(first.filmed), vars(second.filmed)), (face.tensors(), other.tensors()),
    ):  # fmt: skip
        assert ours.keys() == theirs.keys()
        for name, one in ours.items():
            assert torch.equal(torch.as_tensor(one), torch.as_tensor(theirs[name])), name
