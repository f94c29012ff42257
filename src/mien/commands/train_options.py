"""The options of training that `create`, `train` and `demo` share: the method, the preset, and settings in detail."""

import argparse
import difflib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from mien.avatar.methods import DEFAULT_METHOD, has_method, method_named, method_names
from mien.avatar.settings import MethodConfig
from mien.disk.config import no_such_setting, overlay, shown
from mien.disk.reading import parse_json, read_bytes
from mien.errors import UserError
from mien.machine.devices import DeviceName, check_device
from mien.machine.progress import say
from mien.training.settings import PRESETS, Split, TrainSettings, doubly_held_out
from mien.training.settings.splits import NAMED_SPLIT

if TYPE_CHECKING:
    PresetName = str
else:
    PresetName = Literal[tuple(PRESETS)]

_TAKEN = ("method", "settings")
_NOT_TAKEN = ("format", "version", "checksum", "data", "mien", "command_line")
"""Other entries of a run's config.json: what it was trained on, by which version, with which command."""


def listed_methods(about: str) -> Callable[[], str]:
    """A mark that describes an option by `about` and the names of all methods, also those of other packages."""
    return lambda: f"{about}: {', '.join(method_names())} (compared in docs/results.md)."


def check_method(option: str, name: str) -> None:
    """Check that there is a method of a name."""
    if not has_method(name):
        names = ", ".join(method_names())
        raise UserError(f"{option}: give one of {names} instead of {name!r}, or install the package that adds it")


Elsewhere = Annotated[Any, tyro.conf.Fixed, tyro.conf.Suppress]
"""A setting that this command has no option for."""


@dataclass(frozen=True)
class Details(TrainSettings):
    """Settings of a training run. Losses, rates and density control are settings of the method."""

    # These have options without a prefix.
    steps: Elsewhere = None
    split: Elsewhere = None
    background: Elsewhere = None
    seed: Elsewhere = None
    device: Elsewhere = None
    held_out_sequences: Elsewhere = None
    held_out_cameras: Elsewhere = None


@dataclass(frozen=True)
class ConfigFile:
    """The settings that a file asks for. Their names and values are not checked yet."""

    path: Path
    method: str | None
    """Name of the method, if the file gives one."""
    method_changes: Mapping[str, Any]
    settings_changes: Mapping[str, Any]
    sequences: tuple[str, ...]
    """Sequences that the run of this file was trained on. They are not taken over."""


@dataclass(frozen=True)
class TrainOptions:
    """The options of training. Make them by `of` or `chosen`, with the defaults of a method and a preset."""

    method: Annotated[str, listed_methods("Method that makes the avatar")]
    config: Path | None
    """A .json with settings, for example the config.json of a run to repeat (docs/settings.md). Options override the
    file, and the file overrides the preset."""
    preset: PresetName
    """How thorough the training is. draft has fewer steps; standard has the defaults; fine has twice as many steps, for
    0.1 to 0.7 dB; paper repeats the method's paper in days on a processor, and paper-cpu does so in a small size, if
    the method has them (docs/paper_preset.md)."""
    split: Split
    """Frames held out for scoring: every fifth block of 10 frames (blocks), the last 20 % (tail), or nothing (none).
    gaussian-avatars: the sequence and the camera that the paper holds out, for its subjects (docs/using.md)."""
    background: Literal["white", "mixed", "random", "auto"]
    """Background of the training pictures; mixed is random in one of ten steps. auto: mixed where sides are filled,
    else white."""
    steps: int
    """Number of optimiser steps, over which all schedules stretch."""
    seed: int
    """Seed of the random numbers. The same seed, data and settings give the same bytes."""
    hold_out: tuple[str, ...]
    """Whole sequences that are scored but not trained on."""
    hold_out_cameras: tuple[str, ...]
    """Ids of cameras that are scored but not trained on, for captures with several cameras."""
    device: DeviceName
    """Device for training. cpu: always the same bytes; cuda: an NVIDIA GPU, through gsplat (docs/using.md says how to
    install it); auto: a GPU if there is one. A run may resume on another device."""
    training: Annotated[Details, tyro.conf.FlagConversionOff]
    method_settings: Annotated[MethodConfig, tyro.conf.arg(name="method"), tyro.conf.FlagConversionOff,
                               tyro.conf.AvoidSubcommands]  # fmt: skip
    subject: str | None = None
    """Subject of --split gaussian-avatars, for example 306 (default: the number in the workspace's name)."""

    @classmethod
    def of(
        cls, method: str = DEFAULT_METHOD, preset: str = "standard", file: ConfigFile | None = None
    ) -> "TrainOptions":
        """The options of a method under a preset, changed by a file."""
        settings, config = PRESETS[preset].settings_of(method), PRESETS[preset].config(method)
        if file is not None:
            settings = overlay(settings, file.settings_changes, f"{file.path}: settings", "a run")
            config = overlay(config, file.method_changes, f"{file.path}: method", method)
        return cls(
            method=method,
            config=None if file is None else file.path,
            preset=preset,
            split=settings.split,
            background=settings.background,
            steps=settings.steps,
            seed=settings.seed,
            hold_out=settings.held_out_sequences,
            hold_out_cameras=settings.held_out_cameras,
            device=settings.device,
            training=Details(**vars(settings)),
            method_settings=config,
        )

    @classmethod
    def chosen(cls, arguments: Sequence[str]) -> "TrainOptions":
        """The options under the method, the preset and the file that a command line names."""
        parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
        for name in ("method", "preset", "config"):
            parser.add_argument(f"--{name}", nargs="?")
        typed, _ = parser.parse_known_args(list(arguments))
        if typed.method is not None:
            check_method("--method", typed.method)
        file = None if typed.config is None else read_config_file(Path(typed.config))
        if file and file.method and typed.method not in (None, file.method):
            raise UserError(
                f"--config {file.path}: has settings of {file.method}, but --method asks for {typed.method}; leave "
                '--method out, or give a file that has only "settings"'
            )
        method = typed.method or (file.method if file else None) or DEFAULT_METHOD
        return cls.of(method, typed.preset if typed.preset in PRESETS else "standard", file)

    def by_preset(self) -> "dict[str, TrainOptions]":
        """The options by each preset of the method, which the help shows beside the defaults."""
        options = {preset: self.of(self.method, preset) for preset in method_named(self.method).presets}
        return {preset: replace(each, preset=self.preset, config=self.config) for preset, each in options.items()}

    def check(self) -> None:
        """Check before any work that all settings are valid."""
        self.settings()
        self.method_config()

    def settings(self) -> TrainSettings:
        """The settings of the run."""
        check_device(self.device)
        if self.subject is not None and self.split != NAMED_SPLIT:
            raise UserError(f"--subject {self.subject}: is for --split {NAMED_SPLIT}; give that too, or leave it out")
        main = {name: getattr(self, name) for name in ("split", "background", "seed", "steps", "device")}
        main["held_out_sequences"] = tuple(sorted(set(self.hold_out)))
        main["held_out_cameras"] = tuple(sorted(set(self.hold_out_cameras)))
        settings = TrainSettings(**{**vars(self.training), **main})
        settings.check()
        return settings

    def method_config(self) -> MethodConfig:
        """The method's settings."""
        self.method_settings.check()
        return self.method_settings

    def say_what_is_ignored(self) -> None:
        """Report the entry of the file that the run does not use (the sequences of its own run), and doubled splits."""
        doubled = doubly_held_out(self.settings())
        if doubled is not None:
            say(f"warning: {doubled}")
        sequences = read_config_file(self.config).sequences if self.config else ()
        if sequences:
            say(f"{self.config}: method and settings are taken from it, not its sequences ({', '.join(sequences)})")


def read_config_file(path: Path) -> ConfigFile:
    """Read the config.json of a run, which may be edited (its checksum is not checked), or one written by hand."""
    content = _read(path)
    for name in content:
        if name not in _TAKEN + _NOT_TAKEN:
            near = difflib.get_close_matches(shown(name), _TAKEN, 1)
            raise UserError(no_such_setting(f"{path}: {shown(name)}", "a file of settings", near, _TAKEN))
    found = (content.get("format", "mien.run"), content.get("version", 1))
    if found != ("mien.run", 1):
        told = f"has format {found[0]!r:.80} version {found[1]!r:.80}; give a run's config.json ('mien.run' version 1)"
        raise UserError(f"{path}: {told}, or leave out format and version")
    parts = {name: content.get(name, {}) for name in _TAKEN}
    for name, part in parts.items():
        if not isinstance(part, dict):
            raise UserError(f"{path}: {name} is not an object of settings; give {{...}}")
    method = parts["method"].get("kind")
    if method is not None and (not isinstance(method, str) or not has_method(method)):
        raise UserError(f"{path}: method.kind {shown(method)}: give the name of a method: {', '.join(method_names())}")
    changes = {name: value for name, value in parts["method"].items() if name != "kind"}
    data: Any = content.get("data")
    data = data if isinstance(data, list) else []
    sequences = (shown(entry["sequence"]) for entry in data if isinstance(entry, dict) and "sequence" in entry)
    return ConfigFile(path, method, changes, parts["settings"], tuple(sequences))


def _read(path: Path) -> dict[str, Any]:
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "is not an ordinary file" if path.exists() else "no such file"
        raise UserError(f"--config {path}: {what}; give a json file, such as DIR/runs/NAME/config.json")
    try:
        text = read_bytes(path, 16 << 20).decode("utf-8-sig")  # editors on Windows write a byte order mark
        content = parse_json(text, unique_names=True, any_size=True)
    except (OSError, ValueError) as error:
        raise UserError(f"--config {path}: cannot be read as json ({error}); correct it or give another file") from None
    if not isinstance(content, dict):
        raise UserError(f'--config {path}: is not an object; give {{"method": {{...}}, "settings": {{...}}}}')
    return content
