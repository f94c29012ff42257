"""Bad input is refused in one line. docs/bad_input.md lists for every command which test shows this.
On a full disk, every writer says so, and keeps the file of before; then the same command succeeds."""

import errno
import importlib.util
import os
import random
import re
import resource
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import train_toy
from capture_helpers import write_gradient_video
from mien.avatar import load_avatar
from mien.avatar.files import write_avatar
from mien.capture import write_capture
from mien.cli import main
from mien.disk.files import read_arrays, read_json, read_tensors, write_arrays, write_json, write_tensors
from mien.disk.workspace import Workspace, open_workspace
from mien.evaluation.metrics_file import read_metrics
from mien.formats.glb import write_glb
from mien.media.output import plan_output
from mien.media.video import write_video
from mien.media.writing import write_pictures
from mien.tracking import write_tracking
from mien.tracking.scoring import Scoring
from mien.tracking.scoring_files import write_scoring
from mien.training.checkpoint import checkpoint_files
from mien.training.run import read_run_config, read_training_summary
from needs import NO_MOUNT
from refusals import complaint, refuses
from shared_things import MadeOnce, toy_workspace
from test_methods import new_avatar
from toy_scene import toy_sequence

pytestmark = pytest.mark.unchecked
DOCS = Path(__file__).parent.parent / "docs" / "bad_input.md"


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("workspace") / "runs" / "toy"
    train_toy.main(folder, train_toy.SETTINGS.steps)
    return folder


def test_an_interrupted_write_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    path = tmp_path / "a.safetensors"
    write_tensors(path, {"a": torch.ones(3)})
    scoring = Scoring(np.zeros((2, 1, 8, 8), np.uint8), np.zeros((2, 1, 4), np.int64))
    for name, write in (
        ("pathlib.Path.replace", lambda: write_tensors(path, {"a": torch.zeros(3)})),
        ("mien.tracking.scoring_files.write_arrays", lambda: write_scoring(tmp_path / "scoring", scoring, "x")),
    ):
        with monkeypatch.context() as patched:
            patched.setattr(name, interrupt)
            pytest.raises(KeyboardInterrupt, write)
        assert list(tmp_path.iterdir()) == [path]
    assert read_tensors(path)["a"].tolist() == [1, 1, 1]
    write_scoring(tmp_path / "scoring", scoring, "of a capture")
    assert (tmp_path / "scoring" / "scoring.json").is_file()


def tensors_file(header: bytes) -> bytes:
    return len(header).to_bytes(8, "little") + header + bytes(4)


JSON: dict[bytes, str] = {
    b"[1, 2": "cannot be read as json", b"[" * 100_000: "cannot be read as json",
    b'{"format": "x", "version": 1, "a": NaN}': "holds the number NaN",
    b'{"format": "x", "version": 9}': "version 9, expected 'x' version 1", b"[1]": "has format None",
    bytes(1 << 26): "and at most",
}  # fmt: skip
TENSORS: dict[bytes, str] = {
    (1 << 62).to_bytes(8, "little") + b"{}": "header does not fit",
    tensors_file(b'{"__metadata__": [1]}'): "metadata is not an object",
    tensors_file(b"[]"): "metadata is not an object", tensors_file(b"[" * 3000): "too deep",
    tensors_file(b'{"a": ' + b"9" * 400 + b"}"): "400 digits",
    tensors_file(b'{"a": {"dtype": "F32", "shape": [1000000000000], "data_offsets": [0, 4000000000000]}}'): "damaged",
    tensors_file(b'{"a": {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}, '
                 b'"b": {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}}'): "damaged",
    tensors_file(b'{"a": {"dtype": "BF16", "shape": [2], "data_offsets": [0, 4]}}'): "damaged",
}  # fmt: skip


def test_bad_json_and_tensors(tmp_path: Path) -> None:
    """Damaged, foreign or huge files are refused with the reason."""
    path = tmp_path / "a"
    for data, message in (JSON | TENSORS).items():
        path.write_bytes(data)
        readers = [lambda: read_json(path, "x", 1)] if data in JSON else [lambda: read_arrays(path)]
        readers += [lambda: read_tensors(path)] * (data in TENSORS and b"BF16" not in data)
        for read in readers:
            refuses(message, read)
    path.write_bytes(tensors_file(b"{}"))
    os.truncate(path, 1 << 40)
    refuses("and at most", read_arrays, path)


def test_no_advice_to_delete_a_folder_that_holds_an_avatar(run_dir: Path, tmp_path: Path) -> None:
    readers = {"config.json": read_run_config, "metrics.json": read_metrics, "training.json": read_training_summary}
    for name, read in readers.items():
        (tmp_path / name).touch()
        assert "delete its folder" not in refuses("cannot be read as json", read, tmp_path)
    refuses("delete this file, not its folder, and run `mien evaluate` again", read_metrics, tmp_path)
    shutil.copytree(run_dir / "avatar", tmp_path / "avatar")
    for name in ("face_model.safetensors", "avatar.json"):
        path = tmp_path / "avatar" / name
        path.write_bytes(path.read_bytes()[:40])
        refuses(rf"{name}: .*; delete the run's training.json, .* again with `mien train`", load_avatar, tmp_path)


def test_a_damaged_run_is_trained_again_as_advised(run_dir: Path, tmp_path: Path, capsys) -> None:
    """A damaged avatar is made again, and a damaged checkpoint is replaced by the older one, which is said."""
    copy = shutil.copytree(run_dir, tmp_path / "copy")
    (copy / "avatar" / "face_model.safetensors").unlink()
    (copy / "avatar" / "avatar.safetensors").write_bytes(b"")
    (copy / "training.json").unlink()
    older, newest = checkpoint_files(copy / "checkpoints")
    for damaged in (False, True):
        if damaged:
            newest.write_bytes(newest.read_bytes()[:-1] + b"x")
            shutil.rmtree(copy / "avatar")
            (copy / "training.json").unlink()
        capsys.readouterr()
        train_toy.main(copy, train_toy.SETTINGS.steps)
        shown = capsys.readouterr()
        said = " ".join((shown.err + shown.out).split())
        step = int(older.stem.removeprefix("step_"))
        assert ("training continues from the older checkpoint" in said) == damaged
        assert (f"at step {step} step {step + 1} step {step + 2}" in said) == damaged
        for name in ("avatar.safetensors", "face_model.safetensors"):
            assert (copy / "avatar" / name).read_bytes() == (run_dir / "avatar" / name).read_bytes()


@pytest.mark.parametrize(("error", "words"), [
    (OSError(errno.ENOSPC, "No space left on device", "/x/a.png"), "/x/a.png: No space left"),
    (MemoryError("8 GiB"), "not enough memory"),
])  # fmt: skip
def test_a_full_disk_or_memory_anywhere_is_no_bug(error: Exception, words: str, tmp_path, monkeypatch, capsys) -> None:
    def fail(_: object) -> None:
        raise error

    monkeypatch.setattr("mien.disk.workspace.Workspace.sequence_names", fail)
    assert words in complaint(capsys, "track", str(tmp_path))


def test_workspaces_in_odd_places(run_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A workspace in the place of a file or inside another one is refused, and nothing is written."""
    write_gradient_video(tmp_path / "a.mp4", frames=3)
    (tmp_path / "out").write_text("mine")
    outer = tmp_path / "outer"
    shutil.copytree(run_dir, outer / "runs/old")
    before = sorted(tmp_path.rglob("*"))
    for command in ("create", "capture"):
        for place, words in (
            (tmp_path / "out", "is a file"),
            *((outer / name, f"inside the workspace {outer}") for name in ("runs", "sequences/other", "runs/new/deep")),
        ):
            shown = complaint(capsys, command, str(tmp_path / "a.mp4"), "--out", str(place))
            assert words in shown
            assert "disk space" not in shown
    assert ((tmp_path / "out").read_text(), sorted(tmp_path.rglob("*"))) == ("mine", before)
    refuses("is a file; give the folder of a workspace", open_workspace, tmp_path / "a.mp4")
    (tmp_path / "me/runs").mkdir(parents=True)
    refuses("there is no run yet; make one with `mien train", Workspace(tmp_path / "me").pick_run, None)


def test_every_row_of_the_table_names_a_test() -> None:
    rows = [line for line in DOCS.read_text(encoding="utf-8").splitlines() if line.startswith("| `")]
    assert len(rows) >= 9 * 3
    for row in rows:
        assert re.search(r"`test_\w+::test_\w+`", row), f"no test in: {row}"  # tests/test_docs.py looks for them


USD = ("usd", "usda", "usdc", "usdz")
ENDINGS = ("mien", "html", "packed", "glb", "ply", "spz", "sog", *(USD if importlib.util.find_spec("pxr") else ()))
COMMANDS: dict[str, tuple[str, ...]] = {
    **{ending: ("export", "W", "--out", f"D/a.{ending}") for ending in ENDINGS},
    "series": ("export", "W", "--out", "D/a.ply", "--series", "clip"),
    "folder": ("export", "W", "--out", "D/a", "--format", "gaussian-avatars"),
    "converted": ("export", "me.mien", "--out", "D/a.html"),
    "picture": ("render", "W", "--out", "D/a.png", "--size", "32"),
    "pictures": ("render", "W", "--out", "D/a", "--size", "32", "--path", "sway", "--frames", "3"),
    "mp4": ("render", "W", "--out", "D/a.mp4", "--size", "64", "--path", "sway", "--frames", "4"),
    "webm": ("render", "W", "--out", "D/a.webm", "--size", "64", "--path", "sway", "--frames", "4"),
    "drive": ("drive", "W", "--by", "W", "--out", "D/a.mp4", "--size", "32"),
    **({"usd series": ("export", "W", "--out", "D/a.usdz", "--series", "clip")} if "usdz" in ENDINGS else {}),
}
NOISE = np.random.default_rng(0).integers(0, 255, (4, 64, 64, 3), dtype=np.uint8)
WRITERS: dict[str, Callable[[Path], object]] = {
    "avatar": lambda folder: write_avatar(folder, new_avatar("gaussian_avatars")),
    "json": lambda folder: write_json(folder / "a.json", "x", 1, {"text": "x" * 2000}),
    "tensors": lambda folder: write_tensors(folder / "a.safetensors", {"a": torch.zeros(1000)}),
    "arrays": lambda folder: write_arrays(folder / "a.safetensors", {"a": np.zeros(1000)}),
    "capture": lambda folder: write_capture(folder / "capture", toy_sequence(3, 64)[1].capture),
    "tracking": lambda folder: write_tracking(folder / "tracking", toy_sequence(30, 32)[1].tracking),
    "video": lambda folder: write_video(folder / "a.mp4", list(NOISE), 25.0),
    "film": lambda folder: write_pictures(plan_output(folder / "a:b.mp4", 4), list(NOISE), 25.0),
}


@contextmanager
def small_disk(size: int) -> Iterator[None]:
    """Limit the size of every file, as a full disk would. This needs no rights."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def files_of(disk: Path) -> dict[str, bytes]:
    return {str(path.relative_to(disk)): path.read_bytes() for path in disk.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_is_told_and_nothing_half_written_stays(name: str, tmp_path: Path) -> None:
    """Nor is what was there before lost. A capture keeps hidden parts, from which it continues."""

    def write_on_a_full_disk() -> dict[str, bytes]:
        with small_disk(500):
            assert str(tmp_path) in refuses("free disk space", WRITERS[name], tmp_path)
        return {path: data for path, data in files_of(tmp_path).items() if ".partial" not in path}

    assert write_on_a_full_disk() == {}, "half-written files"
    WRITERS[name](tmp_path)
    before = files_of(tmp_path)
    assert write_on_a_full_disk() == before


@pytest.fixture
def given(made_once: MadeOnce) -> Path:
    """Return a folder with a workspace, W and an avatar."""

    def make(folder: Path) -> None:
        shutil.copytree(toy_workspace(made_once), folder / "W")
        assert main(["export", str(folder / "W"), "--out", str(folder / "me.mien")]) == 0

    return made_once("given_to_full_disks", make)


@pytest.fixture(params=["limit", "mount"])
def disk(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Return a folder, and what fills its disk: a limit, or a disk of 16 MiB in memory.
    On the latter, the temporary files of libraries are on the full disk, too."""
    if request.param == "limit":
        yield tmp_path, small_disk
        return
    place = Path(tempfile.mkdtemp(prefix="mien-disk-"))
    mount = ["mount", "-t", "tmpfs", "-o", "size=16m", "tmpfs", str(place)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True, check=False).returncode:
        place.rmdir()
        pytest.skip(NO_MOUNT)
    (place / "out").mkdir()

    @contextmanager
    def filled(left: int) -> Iterator[None]:
        filler = place / "filler"
        with filler.open("wb") as file, monkeypatch.context() as patched:
            os.posix_fallocate(file.fileno(), 0, shutil.disk_usage(place).free - left // 4096 * 4096)
            patched.setattr(tempfile, "tempdir", str(place))
            yield
        filler.unlink()

    yield place / "out", filled
    subprocess.run(["umount", "-l", str(place)], check=True)
    place.rmdir()


@pytest.mark.parametrize("name", COMMANDS)
def test_an_export_on_a_full_disk_keeps_the_earlier_file(name: str, given, disk: Any, capsys, monkeypatch) -> None:
    """Write once, then on a disk that is filled at a random place, then again."""
    monkeypatch.setattr(write_glb, "__defaults__", (128,))  # the usual size takes ten seconds
    folder, filled = disk
    places = {"W": given / "W", "me.mien": given / "me.mien"}
    line = [str(places.get(word, word)) for word in COMMANDS[name]]
    line = [word.replace("D/", f"{folder}/") if word.startswith("D/") else word for word in line]
    assert main(line) == 0
    before = files_of(folder)
    capsys.readouterr()
    with filled(random.Random(1).randrange(0, max(map(len, before.values())) * 9 // 10)):
        assert main(line) == 2
        kept = files_of(folder)
    (said,) = (text for text in capsys.readouterr().err.splitlines() if text.startswith("mien: "))
    assert f"mien: {folder}" in said
    assert "free disk space" in said
    assert set(kept) == set(before), "nothing half-written"
    if name not in ("series", "pictures"):  # of these, files that were whole before the disk was full are new
        assert kept == before
    assert main(line) == 0
    assert set(files_of(folder)) == set(before)
