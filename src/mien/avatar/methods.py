"""The list of methods. A new method adds one line here.

Settings are imported at once, so that the command line can list and check them. Avatars need torch and are imported at
their first use.
"""

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from mien.avatar import gaussian_avatars_settings, headgas_settings, mono_gaussian_avatar_settings
from mien.avatar.settings import MethodConfig
from mien.errors import UserError

if TYPE_CHECKING:
    from mien.avatar.avatar import Avatar


@dataclass(frozen=True)
class Method:
    """A method: its settings for each preset, and the class of its avatars."""

    presets: Mapping[str, MethodConfig]
    """Settings for each preset of `mien.training.PRESETS`, all of one class."""
    avatar_class: str
    """"MODULE:CLASS"; see `avatar`."""

    @property
    def config(self) -> type[MethodConfig]:
        """The class of the method's settings."""
        return type(self.presets["standard"])

    @property
    def avatar(self) -> "type[Avatar]":
        """The class of the method's avatars. Its arguments are (config, face_model, face)."""
        module, name = self.avatar_class.split(":")
        return getattr(importlib.import_module(module), name)


METHODS = {
    "gaussian_avatars": Method(gaussian_avatars_settings.PRESETS, "mien.avatar.gaussian_avatars:GaussianAvatars"),
    "headgas": Method(headgas_settings.PRESETS, "mien.avatar.headgas:HeadGas"),
    "mono_gaussian_avatar": Method(
        mono_gaussian_avatar_settings.PRESETS, "mien.avatar.mono_gaussian_avatar:MonoGaussianAvatar"
    ),
}


def method_named(name: str) -> Method:
    """The method of a name.

    Raises:
        UserError: there is no method of that name.
    """
    if name not in METHODS:
        raise UserError(f"no method {name!r}; there are: {', '.join(METHODS)}")
    return METHODS[name]


def method_of(config: MethodConfig) -> str:
    """The name of the method that a config belongs to."""
    return next(name for name, method in METHODS.items() if method.config is type(config))
