"""Every export on a full disk: one line, exit code 2, and the file of before; then the same command succeeds."""

import importlib.util
import os
import random
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from mien.cli import main
from mien.export import write_glb
from needs import NO_MOUNT
from shared_things import MadeOnce, toy_workspace
from test_bad_input import small_disk

pytestmark = pytest.mark.unchecked
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


@pytest.fixture
def given(made_once: MadeOnce) -> Path:
    """Return a folder with a workspace, W and an avatar."""

    def make(folder: Path) -> None:
        shutil.copytree(toy_workspace(made_once), folder / "W")
        assert main(["export", str(folder / "W"), "--out", str(folder / "me.mien")]) == 0

    return made_once("given_to_full_disks", make)


@pytest.fixture(autouse=True)
def _small_textures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(write_glb, "__defaults__", (128,))  # the usual size takes ten seconds


def line_of(name: str, given: Path, disk: Path) -> list[str]:
    places = {"W": given / "W", "me.mien": given / "me.mien"}
    words = [str(places.get(word, word)) for word in COMMANDS[name]]
    return [word.replace("D/", f"{disk}/") if word.startswith("D/") else word for word in words]


def files_of(disk: Path) -> dict[str, bytes]:
    return {str(path.relative_to(disk)): path.read_bytes() for path in disk.rglob("*") if path.is_file()}


def expect_refusal(line: list[str], disk: Path, before: dict[str, bytes], capsys: Any) -> None:
    """Run a command that finds too little space. Each file of before keeps its bytes, and no other one appears."""
    capsys.readouterr()
    code = main(line)
    said = [text for text in capsys.readouterr().err.splitlines() if text.startswith("mien: ")]
    assert code == 2, f"exit code {code}: {said}"
    assert len(said) == 1
    assert f"mien: {disk}" in said[0]
    assert "free disk space" in said[0]
    kept = files_of(disk)
    assert {name: kept.get(name) for name in before} == before, "the files of before"


def tried(name: str, given: Path, disk: Path, capsys: Any, filled: Callable[[int], Any], seed: int) -> None:
    """Write once, then on a disk that is filled at a random place, then again."""
    line = line_of(name, given, disk)
    assert main(line) == 0
    before, whole = files_of(disk), max(map(len, files_of(disk).values()))
    numbered = name in ("series", "pictures")  # files that are whole before the disk is full stay
    with filled(random.Random(seed).randrange(0, whole * 9 // 10)):
        expect_refusal(line, disk, before if not numbered else {}, capsys)
    assert set(files_of(disk)) == set(before), "nothing half-written"
    assert main(line) == 0
    assert set(files_of(disk)) == set(before)


@pytest.mark.parametrize("name", COMMANDS)
def test_an_export_on_a_full_disk_keeps_the_earlier_file(
    name: str, given: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The size of files is limited, so this needs no rights."""
    tried(name, given, tmp_path, capsys, small_disk, seed=1)


@pytest.fixture
def disk() -> Iterator[Path]:
    """Return the folder of a disk of 16 MiB in memory."""
    place = Path(tempfile.mkdtemp(prefix="mien-disk-"))
    mount = ["mount", "-t", "tmpfs", "-o", "size=16m", "tmpfs", str(place)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True, check=False).returncode:
        place.rmdir()
        pytest.skip(NO_MOUNT)
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)
    place.rmdir()


@pytest.mark.parametrize("name", COMMANDS)
def test_an_export_on_a_small_disk_keeps_the_earlier_file(
    name: str, given: Path, disk: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The temporary files of libraries are on the full disk, too."""
    folder = disk / "out"
    folder.mkdir()

    @contextmanager
    def filled(left: int) -> Iterator[None]:
        filler = disk / "filler"
        with filler.open("wb") as file, monkeypatch.context() as patched:
            os.posix_fallocate(file.fileno(), 0, shutil.disk_usage(disk).free - left // 4096 * 4096)
            patched.setattr(tempfile, "tempdir", str(disk))
            yield
        filler.unlink()

    tried(name, given, folder, capsys, filled, seed=3)
