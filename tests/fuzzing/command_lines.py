"""Make odd command lines for all sub-commands: values at edges, faulty workspaces, odd surroundings."""

import dataclasses
import importlib
import shlex
import types
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import tyro

from fuzzing import faults
from fuzzing.edges import PORT, TEXTS
from fuzzing.faults import Place
from mien.avatar import METHODS
from mien.cli import COMMANDS

BASES = (
    "render W --out o.png --size 16", "render W --out o.mp4 --size 16 --frames 2",
    "render W --out o_%03d.png --size 16 --sequence clip",
    "render W --out o.webm --size 16 --frames 2 --background transparent",
    "render W --cameras given/cameras.json --out o_%d.png",
    "drive W --by W --out o.mp4 --size 16", "drive W --by given/take.csv --out o.mp4 --size 16",
    "drive W --by given/take.json --out o.mp4 --size 16",
    "export W --out o.ply", "export W --out o.mien", "export W --out o.ply --series clip",
    "evaluate W --no-perceptual", "evaluate W --compare --json",
    "evaluate --images pictures --truth pictures --no-perceptual",
    "evaluate --images given/mattes --truth given/mattes --no-perceptual --json --crops given/crops.json",
    "train W --steps 1 --run r", "train W --run toy", "track W", "track W --again", "face-models",
    "face-models --json", "capture none.mp4 --out new",
    "analyze gaussian-avatars W --parts growth", "analyze gaussian-avatars W --parts growth --out o --json",
    "import gaussian_avatars --out new", "import gaussian_avatars --out W --run other",
    "import flame_avatars --out new", "export W --out o --format gaussian-avatars", "track W --hold-out clip",
    "evaluate W --no-perceptual --fit-faces --fit-steps 1",
    "study make W --out o.html", "study tally given/crops.json given/cameras.json", "bench compare W --methods nobody",
    "view none.mien", "bench", "bench quality --captures nobody --out o", "create none.mp4 --out new",
    "demo --out head.ply",
)  # fmt: skip
HEAVY = (
    "capture videos/clip.mp4 --out new", "create videos/clip.mp4 --out new --steps 1", "capture pictures --out new",
    "demo --out new --seconds 0.1 --steps 1",
    "face-models --add flame/tiny.npz --name tiny", "face-models --add flame/tiny.pkl",
    "bench compare W --steps 1 --out o", "bench render --seconds 0.001 --json", "bench scaling --seconds 0.001",
    "drive W --by videos/clip.mp4 --out o.mp4", "view W", "view head.mien", "track W --face-model flame/tiny.npz",
    "analyze gaussian-avatars W --train --steps 1 --seconds 0.001",
    "import flame_avatars --out new --face-model flame/tiny.npz",
)  # fmt: skip
"""Commands that take longer than a case may. They are stopped, and must end as a stopped command does."""
_NUMBERS = (
    "0", "1", "2", "3", "16", "0.5", "-1", "-0", "nan", "inf", "-inf", "1e400", "9" * 400, "9" * 5000, "2147483647",
    "2147483648", "4294967296", "9223372036854775808",
    "0x10", "1e3", "1_0", "٣", "1,5", "1.0", "3e38", "1e-320", " 1", "--1", "x",
)  # fmt: skip
_PATHS = (
    "W", "W/", "./W/../W", "W/runs/toy", "W/runs", "W/sequences/clip", "W/sequences/clip/capture", "none", "none.png",
    "videos/clip.mp4", "videos/clip.mkv", "pictures", "pictures/a.png",
    "pictures/a.jpg", "given/take.csv", "given/take.json", "given/points.csv", "given/points.safetensors",
    "given/mattes", "given/crops.json", "given/cameras.json", "head.mien", "head.ply",
    "flame/tiny.npz", "flame/tiny.pkl", "gaussian_avatars", "flame_avatars",
    "/dev/null", "/dev/zero", "/proc/self/mem", "/proc/self/environ",
    "/nowhere/x", "pipe", ".", "..", "~", "-", "x" * 300, "a/" * 2000 + "x",
    f"http://127.0.0.1:{PORT}/x.mp4", "a\x1b[31m.png", "a\nb.mp4", "empty", "größer.png", "\udcff.png", "%s.png",
    "%d%d.png", "%n.png", "o.png", "o.mp4", "o.webm", "o.ply", "o.mien", "o.json",
    "o.html", "o", "o_%06d.png", "out/deep/o.png", "W/o.png", "head.ply/x.png", "/dev/full", "/proc/x.png",
    "outside_link/o.png",
)  # fmt: skip
_METHODS: dict[str, Any] = {"method": Literal[tuple(METHODS)], "methods": tuple[Literal[tuple(METHODS)], ...]}
"""Options whose texts are names of methods. Their types do not say so, because other packages add methods."""
_SURROUNDINGS: dict[str, dict[str, Any]] = {
    "LANG=C": {"env": {"LANG": "C", "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}},
    "no HOME": {"without": ["HOME"]},
    "HOME nowhere": {"env": {"HOME": "/nowhere", "XDG_CACHE_HOME": ""}},
    "HOME is a file": {"env": {"HOME": "/dev/null"}},
    "cache nowhere": {"env": {"MIEN_CACHE": "/proc/nowhere"}},
    "cache is a file": {"env": {"MIEN_CACHE": "head.ply"}},
    "no room for temporary files": {"env": {"TMPDIR": "/nowhere"}},
    "threads 0": {"env": {"MIEN_THREADS": "0"}},
    "threads -1": {"env": {"MIEN_THREADS": "-1"}},
    "threads x": {"env": {"MIEN_THREADS": "x"}},
    "threads empty": {"env": {"MIEN_THREADS": ""}},
    "threads 100000": {"env": {"MIEN_THREADS": "100000"}},
    "threads 10^400": {"env": {"MIEN_THREADS": "9" * 400}},
    "narrow": {"env": {"COLUMNS": "1", "LINES": "1", "TERM": "dumb"}},
    "ascii": {"env": {"PYTHONIOENCODING": "ascii:strict"}},
    "stdout closed": {"stdout": "closed"},
    "stderr closed": {"stderr": "closed"},
    "stdin closed": {"stdin": "closed"},
    "stdout full": {"stdout": "full"},
    "stdout broken": {"stdout": "broken"},
    "files of 0 bytes": {"largest_file": 0},
    "files of 500 bytes": {"largest_file": 500},
    "files of 20000 bytes": {"largest_file": 20_000},
    "few open files": {"open_files": 20},
    "little memory": {"memory": 1 << 30},
    "interrupted": {"signal": 2},
    "terminated": {"signal": 15},
    "hung up": {"signal": 1},
}
AT_START = frozenset({"LANG=C", "ascii", "stdout closed", "stderr closed", "stdin closed", "few open files"})
"""Surroundings that matter only when Python starts, and so need a new process."""


@dataclass
class Line:
    """A command line and where it runs."""

    words: list[str]
    heavy: bool = False
    surroundings: dict[str, Any] = field(default_factory=dict)
    names: list[str] = field(default_factory=list)
    """Names of the surroundings, and of the faults in the workspace."""

    @property
    def apart(self) -> bool:
        """Whether the line needs a new process instead of a fork."""
        return bool(AT_START & set(self.names))

    def text(self) -> str:
        """Return the line as a report shows it."""
        return ascii(f"mien {shlex.join(word[:200] for word in self.words)}  [{', '.join(self.names)}]")


def make_line(place: Place, dice: Random, heavy: bool) -> Line:
    """Make a line for any sub-command. It may also make files in the place's folder faulty."""
    line = Line(shlex.split(dice.choice(HEAVY if heavy else BASES)), heavy)
    if dice.random() < 0.05:
        line.words = [dice.choice((*COMMANDS, "rendr", "", "--version", "-h", "\x1b[31m")), *line.words[1:]]
    options = list(options_of(line.words[0])) if line.words and line.words[0] in COMMANDS else []
    for _ in range(dice.choice((0, 0, 1, 1, 2))):
        if options:
            line.words += _with_value(dice.choice(options), dice)
    if dice.random() < 0.07:
        line.words[dice.randrange(len(line.words))] = dice.choice((*TEXTS[:40], *_PATHS)).replace("\x00", "")
    if dice.random() < 0.05:
        line.words.append(dice.choice(("--help", "--help-all", "-h", "--", "--x", "--out", "--out=", "--OUT=a.png")))
    line.words = [word.replace(PORT, str(place.port)).replace("@CANARY@", str(place.canary)) for word in line.words]
    # A shell cannot pass null bytes, nor lone surrogates other than those of bytes.
    line.words = [word.replace("\x00", "").replace("\ud800", "\udcff") for word in line.words]
    if dice.random() < 0.4:
        name = dice.choice(list(_SURROUNDINGS))
        line.names.append(name)
        line.surroundings = _SURROUNDINGS[name]
    if dice.random() < 0.4:
        files = sorted((place.root / "W").rglob("*"))
        place.file = dice.choice(files)
        where = place.file.relative_to(place.root)
        line.names.append(f"{where}: {faults.any_fault(place, dice)}")
    return line


def options_of(command: str) -> Iterator[tuple[str, Any]]:
    """Return all options of a sub-command with their types, as tyro derives them from its classes."""
    yield from _options(importlib.import_module(f"mien.commands.{command.replace('-', '_')}").Command, "")


def _options(kind: type, prefix: str) -> Iterator[tuple[str, Any]]:
    hints = get_type_hints(kind, include_extras=True)
    for each in dataclasses.fields(kind):
        hint, name, more = hints[each.name], each.name, ()
        if get_origin(hint) is Annotated:
            hint, *more = get_args(hint)
        for extra in more:
            name = getattr(extra, "name", None) if getattr(extra, "name", None) is not None else name
        if any(extra is tyro.conf.Positional for extra in more):
            continue
        inner = [one for one in (hint, *get_args(hint)) if isinstance(one, type) and dataclasses.is_dataclass(one)]
        inner += [get_args(one)[0] for one in get_args(hint) if get_origin(one) is Annotated]
        if inner:
            for one in inner:
                yield from _options(one, f"{prefix}{name}." if name else prefix)
        else:
            yield f"--{prefix}{name}".replace("_", "-"), _METHODS.get(each.name, hint)


def _with_value(option: tuple[str, Any], dice: Random) -> list[str]:
    name, hint = option
    if hint is bool:
        return [dice.choice((name, name.replace("--", "--no-", 1)))]
    if dice.random() < 0.04:
        return [name]
    count = dice.choice((1, 1, 2, 30)) if get_origin(hint) is tuple else 1
    return [name, *(_value(hint, dice) for _ in range(count))]


def _value(hint: Any, dice: Random) -> str:
    origin = get_origin(hint)
    if origin in (tuple, Union, types.UnionType):
        return _value(next(one for one in get_args(hint) if one is not type(None)), dice)
    if dice.random() < 0.04:
        return dice.choice((*TEXTS[:40], *_NUMBERS, *_PATHS))
    if origin is Literal:
        return dice.choice(list(map(str, get_args(hint))))
    if hint in (int, float):
        return dice.choice(_NUMBERS if dice.random() < 0.5 else ("1", "2", "3", "16", "20"))
    if hint is Path:
        return dice.choice(_PATHS)
    return dice.choice(
        (*TEXTS[:40], "clip", "toy", "anny", "drop=0.5", "drop=nan", "swell=1e400", "white", "#12345", "jawOpen=1")
    )
