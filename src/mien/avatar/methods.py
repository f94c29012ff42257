"""The methods there are: a new one is one line here."""

from dataclasses import dataclass

from mien.avatar.avatar import Avatar, MethodConfig
from mien.avatar.gaussian_avatars import GaussianAvatars, GaussianAvatarsConfig
from mien.avatar.headgas import HeadGas, HeadGasConfig
from mien.avatar.mono_gaussian_avatar import MonoGaussianAvatar, MonoGaussianAvatarConfig
from mien.errors import UserError


@dataclass(frozen=True)
class Method:
    """A method: its settings, and the class of its avatars, which is called with (config, face_model, face)."""

    config: type[MethodConfig]
    avatar: type[Avatar]


METHODS = {
    "gaussian_avatars": Method(GaussianAvatarsConfig, GaussianAvatars),
    "headgas": Method(HeadGasConfig, HeadGas),
    "mono_gaussian_avatar": Method(MonoGaussianAvatarConfig, MonoGaussianAvatar),
}


def method_named(name: str) -> Method:
    """A method by its name.

    Raises:
        UserError: there is none of that name.
    """
    if name not in METHODS:
        raise UserError(f"no method {name!r}; there are: {', '.join(METHODS)}")
    return METHODS[name]


def method_of(config: MethodConfig) -> str:
    """The name of the method that a config belongs to."""
    return next(name for name, method in METHODS.items() if method.config is type(config))
