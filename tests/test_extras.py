"""The base install asks for five packages, and what is missing is named with the extra that brings it."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from mien import extras, runtime
from mien.avatar import make_portable
from mien.cli import main
from mien.export.pixels import png_bytes
from mien.licences.spdx import requirements_of
from mien.render import camera_paths as torchs
from mien.runtime import camera_paths
from test_runtime import new_avatar
from toy_scene import toy_camera
from viewer_alone import page_of

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
STAGES = """
import ast, importlib
from pathlib import Path
from mien.commands import create

for node in ast.walk(ast.parse(Path(create.__file__).read_text(encoding="utf-8"))):
    if isinstance(node, ast.ImportFrom) and node.module.startswith("mien.commands.stages"):
        print(importlib.import_module(node.module).__name__)
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


def test_create_needs_no_package_of_another_extra():
    missing = {module for module, extra in extras.EXTRA_OF.items() if extra != "create"}
    assert "mien.commands.stages.training" in python_without(missing, STAGES).split()


def test_extras_bring_what_error_messages_say_and_the_base_install_asks_for_five_packages():
    asked = requirements_of(PROJECT)
    assert {name for name, extra in asked.items() if not extra} == {"numpy", "safetensors", "jaxtyping", "tyro", "rich"}
    extra_of = {extras.PACKAGE_OF.get(module, module).lower(): extra for module, extra in extras.EXTRA_OF.items()}
    del extra_of["scipy"]  # comes with others of the extra
    assert {package: asked.get(package) for package in extra_of} == extra_of


WORKING = {
    "still.png": "render {file} --out {out}/still.png --size 48",
    "f": "render {file} --out {out}/f --frames 3",
    "again.html": "export {file} --out {out}/again.html",
    "again.packed": "export {file} --out {out}/again.packed",
    "again.mien": "export {file} --out {out}/again.mien",
}
LACKING = {
    "export {file} --out {out}/me.ply": ("torch", "create"),
    "render {file} --out {out}/me.mp4": ("av", "create"),
    "view {file}": ("viser", "viewer"),
    "demo --out {out}/demo": ("torch", "create"),
}


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


def test_a_file_is_viewed_without_torch(exported: Path):
    """With mien[viewer] alone, the viewer serves its page. viser brings zstandard, and pillow by imageio."""
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
    read = cv2.imdecode(np.frombuffer(png_bytes(picture), np.uint8), cv2.IMREAD_UNCHANGED)
    assert read is not None
    assert (read[..., [2, 1, 0, 3][:channels]] == picture).all()


def test_paths_around_a_head_are_those_of_the_training_side():
    theirs, center = toy_camera(64), np.array([0.02, 0.05, -0.1])
    ours = runtime.Camera(theirs.K.numpy(), theirs.viewmat.numpy(), theirs.width, theirs.height)
    middle = torch.from_numpy(center).float()
    fitted = camera_paths.fitted(ours, 50, 80, 1.5)
    np.testing.assert_allclose(fitted.K, theirs.fitted(50, 80, 1.5).K.numpy(), rtol=1e-6)
    pairs = [
        (camera_paths.turned(ours, center, 0.4, -0.3), torchs.turned_camera(theirs, middle, 0.4, -0.3)),
        *zip(camera_paths.turntable(ours, center, 5, 1.0), torchs.turntable(theirs, middle, 5, 1.0), strict=True),
        *zip(camera_paths.turntable(ours, center, 5, 7.0), torchs.turntable(theirs, middle, 5, 7.0), strict=True),
        *zip(camera_paths.sway(ours, center, 5, 0.7, 0.2), torchs.sway(theirs, middle, 5, 0.7, 0.2), strict=True),
    ]
    for own, other in pairs:
        np.testing.assert_allclose(own.viewmat, other.viewmat.numpy(), atol=2e-6)


def test_a_file_refuses_what_only_a_run_has(exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    render = ["render", str(exported), "--out", str(tmp_path / "a.png")]
    for option, told in (
        ("--timestep 0", "a file"),
        ("--own-motion", "a file"),
        ("--sheet turntable", "a file"),
        ("--run x", "a file"),
        ("--set dorp=1", "did you mean drop?"),
    ):
        assert main([*render, *option.split()]) == 2
        assert told in capsys.readouterr().err
