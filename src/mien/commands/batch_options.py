"""Options of the commands that make a row of a batch: their names, how they are typed, and their checks."""

import importlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mien.batch.store import is_url
from mien.commands import capture, create, evaluate, track, train
from mien.commands.parsing import options_of, parse_options, with_defaults
from mien.errors import UserError

_COMMANDS: dict[str, type] = {
    "import": importlib.import_module("mien.commands.import").Command,
    "capture": capture.Command, "track": track.Command, "create": create.Command, "train": train.Command,
    "evaluate": evaluate.Run,
}  # fmt: skip
PATHS = frozenset(
    {
        "calibration",
        "config",
        "face-model",
        "lpips-weights",
        "capture.mattes",
        "capture.landmarks",
        "capture.clean-plate",
    }
)
"""Options that name a file. It may be given beside the table."""
OF_IMPORT, OF_SCORES = ("face-model", "retrack"), ("protocol", "fit-faces", "fit-steps", "lpips-weights")
"""Options of `mien import` and of `mien evaluate` that the row of a dataset may have."""
_OF_TRAIN, _OF_CREATE = (
    {name: value for name, value in options_of(with_defaults(command, [])) if not name.startswith("method")}
    for command in (train.Command, create.Command)
)
"""Options of both commands with their defaults, but for those of methods, which differ."""
OPTIONS = _OF_CREATE.keys() - {"out", "name", "run", "view", "preview"} | {*OF_IMPORT, *OF_SCORES}
_GROUPS = {"method"} | {name.partition(".")[0] for name in OPTIONS if "." in name}


def column_of(name: str) -> str:
    """The name of a column as that of an option: capture_size, --capture-size and capture-size are one."""
    return str(name).strip().removeprefix("--").replace("_", "-")


def is_option(column: str) -> bool:
    """Whether a column is an option of a row's commands."""
    group, dot, _ = column.partition(".")
    return bool(dot) and group in _GROUPS or column in OPTIONS


def of_training(key: str) -> bool:
    """Whether an option is one of `mien train`."""
    return key in _OF_TRAIN or key.startswith(("method.", "training."))


def typed(key: str, words: list[str]) -> list[str]:
    """An option as it is typed. Flags have no value: a cell with yes or true turns one on, no or false turns it off."""
    if [word.lower() for word in words] not in (["true"], ["yes"], ["false"], ["no"]):
        return [f"--{key}", *words]
    is_on = words[0].lower() in ("true", "yes")
    if key.startswith(("training.", "method.")):  # their flags take a value
        return [f"--{key}", str(is_on)]
    if _OF_CREATE.get(key) is True:  # on unless it is turned off: --capture.no-cuts
        group, dot, flag = key.rpartition(".")
        return [] if is_on else [f"--{group}{dot}no-{flag}"]
    return [f"--{key}"] if is_on else []


def check_steps(steps: Sequence[Sequence[str]], where: str, kinds: set[str]) -> None:
    """Check the options of all steps before any work, once for each kind of step."""
    for name, *words in steps:
        kind = json.dumps([name, *("one.mp4" if Path(word).is_absolute() or is_url(word) else word for word in words)])
        if kind in kinds:
            continue
        kinds.add(kind)
        command = parsed([name, *words], where)
        try:
            if name in ("create", "train"):
                command.options.check()
            if name in ("capture", "track"):
                command.settings.check()
            if name == "evaluate" and command.lpips_weights is not None:
                check_lpips(command.lpips_weights)
            if name == "create":
                command.capture.check()
                command.tracking.check()
        except UserError as error:
            raise UserError(f"{where}: {error}") from None


def check_lpips(weights: Path) -> None:
    """Check that LPIPS can be made of a file, so that no row is trained in vain."""
    from mien.perceptual.lpips import load_lpips

    load_lpips(weights)


def parsed(step: Sequence[str], where: str) -> Any:
    """A step of a row as a command, checked as far as no file is needed."""
    name, *words = step
    try:
        return parse_options(_COMMANDS[name], f"mien {name}", words)
    except UserError as error:
        raise UserError(f"{where}: {error}") from None
