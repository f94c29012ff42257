"""Help, mistyped options and wrong paths are answered without importing the libraries that take seconds."""

import importlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

from mien import runtime
from mien.cli import COMMANDS
from web_case import drawn_head

HEAVY = {"torch", "mediapipe", "cv2", "matplotlib", "av", "scipy", "anny", "mien._native"}
LAZY_ROOMS = [
    "avatar", "capture", "datasets", "driving", "export", "face", "lab.analysis", "tracking", "training",
    "training.footage", "training.whole_head", "viewer",
]  # fmt: skip
WITHOUT_TORCH = ("licenses", "plugins", "face-models")
SCRIPT = """
import json, os, sys
from mien.cli import main
found = []
for line in json.loads(sys.argv[1]):
    try:
        code = main(line)
    except SystemExit as stop:
        code = stop.code
    found.append([code, sorted(sys.modules)])
import torch
found.append([torch.get_num_threads(), []])
print(json.dumps(found), file=sys.__stdout__)
"""
WRONG_VALUES = """
capture gone.mp4 --out w; capture a.mp4 --out w --capture.size 3; capture a.mp4 --out a.csv;
capture a.mp4 --out w --capture.mattes gone; create gone.mp4 --out w; create a.mp4 a.mp4 --out w;
create a.mp4 --out w --steps -3; create a.mp4 --out w --method nerf; create a.mp4 --out w --method.sh-degree 9;
create a.mp4 --out w --method.no-such-setting 1; create a.mp4 --out w --config gone.json;
create a.mp4 --out w --run a/b; create a.mp4 --out a.csv; track gone; track .; train gone; train w --hold-out nobody;
train w --sequences nobody; evaluate; evaluate gone; evaluate w --run nobody; evaluate w w;
evaluate --images gone --truth gone; evaluate w --perceptual-frames -1; analyze gaussian-avatars gone;
analyze gaussian-avatars w --run nobody; analyze gaussian-avatars w --parts hair; analyze gaussian-avatars w --steps 0;
analyze nerf w; import gone --out n; import w --out n; import w --out n --dataset nobody; render gone --out a.png;
render w --out a.gif; render w --out b.png --size 9999; render w --out b.png --background pinkish;
render w --out b.mp4 --frames 0; render w --out b.mp4 --sequence nobody; drive gone --by a.csv --out b.mp4;
drive w --by gone --out b.mp4; drive w --by a.csv --out b.gif; drive w --by a.csv --out b.mp4 --fps 0;
drive w --by a.csv --port 99999; drive w --by camera:/dev/video99; drive w --by camera: --out b.mp4;
drive w --by camera --port 99999; view gone; view gone.mien; view a.csv; view w --port 99999; view w --play nobody;
export w --out a.obj; export w --out gone.ply --series nobody; face-models --name x; face-models --add gone.npz;
bench scaling --plot a.txt; bench quality --steps -1; bench compare; bench compare gone;
bench compare w --minutes 2 --steps 3; bench compare w --methods nerf; study make gone --out a.html;
study make w --out a.html; study make w --out a.mp4; study make w --out a.html --side 100;
study tally gone.json gone.json; demo --seconds 9999; demo --out a.csv
"""
"""Command lines with a mistake in a value or a path, for a workspace `w` and files `a.*`."""


def modules_after(lines: list[list[str]], folder: Path) -> list[tuple[int, set[str]]]:
    """Return exit code and imported modules after each of some command lines, run in turn in a new process.

    Torch is imported at the end, and has to have one thread.
    """
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, json.dumps(lines)], capture_output=True, text=True, check=True, cwd=folder
    )
    *ended, (threads, _) = json.loads(done.stdout.splitlines()[-1])
    assert threads == 1
    return [(code, set(modules)) for code, modules in ended]


def test_nothing_heavy_is_imported_before_it_is_needed(tmp_path: Path) -> None:
    """Help and mistakes import nothing heavy, even if all before a mistake is right; what needs no torch has none."""
    for name in ("w/sequences/s/capture/capture.json", "w/sequences/s/tracking/tracking.json", "w/runs/r/config.json"):
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).write_text("{}")
    for name in ("a.mp4", "a.csv", "a.npz"):
        (tmp_path / name).touch()
    help_of = [["--help"], *([name, "--help"] for name in COMMANDS), ["create", "--help-all"], ["train", "--help-all"]]
    wrong = [
        *([name, "--no-such-option"] for name in ("create", "view", "batch")),
        *map(str.split, WRONG_VALUES.split(";")),
    ]
    runtime.write_portable(tmp_path / "me.mien", drawn_head(50))
    light = [["render", "me.mien", "--out", "me.png", "--size", "32"], *([name] for name in WITHOUT_TORCH)]
    ended = modules_after([*help_of, *wrong, *light], tmp_path)
    for line, (code, modules) in zip(light, ended[-len(light) :], strict=True):
        assert code == 0, line
        assert not modules & {"torch", "anny", "mediapipe"}, line
    for line, (code, modules) in zip([*help_of, *wrong], ended, strict=False):
        assert code == (0 if line in help_of else 2), f"mien {' '.join(line)}: exit code {code}"
        assert not modules & HEAVY, f"mien {' '.join(line)} imports {sorted(modules & HEAVY)}"


@pytest.mark.parametrize("room", LAZY_ROOMS)
def test_lazy_rooms_give_all_their_names(room: str) -> None:
    """Lazy rooms give all their names, each from a module of the room. No submodule of the same name hides one."""
    module = importlib.import_module(f"mien.{room}")
    for path in Path(str(module.__file__)).parent.glob("*.py"):
        importlib.import_module(f"mien.{room}.{path.stem}")
    assert set(module.__all__) <= set(dir(module))
    for name in module.__all__:
        assert type(getattr(module, name)) is not type(module), f"mien.{room}.{name} is a module"
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        module.nothing  # noqa: B018
