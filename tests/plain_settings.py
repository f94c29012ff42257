"""Plain settings of methods and runs: small, fast, with open sides, and without what the defaults add to the papers.
Tests of a formula or a mechanism use them, so that a change of a default does not change what they check."""

from dataclasses import replace
from typing import Any

from mien.avatar import GaussianAvatarsConfig
from mien.avatar.gaussian_avatars.settings import as_published
from mien.avatar.methods import METHODS
from mien.avatar.mono_gaussian_avatar.settings import MonoGaussianAvatarConfig
from mien.avatar.point_avatar.settings import PointAvatarConfig
from mien.avatar.settings import FaceTuning, MethodConfig, Rate
from mien.avatar.textured_mesh.settings import TexturedMeshConfig
from mien.training import TrainSettings


def plain_run(**changes: Any) -> TrainSettings:
    """Settings of a run that trains every side on what was filmed, over white."""
    plain = TrainSettings(background="white", edges="filmed", inside="free", mesh="tracked", unseen="trained")
    return replace(plain, **changes)


def plain_config(method: str, **changes: Any) -> MethodConfig:
    """Plain settings of a method. Those of a method without any here are its defaults."""
    plain = {
        "gaussian_avatars": plain_gaussian_avatars, "mono_gaussian_avatar": plain_mono_gaussian_avatar,
        "point_avatar": plain_point_avatar, "textured_mesh": plain_textured_mesh,
    }  # fmt: skip
    return replace(plain.get(method, METHODS[method].config)(), **changes)


def plain_gaussian_avatars(**changes: Any) -> GaussianAvatarsConfig:
    """The published method."""
    return replace(as_published(), **changes)


def plain_mono_gaussian_avatar(**changes: Any) -> MonoGaussianAvatarConfig:
    """Some hundred points that start on a sphere, as in the paper."""
    plain = MonoGaussianAvatarConfig(
        face_tuning=FaceTuning(begin=0.1), frames_per_step=1, start="sphere", pretraining=0, points=400,
        max_points=10_000, first_epoch=0, epochs=100, network_rate=Rate(1e-3, 1e-4), own_rate=Rate(0.0),
    )  # fmt: skip
    return replace(plain, **changes)


def plain_point_avatar(**changes: Any) -> PointAvatarConfig:
    """Some hundred points that start on a sphere, as in the paper."""
    plain = PointAvatarConfig(
        start="sphere", pretraining=0, points=200, max_points=1_000, epochs=20, growth_epochs=4, frames_per_step=1
    )
    return replace(plain, **changes)


def plain_textured_mesh(**changes: Any) -> TexturedMeshConfig:
    """Some hundred surfels."""
    return replace(TexturedMeshConfig(surfels=500, smoothing=2), **changes)
