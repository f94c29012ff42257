"""Train captures with one constant or one setting changed at a time, and print what each change is worth.

    python benchmarks/ablate.py out/wojtek out/d3 --set avatar.bound_surface.FILL_OPACITY=0.9 --steps 1000

Give the captures first: workspaces with tracked sequences. Each is trained once as it is and once with each change, as
`mien train` does, and its held-out frames are scored as `mien evaluate` does. `--list` prints what --set can change;
captures are not tracked again. --setting changes an option: --setting method.density.max-gaussians=20000. All other
options are those of `mien train`, for every run. Runs are called ablation-NAME in their workspace. Finished ones are
only read: delete them after a change of the code.
"""

import argparse
import ast
import hashlib
import importlib
import json
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from statistics import fmean
from types import ModuleType
from typing import Any, NamedTuple

import mien
from mien.cli import main as run_mien
from mien.disk.workspace import open_workspace
from mien.errors import UserError
from mien.machine.terminal import show

Change = tuple[ModuleType, str, Any]
"""The module of a constant, its name, and its other value."""
ROOMS = ("avatar", "capture", "driving", "face", "media", "tracking", "training")
"""Rooms whose constants decide how good an avatar is."""
UNCHANGED = "unchanged"


class Figures(NamedTuple):
    """Scores of a run on its held-out frames: means over its protocols, PSNR in dB, and seconds of training."""

    change: str
    capture: str
    psnr: float
    head_psnr: float
    seconds: float


def constants() -> dict[str, tuple[ModuleType, str]]:
    """The module and the name of each constant that is a number or several, by "ROOM.FILE.NAME" without underscores."""
    root, found = Path(mien.__file__).parent, {}
    for path in sorted(path for room in ROOMS for path in (root / room).rglob("*.py")):
        places = [node.targets for node in ast.parse(path.read_text("utf-8")).body if isinstance(node, ast.Assign)]
        names = [place.id for targets in places for place in targets if isinstance(place, ast.Name)]
        parts = path.relative_to(root).with_suffix("").parts
        for name in filter(str.isupper, names):
            module = importlib.import_module(".".join(("mien", *parts)))
            values = getattr(module, name)
            if all(type(value) in (int, float) for value in (values if isinstance(values, tuple) else (values,))):
                found[".".join((*parts, name.lstrip("_")))] = module, name
    return found


def change_of(text: str) -> Change:
    """Read ROOM.FILE.NAME=VALUE."""
    key, _, value = text.partition("=")
    if key not in (known := constants()):
        raise UserError(f"--set {text}: no such constant; --list prints them all")
    module, name = known[key]
    now = getattr(module, name)
    try:
        new = ast.literal_eval(value)
    except (ValueError, SyntaxError):
        new = None
    new = float(new) if isinstance(now, float) and type(new) is int else new
    if type(new) is not type(now) or (isinstance(new, tuple) and isinstance(now, tuple) and len(new) != len(now)):
        raise UserError(f"--set {text}: give a value like {now!r}")
    return module, name, new


@contextmanager
def changed(change: Change) -> Iterator[None]:
    """Give a constant its other value, also in the modules that import it."""
    module, name, value = change
    before = getattr(module, name)
    users = [other for key, other in sys.modules.items() if key.startswith("mien.") and vars(other).get(name) is before]
    for user in (module, *users):
        setattr(user, name, value)
    try:
        yield
    finally:
        for user in (module, *users):
            setattr(user, name, before)


def run_name(label: str, options: Sequence[str]) -> str:
    """The name of a run: its change, and a hash of the options and of all constants as they are now."""
    values = {key: repr(getattr(module, name)) for key, (module, name) in constants().items()}
    content = json.dumps([list(options), values])
    return f"ablation-{re.sub('[^a-z0-9_.=-]', '_', label.lower())}-{hashlib.sha256(content.encode()).hexdigest()[:8]}"


def measure(folder: Path, label: str, change: Change | None, options: Sequence[str]) -> Figures:
    """Train a workspace with a change, and score the run without baselines, ST-LPIPS and videos."""
    from mien.evaluation.protocols import EvaluationSettings
    from mien.pipeline.evaluate import run_evaluation_stage

    quick = EvaluationSettings(perceptual=False, baselines=False, video_frames=0)
    with changed(change) if change else nullcontext():
        run = run_name(label, options)
        if code := run_mien(["train", str(folder), "--run", run, *options]):
            raise SystemExit(code)
        metrics = run_evaluation_stage(open_workspace(folder), run, quick, again=False)
    protocols = metrics["protocols"].values()
    psnr, head = (fmean(values) for values in zip(*((p["psnr"], p["head"]["psnr"]) for p in protocols), strict=True))
    return Figures(label, folder.resolve().name, psnr, head, metrics["training"]["seconds"])


def table(rows: Sequence[Figures]) -> str:
    """The figures in markdown, with differences to the unchanged run, and each change's mean over several captures."""
    lines = ["| change | capture | PSNR, dB | head crop, dB | training, s |", "|---|---|---|---|---|"]
    for change in dict.fromkeys(row.change for row in rows) if len({row.capture for row in rows}) > 1 else ():
        own = [row for row in rows if row.change == change]
        means = (fmean(getattr(row, name) for row in own) for name in ("psnr", "head_psnr", "seconds"))
        rows = [*rows, Figures(change, "mean", *means)]
    base = {row.capture: row for row in rows if row.change == UNCHANGED}
    for row in rows:
        pairs = ((row.psnr, base[row.capture].psnr), (row.head_psnr, base[row.capture].head_psnr))
        cells = [f"{value:.2f}" + f" ({value - than:+.2f})" * (row.change != UNCHANGED) for value, than in pairs]
        lines.append(f"| {row.change} | {row.capture} | {' | '.join(cells)} | {row.seconds:.0f} |")
    return "\n".join(lines)


def main() -> None:
    """Measure every change on every capture, and print the table."""
    parser = argparse.ArgumentParser(usage=__doc__, allow_abbrev=False)
    parser.add_argument("captures", type=Path, nargs="*")
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--setting", action="append", default=[])
    parser.add_argument("--list", action="store_true")
    given, options = parser.parse_known_args()
    if given.list:
        show("\n".join(f"{key}={getattr(*place)!r}" for key, place in constants().items()))
    changes = [(UNCHANGED, None, []), *((text, change_of(text), []) for text in given.set)]
    changes += [(text, None, f"--{text}".split("=", 1)) for text in given.setting]
    if rows := [measure(path, name, one, [*options, *own]) for path in given.captures for name, one, own in changes]:
        show(table(rows))


if __name__ == "__main__":
    try:
        main()
    except UserError as error:
        sys.exit(str(error))
