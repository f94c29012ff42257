"""Options that several sub-commands share: the method, the preset, and the settings in detail."""

import argparse
import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin, get_type_hints

import tyro

from mien.avatar.methods import DEFAULT_METHOD, has_method, method_named, method_names
from mien.avatar.settings import MethodConfig
from mien.commands.parsing.config_file import ConfigFile, read_config_file
from mien.commands.parsing.help_text import Described, OtherValues, subclass_with
from mien.commands.parsing.settings_options import apply_options, check_names, leaves, options_type, other_values
from mien.disk.config import overlay
from mien.disk.workspace import open_workspace
from mien.errors import UserError
from mien.machine.devices import DeviceName, check_device
from mien.training.settings import MAIN_SETTINGS, PRESETS, Split, TrainSettings, doubly_held_out
from mien.training.settings.splits import NAMED_SPLIT

if TYPE_CHECKING:
    PresetName = str
else:
    PresetName = Literal[tuple(PRESETS)]

_MAX_PORT = 65535
_IN_DETAIL = Annotated[Any, tyro.conf.Fixed, tyro.conf.Suppress]
"""Options that depend on the method. `with_settings` fills them in."""


def listed_methods(about: str) -> Described:
    """A mark that describes an option by `about` and the names of all methods, also those of other packages."""
    return Described(lambda: f"{about}: {', '.join(method_names())} (compared in docs/results.md).")


@dataclass(frozen=True)
class TrainOptions:
    """The main options of training. All other settings come from the preset, the file and the method."""

    method: Annotated[str, listed_methods("Method that makes the avatar")] = DEFAULT_METHOD
    config: Path | None = None
    """A .json with settings, for example the config.json of a run to repeat (docs/settings.md). Options override the
    file, and the file overrides the preset."""
    preset: PresetName = "standard"
    """How thorough the training is. draft has fewer steps; standard has the defaults; fine has twice as many steps, for
    0.1 to 0.7 dB; paper repeats the method's paper in days on a processor, and paper-cpu does so in a small size, if
    the method has them (docs/paper_preset.md)."""
    split: Split = "blocks"
    """Frames held out for scoring: every fifth block of 10 frames (blocks), the last 20 % (tail), or nothing (none).
    gaussian-avatars: the sequence and the camera that the paper holds out, for its subjects (docs/using.md)."""
    subject: str | None = None
    """Subject of --split gaussian-avatars, for example 306 (default: the number in the workspace's name)."""
    background: Literal["white", "mixed", "random", "auto"] = "auto"
    """Background of the training pictures; mixed is random in one of ten steps. auto: mixed where sides are filled,
    else white."""
    steps: int = 0
    """Number of optimiser steps, over which all schedules stretch. 0 means the preset's number."""
    seed: int = 0
    """Seed of the random numbers. The same seed, data and settings give the same bytes."""
    hold_out: tuple[str, ...] = ()
    """Whole sequences that are scored but not trained on."""
    hold_out_cameras: tuple[str, ...] = ()
    """Ids of cameras that are scored but not trained on, for captures with several cameras."""
    device: DeviceName = "cpu"
    """Device for training. cpu: always the same bytes; cuda: an NVIDIA GPU, through gsplat (docs/using.md says how to
    install it); auto: a GPU if there is one. A run may resume on another device."""
    face_tuning: bool = True
    """Whether training corrects the tracking, with interpolated corrections for held-out frames (the default)."""
    training: _IN_DETAIL = None
    """The other settings of the run."""
    method_settings: _IN_DETAIL = None
    """The method's own settings."""

    def check(self) -> None:
        """Check before any work that all settings are valid."""
        self.settings()
        self.method_config()

    def settings(self) -> TrainSettings:
        """The settings of the run: those of the preset or the file, with these options apply_options."""
        check_device(self.device)
        if self.subject is not None and self.split != NAMED_SPLIT:
            raise UserError(f"--subject {self.subject}: is for --split {NAMED_SPLIT}; give that too, or leave it out")
        if self.steps < 0:
            raise UserError(f"--steps {self.steps}: give a positive number, or 0 for the preset's number")
        preset = PRESETS[self.preset].settings_of(self.method)
        settings = replace(
            preset if self.training is None else apply_options(preset, self.training),
            split=self.split,
            background=self.background,
            seed=self.seed,
            steps=self.steps or preset.steps,
            device=self.device,
            held_out_sequences=tuple(sorted(set(self.hold_out))),
            held_out_cameras=tuple(sorted(set(self.hold_out_cameras))),
        )
        settings.check()
        return settings

    def method_config(self) -> MethodConfig:
        """The method's settings: those of the preset or the file, with these options apply_options."""
        config = PRESETS[self.preset].config(self.method)
        if self.method_settings is not None:
            config = apply_options(config, self.method_settings)
        config = replace(config, face_tuning=replace(config.face_tuning, enabled=self.face_tuning))
        config.check()
        return config

    def say_what_is_ignored(self) -> None:
        """Report the entry of the file that the run does not use (the sequences of its own run), and doubled splits."""
        from mien.machine.progress import say

        doubled = doubly_held_out(self.settings())
        if doubled is not None:
            say(f"warning: {doubled}")
        sequences = read_config_file(self.config).sequences if self.config else ()
        if sequences:
            say(f"{self.config}: method and settings are taken from it, not its sequences ({', '.join(sequences)})")


def training_options(command: type) -> str | None:
    """The name of the field of a command that holds `TrainOptions`, or None."""
    for name, hint in get_type_hints(command).items():
        if hint is TrainOptions:
            return name
    return None


def with_settings(command: type, arguments: Sequence[str]) -> type:
    """A command with an option for every setting of the method that its arguments, or their --config, name.

    The preset and the file set the defaults, so that options override the file, and the file overrides the preset.
    """
    name = training_options(command)
    chosen = _chosen(arguments)
    if name is None or chosen.preset not in (None, *PRESETS):
        return command  # tyro reports the wrong name
    if chosen.method is not None:
        check_method("--method", chosen.method)
    file = read_config_file(Path(chosen.config)) if chosen.config is not None else None
    options = _with_defaults(chosen.method, chosen.preset or TrainOptions.preset, file, arguments)
    hint = get_type_hints(command, include_extras=True)[name]
    marks = get_args(hint)[1:] if get_origin(hint) is Annotated else ()
    return subclass_with(command, {name: Annotated[(options, *marks)]}, {name: field(default_factory=options)})


def settings_groups(command: type, arguments: Sequence[str]) -> tuple[list[str], str]:
    """The prefixes of the options that `with_settings` adds to a command, and the words to type to see them."""
    if training_options(command) is None:
        return [], ""
    method = _chosen(arguments).method or TrainOptions.method
    return ["training", "method"], f" --method {method if has_method(method) else TrainOptions.method}"


def _with_defaults(method: str | None, preset: str, file: ConfigFile | None, arguments: Sequence[str]) -> type:
    if file and file.method and method and file.method != method:
        raise UserError(
            f"--config {file.path}: has settings of {file.method}, but --method asks for {method}; leave --method out, "
            'or give a file that has only "settings"'
        )
    name = method or (file.method if file else None) or TrainOptions.method
    settings, config = PRESETS[preset].settings_of(name), PRESETS[preset].config(name)
    if file:
        settings = overlay(settings, file.settings_changes, f"{file.path}: settings", "a run")
        config = overlay(config, file.method_changes, f"{file.path}: method", name)
    # --face-tuning switches it.
    own = [leaf for leaf in leaves(config, "method") if leaf.name != "face_tuning.enabled"]
    check_names(arguments, "method", own, name)
    rest = [one.name for one in fields(settings) if one.name not in MAIN_SETTINGS]
    presets = method_named(name).presets
    runs = {preset: PRESETS[preset].settings_of(name) for preset in presets}
    configs = {preset: PRESETS[preset].config(name) for preset in presets}
    in_detail = {
        "training": options_type(leaves(settings, "training", rest), "training", runs),
        "method_settings": options_type(own, "method", configs),
    }
    dials = {dial: getattr(settings, dial) for dial in ("split", "background", "seed", "device")}
    dials |= {"hold_out": settings.held_out_sequences, "hold_out_cameras": settings.held_out_cameras}
    dials |= {"method": name, "face_tuning": config.face_tuning.enabled}
    dials["steps"] = settings.steps if file and "steps" in file.settings_changes else 0
    hints = get_type_hints(TrainOptions, include_extras=True)
    others = {
        "steps": other_values(runs, "steps", dials["steps"]),
        "background": other_values(runs, "background", dials["background"]),
        "face_tuning": other_values(configs, "face_tuning.enabled", dials["face_tuning"]),
    }
    hints |= {dial: Annotated[hints[dial], OtherValues(tuple(texts))] for dial, texts in others.items()}
    defaults = {dial: field(default=value) for dial, value in dials.items()}
    defaults |= {group: field(default_factory=kind) for group, kind in in_detail.items()}
    return subclass_with(TrainOptions, {dial: hints[dial] for dial in dials} | in_detail, defaults)


def _chosen(arguments: Sequence[str]) -> argparse.Namespace:
    """The method, preset and file that a command line names, or None for each that it does not name."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for name in ("method", "preset", "config"):
        parser.add_argument(f"--{name}", nargs="?")
    return parser.parse_known_args(list(arguments))[0]


def check_method(option: str, name: str) -> None:
    """Check that there is a method of a name."""
    if not has_method(name):
        names = ", ".join(method_names())
        raise UserError(f"{option}: give one of {names} instead of {name!r}, or install the package that adds it")


def check_avatar(avatar: Path, run: str | None) -> None:
    """Check before any work that there is an avatar: a .mien file, or a run of a workspace."""
    if avatar.is_file():
        if run is not None:
            raise UserError(f"--run {run}: a file holds one avatar; leave --run out")
        if avatar.suffix.lower() != ".mien":
            raise UserError(f"{avatar}: is no .mien file; give one, or a workspace's folder")
    elif avatar.suffix.lower() == ".mien" and not avatar.exists():
        raise UserError(f"{avatar}: no such file; write one with `mien export DIR --out me.mien`")
    else:
        open_workspace(avatar).pick_run(run)


def check_port(port: int) -> None:
    """Check the port of a viewer."""
    if not 0 <= port <= _MAX_PORT:
        raise UserError(f"--port {port}: give a number from 1 to {_MAX_PORT}, or 0 for a free one")


def has_viewer() -> bool:
    """Whether the package of the viewer's page is installed."""
    return importlib.util.find_spec("viser") is not None


def check_viewer() -> None:
    """Check that the package of the viewer's page is installed."""
    if not has_viewer():
        raise UserError("the viewer needs the package viser, which is missing; run `pip install 'mien[viewer]'`")
