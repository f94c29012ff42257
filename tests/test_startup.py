"""Nothing heavy is imported before it is needed, and the base install works without what an extra brings."""

import importlib
import json
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from known import known
from mien import plugins as extras
from mien import runtime
from mien.avatar.baking import make_portable
from mien.cli import COMMANDS, main
from mien.formats.page import write_page
from mien.formats.shared.packed import pack
from mien.media.pixels import png_bytes
from mien.render.camera_paths import turned_camera
from mien.runtime import camera_paths
from refusals import complaint
from test_release import requirements_of
from test_runtime import new_avatar
from toy_scene import toy_camera
from viewer_alone import page_of
from web_case import drawn_head

HEAVY = {"torch", "mediapipe", "cv2", "matplotlib", "av", "scipy", "anny", "mien._native"}
LAZY_ROOMS = [
    "avatar", "capture", "datasets", "driving", "face", "formats", "lab.synthetic", "tracking", "training",
    "viewer",
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
capture gone.mp4 --out w; capture a.mp4 --out w --capture.size 3; capture a.mp4 --out w --capture.mattes gone;
create gone.mp4 --out w; create a.mp4 --out w --steps -3; create a.mp4 --out w --method nerf;
create a.mp4 --out w --method.sh-degree 9; create a.mp4 --out w --config gone.json; create a.mp4 --out a.csv;
track gone; track .; train gone; train w --hold-out nobody; evaluate; evaluate w --run nobody; evaluate w w;
evaluate images gone gone; evaluate w --perceptual-frames -1; analyze gaussian-avatars gone;
analyze gaussian-avatars w --run nobody; analyze gaussian-avatars w --parts hair; import gone --out n;
import w --out n --dataset nobody; render gone --out a.png; render w --out a.gif; render w --out b.png --size 9999;
render w --out b.png --background pinkish; render w --out b.mp4 --motion nobody; drive gone --by a.csv --out b.mp4;
drive w --by gone --out b.mp4; drive w --by a.csv --out b.mp4 --fps 0; drive w --by camera:/dev/video99;
drive w --by camera --port 99999; view gone.mien; view w --port 99999; view w --play nobody; export w --out a.obj;
export w --out gone.ply --series nobody; face-models --name x; face-models --add gone.npz; bench scaling --plot a.txt;
bench quality --steps -1; bench compare gone; bench compare w --methods nerf; study make gone --out a.html;
study make w --out a.html --side 100; study tally gone.json gone.json; demo --seconds 9999; demo --out a.csv
"""
"""Command lines with a mistake in a value or a path, for a workspace `w` and files `a.*`."""


def modules_after(lines: list[list[str]], folder: Path) -> list[tuple[int, set[str]]]:
    """Return exit code and imported modules after each of some command lines, run in turn in a new process.
    Torch is imported at the end, and has to have one thread."""
    words = [sys.executable, "-c", SCRIPT, json.dumps(lines)]
    done = subprocess.run(words, capture_output=True, text=True, check=True, cwd=folder)
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
    right = [["--help"], *([name, "--help"] for name in COMMANDS), ["create", "--help-all"], ["train", "--help-all"]]
    wrong = [[name, "--no-such-option"] for name in ("create", "view", "batch")]
    wrong += map(str.split, WRONG_VALUES.split(";"))
    light = [["render", "me.mien", "--out", "me.png", "--size", "32"], *([name] for name in WITHOUT_TORCH)]
    runtime.write_portable(tmp_path / "me.mien", drawn_head(50))
    lines = [*right, *wrong, *light]
    for line, (code, modules) in zip(lines, modules_after(lines, tmp_path), strict=True):
        assert code == (2 if line in wrong else 0), f"mien {' '.join(line)}: exit code {code}"
        unwanted = modules & ({"torch", "anny", "mediapipe"} if line in light else HEAVY)
        assert not unwanted, f"mien {' '.join(line)} imports {sorted(unwanted)}"


@pytest.mark.parametrize("room", LAZY_ROOMS)
def test_lazy_rooms_give_all_their_names(room: str) -> None:
    """Lazy rooms give all their names, each from a module of the room. No submodule of the same name hides one."""
    module = importlib.import_module(f"mien.{room}")
    for path in Path(str(module.__file__)).parent.glob("*.py"):
        importlib.import_module(f"mien.{room}.{path.stem}")
    assert set(module.__all__) <= set(dir(module))
    for name in module.__all__:
        assert type(getattr(module, name)) is not type(module), f"mien.{room}.{name} is a module"
    with pytest.raises(AttributeError, match="attribute '?nothing"):
        module.nothing  # noqa: B018


ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
WITHOUT = """
import contextlib, importlib.util, io, json, sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {missing}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

find = importlib.util.find_spec
importlib.util.find_spec = lambda name, *more: None if name in {missing} else find(name, *more)
sys.meta_path.insert(0, Missing())
"""
LINES = """
from mien.cli import main
ended = []
for line in json.loads(sys.argv[1]):
    sys.meta_path.insert(0, Missing())  # before the finders of the last command
    with contextlib.redirect_stderr(io.StringIO()) as told, contextlib.redirect_stdout(io.StringIO()):
        code = main(line)
    ended.append([code, told.getvalue()])
print(json.dumps(ended))
"""
STAGES = r"""
import importlib, re
from pathlib import Path
from mien.commands import create

for stage in re.findall(r"from (mien\.pipeline\S*) import", Path(create.__file__).read_text(encoding="utf-8")):
    print(importlib.import_module(stage).__name__)
"""


def python_without(missing: set[str], code: str, *arguments: str) -> str:
    """Run Python where some packages are missing, and return its output."""
    words = [sys.executable, "-c", WITHOUT.format(missing=sorted(missing)) + code, *arguments]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("file") / "me.mien"
    runtime.write_portable(path, make_portable(new_avatar("gaussian_avatars"), toy_camera(32), "toy"))
    return path


def test_extras_bring_what_commands_need_and_the_base_install_asks_for_six_packages():
    missing = {module for module, extra in extras.EXTRA_OF.items() if extra not in ("create", "video")}
    assert "mien.pipeline.train" in python_without(missing, STAGES).split()
    asked = requirements_of(PROJECT)
    assert {name for name, extra in asked.items() if not extra} == {
        "numpy", "safetensors", "jaxtyping", "lazy-loader", "tyro", "rich"
    }  # fmt: skip
    extra_of = {extras.PACKAGE_OF.get(module, module).lower(): extra for module, extra in extras.EXTRA_OF.items()}
    del extra_of["scipy"]  # comes with others of the extra
    assert {package: asked.get(package) for package in extra_of} == extra_of


WORKING = {
    "still.png": "render {file} --out {out}/still.png --size 48", "f": "render {file} --out {out}/f --frames 3",
    "again.html": "export {file} --out {out}/again.html", "again.packed": "export {file} --out {out}/again.packed",
    "again.mien": "export {file} --out {out}/again.mien",
}  # fmt: skip
LACKING = {
    "export {file} --out {out}/me.ply": ("torch", "create"), "render {file} --out {out}/me.mp4": ("av", "video"),
    "capture {file} --out {out}/me": ("av", "create"), "view {file}": ("viser", "viewer"),
    "demo --out {out}/demo": ("filelock", "create"), "export {file} --out {out}/me.usda": ("usd-core", "usd"),
}  # fmt: skip


def test_a_file_is_drawn_and_exported_without_any_extra_and_what_is_missing_is_named(exported: Path, tmp_path: Path):
    lines = [line.format(file=exported, out=tmp_path).split() for line in (*WORKING.values(), *LACKING)]
    ended = json.loads(python_without(set(extras.EXTRA_OF), LINES, json.dumps(lines)))
    for name, (code, told) in zip(WORKING, ended, strict=False):
        assert code == 0, told
        files = sorted((tmp_path / name).iterdir()) if name == "f" else [tmp_path / name]
        assert len(files) == (3 if name == "f" else 1)
        assert all(file.stat().st_size > (100 if file.suffix == ".png" else 1000) for file in files)
    for (package, extra), (code, told) in zip(LACKING.values(), ended[len(WORKING) :], strict=True):
        assert (code, told.count("\n")) == (2, 1), told
        assert package in told
        assert f"pip install 'mien[{extra}]'" in told


def test_a_film_needs_no_more_than_pyav_and_the_viewer_no_torch(exported: Path, tmp_path: Path):
    lines = [["render", str(exported), "--out", str(tmp_path / name), "--frames", "3"] for name in ("a.mp4", "a.webm")]
    ended = json.loads(python_without(set(extras.EXTRA_OF) - {"av"}, LINES, json.dumps(lines)))
    assert [code for code, _ in ended] == [0, 0], ended
    head = tmp_path / "head.mien"
    runtime.write_portable(head, drawn_head(50))
    example = f"import runpy\nsys.argv[1:] = {[str(head), '--out', str(tmp_path / 'f'), '--frames', '2']}\n"
    example += f"runpy.run_path({str(ROOT / 'examples' / '08_runtime.py')!r}, run_name='__main__')"
    assert "2 pictures" in python_without(set(extras.EXTRA_OF), example)
    assert len(list((tmp_path / "f").glob("*.png"))) == 2
    # With mien[viewer] alone, the viewer serves its page. viser brings zstandard, and pillow by imageio.
    missing = set(extras.EXTRA_OF) - {"viser", "zstandard", "PIL"}
    code = WITHOUT.format(missing=sorted(missing)) + "from mien.cli import main\nsys.exit(main(sys.argv[1:]))"
    told = page_of([sys.executable, "-c", code, "view", str(exported), "--port", "0"])
    assert "<html" in told, told


def test_a_missing_library_of_the_system_is_named_and_what_no_extra_brings_is_a_bug():
    words = extras.missing_package(ImportError("libGL.so.1: cannot open shared object file: No such file", name="cv2"))
    assert words is not None
    assert "libGL.so.1" in words
    assert "apt-get install" in words
    assert extras.missing_package(ModuleNotFoundError("No module named 'mien.gone'", name="mien.gone")) is None
    assert extras.missing_package(ImportError("cannot import name 'gone' from 'torch'", name="torch")) is None


@pytest.mark.parametrize("channels", [3, 4])
def test_a_png_is_read_as_it_was_written(channels: int):
    picture = np.random.default_rng(0).integers(0, 256, (33, 47, channels), np.uint8)
    read = known(cv2.imdecode(np.frombuffer(png_bytes(picture), np.uint8), cv2.IMREAD_UNCHANGED))
    assert (read[..., [2, 1, 0, 3][:channels]] == picture).all()


def test_paths_around_a_head_are_those_of_the_training_side():
    theirs, center = toy_camera(64), np.array([0.02, 0.05, -0.1])
    ours = runtime.Camera(theirs.K.numpy(), theirs.viewmat.numpy(), theirs.width, theirs.height)
    middle = torch.from_numpy(center).float()
    fitted = camera_paths.fitted(ours, 50, 80, 1.5)
    np.testing.assert_allclose(fitted.K, theirs.fitted(50, 80, 1.5).K.numpy(), rtol=1e-6)
    for angles in ((0.4, -0.3), (0.4, 0.0), (0.0, -0.3), (0.0, 0.0), (3.5, 0.2)):
        own, other = camera_paths.turned(ours, center, *angles), turned_camera(theirs, middle, *angles)
        np.testing.assert_allclose(own.viewmat, other.viewmat.numpy(), atol=2e-6)


def test_a_head_that_the_filmed_frame_cuts_off_is_shown_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """With --zoom, the picture is what the camera saw."""
    head, file = drawn_head(500), tmp_path / "me.mien"
    near = camera_paths.fitted(head.camera, head.camera.width, head.camera.height, 1.6)
    for camera, cut in ((head.camera, False), (near, True)):
        runtime.write_portable(file, replace(head, camera=camera))
        for zoom in ([], ["--zoom", "1"]):
            line = ["render", str(file), "--out", str(tmp_path / "a.png"), "--size", "64", *zoom]
            assert main(line) == 0
            picture = known(cv2.imread(str(tmp_path / "a.png")))
            edges = np.concatenate([picture[0], picture[:, 0], picture[:, -1]])
            assert bool(edges.min() < 200) is (cut and bool(zoom))
            assert picture.min() < 150
    packed = []
    monkeypatch.setattr("mien.formats.page.pack", lambda avatar, *rest: packed.append(avatar) or pack(avatar, *rest))
    write_page(tmp_path / "me.html", replace(head, camera=near))
    assert packed[-1].camera.K[0, 0] < near.K[0, 0]


def test_a_file_refuses_what_only_a_run_has(exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    render = ["render", str(exported), "--out", str(tmp_path / "a.png")]
    for option, told in (
        ("--timestep 0", "a file"), ("--motion own", "a file"), ("--path captured", "a file"), ("--run x", "a file"),
        ("--set dorp=1", "did you mean drop?"),
    ):  # fmt: skip
        assert told in complaint(capsys, *render, *option.split())
