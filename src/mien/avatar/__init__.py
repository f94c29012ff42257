"""Avatars: functions from face parameters to Gaussians. Each method has one file, and one for its settings."""

from typing import TYPE_CHECKING

from mien.lazy import lazy_names

if TYPE_CHECKING:
    from mien.avatar.avatar import (
        Avatar,
        Extras,
        ParameterGroup,
        Posed,
        Pretraining,
        frozen,
        move_avatar,
        network_group,
        neutral_of,
        store_group,
    )
    from mien.avatar.baking import as_array, bake_rig, make_portable
    from mien.avatar.bound_surface import BoundSurface, SurfacePrior
    from mien.avatar.density import DensityControl, FixedDensity, GradientDensity, RefillDensity
    from mien.avatar.files import load_avatar, write_avatar
    from mien.avatar.filmed import measure_filmed
    from mien.avatar.gaussian_avatars.avatar import GaussianAvatars
    from mien.avatar.gaussian_avatars.settings import GaussianAvatarsConfig
    from mien.avatar.headgas.avatar import HeadGas
    from mien.avatar.headgas.settings import HeadGasConfig
    from mien.avatar.methods import (
        DEFAULT_METHOD,
        METHODS,
        Method,
        has_method,
        method_named,
        method_names,
        method_of,
    )
    from mien.avatar.mono_gaussian_avatar.avatar import MonoGaussianAvatar
    from mien.avatar.mono_gaussian_avatar.settings import MonoGaussianAvatarConfig
    from mien.avatar.ops.activation import sigmoid
    from mien.avatar.point_avatar.avatar import PointAvatar
    from mien.avatar.point_avatar.settings import PointAvatarConfig
    from mien.avatar.schedules import TRAINED, Progress, Rate
    from mien.avatar.settings import (
        DensityRules,
        FaceTuning,
        GradientSettings,
        MethodConfig,
        PerceptualLoss,
        Photometric,
        RefillSettings,
    )
    from mien.avatar.store import GaussianStore, Moments
    from mien.avatar.textured_mesh.avatar import TexturedMesh
    from mien.avatar.textured_mesh.settings import TexturedMeshConfig
else:
    __getattr__, __dir__ = lazy_names(__name__, __file__)

__all__ = [
    "DEFAULT_METHOD",
    "METHODS",
    "TRAINED",
    "Avatar",
    "BoundSurface",
    "DensityControl",
    "DensityRules",
    "Extras",
    "FaceTuning",
    "FixedDensity",
    "GaussianAvatars",
    "GaussianAvatarsConfig",
    "GaussianStore",
    "GradientDensity",
    "GradientSettings",
    "HeadGas",
    "HeadGasConfig",
    "Pretraining",
    "Method",
    "MethodConfig",
    "Moments",
    "MonoGaussianAvatar",
    "MonoGaussianAvatarConfig",
    "ParameterGroup",
    "PerceptualLoss",
    "Photometric",
    "PointAvatar",
    "PointAvatarConfig",
    "Posed",
    "SurfacePrior",
    "TexturedMesh",
    "TexturedMeshConfig",
    "Progress",
    "Rate",
    "RefillDensity",
    "RefillSettings",
    "as_array",
    "bake_rig",
    "frozen",
    "has_method",
    "load_avatar",
    "make_portable",
    "measure_filmed",
    "method_named",
    "method_names",
    "method_of",
    "move_avatar",
    "network_group",
    "neutral_of",
    "sigmoid",
    "store_group",
    "write_avatar",
]
