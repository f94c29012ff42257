"""Avatars: functions from face parameters to Gaussians, one file a method."""

from mien.avatar.avatar import (
    TRAINED,
    Avatar,
    FaceTuning,
    MethodConfig,
    ParameterGroup,
    Photometric,
    Posed,
    Progress,
    Rate,
    move_avatar,
    network_group,
    neutral_of,
    store_group,
)
from mien.avatar.baked import BakedAvatar, pose_baked
from mien.avatar.density import (
    DensityControl,
    FixedDensity,
    GradientDensity,
    GradientSettings,
    RefillDensity,
    RefillSettings,
)
from mien.avatar.files import load_avatar, write_avatar
from mien.avatar.gaussian_avatars import GaussianAvatars, GaussianAvatarsConfig
from mien.avatar.headgas import HeadGas, HeadGasConfig
from mien.avatar.methods import METHODS, Method, method_named, method_of
from mien.avatar.mono_gaussian_avatar import MonoGaussianAvatar, MonoGaussianAvatarConfig
from mien.avatar.portable import make_portable, read_baked
from mien.avatar.store import GaussianStore, Moments

__all__ = [
    "METHODS",
    "TRAINED",
    "Avatar",
    "BakedAvatar",
    "DensityControl",
    "FaceTuning",
    "FixedDensity",
    "GaussianAvatars",
    "GaussianAvatarsConfig",
    "GaussianStore",
    "GradientDensity",
    "GradientSettings",
    "HeadGas",
    "HeadGasConfig",
    "Method",
    "MethodConfig",
    "Moments",
    "MonoGaussianAvatar",
    "MonoGaussianAvatarConfig",
    "ParameterGroup",
    "Photometric",
    "Posed",
    "Progress",
    "Rate",
    "RefillDensity",
    "RefillSettings",
    "load_avatar",
    "make_portable",
    "method_named",
    "method_of",
    "move_avatar",
    "network_group",
    "neutral_of",
    "pose_baked",
    "read_baked",
    "store_group",
    "write_avatar",
]
