"""The list of methods. A new method adds one line here (CONTRIBUTING.md, "Add a method").

This file needs no torch, because the command line lists the methods' settings and checks them.
"""

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING

from mien.avatar.settings import MethodConfig
from mien.errors import UserError

if TYPE_CHECKING:
    from mien.avatar.avatar import Avatar


@dataclass(frozen=True)
class Method:
    """A method: the class of its avatars, and its settings. Both are imported at their first use."""

    avatar_class: str
    """"MODULE:CLASS"; see `avatar`."""
    settings_module: str = ""
    """The module that holds `PRESETS`. Default: the module of the class. A separate one that does not import torch
    keeps `--help` and the checks of options fast."""

    @property
    def presets(self) -> Mapping[str, MethodConfig]:
        """Settings for the presets of `mien.training.PRESETS` that the method has, all of one class."""
        return self._settings().PRESETS

    @property
    def preset_steps(self) -> Mapping[str, int]:
        """Number of steps of a run, for the presets for which the method has its own number (`PRESET_STEPS`)."""
        return getattr(self._settings(), "PRESET_STEPS", {})

    @property
    def config(self) -> type[MethodConfig]:
        """The class of the method's settings."""
        return type(self.presets["standard"])

    def _settings(self) -> ModuleType:
        return importlib.import_module(self.settings_module or self.avatar_class.split(":")[0])

    @property
    def avatar(self) -> "type[Avatar]":
        """The class of the method's avatars. Its arguments are (config, face_model, face)."""
        module, name = self.avatar_class.split(":")
        return getattr(importlib.import_module(module), name)


METHODS = {
    "gaussian_avatars": Method(
        "mien.avatar.gaussian_avatars.avatar:GaussianAvatars", "mien.avatar.gaussian_avatars.settings"
    ),
    "headgas": Method("mien.avatar.headgas.avatar:HeadGas", "mien.avatar.headgas.settings"),
    "mono_gaussian_avatar": Method(
        "mien.avatar.mono_gaussian_avatar.avatar:MonoGaussianAvatar", "mien.avatar.mono_gaussian_avatar.settings"
    ),
}
"""All methods by name. A method whose settings import torch comes last: looking for the method of a config goes
through the settings in this order."""

DEFAULT_METHOD = "gaussian_avatars"
"""Method of a run that names none."""


def method_named(name: str) -> Method:
    """The method of a name.

    Raises:
        UserError: there is no method of that name.
    """
    if name not in METHODS:
        raise UserError(f"no method {name!r}; the methods are {', '.join(METHODS)}")
    return METHODS[name]


def method_of(config: MethodConfig) -> str:
    """The name of the method that a config belongs to."""
    return next(name for name, method in METHODS.items() if method.config is type(config))
