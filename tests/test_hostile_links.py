"""A workspace from a stranger leads nowhere else: mien follows no link and no name out of it."""

import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from capture_helpers import assert_same_capture
from mien.capture import read_capture
from mien.capture.frame_files import CacheWriter, FrameLayout, FrameWriter
from mien.cli import main
from mien.errors import UserError
from mien.evaluation import evaluate
from mien.evaluation.experiment import Frame
from mien.evaluation.partial import PartialScores
from mien.inside import check_tree, inside, is_plain_name, open_new, remove_tree
from mien.tracking import read_scoring
from mien.training import read_run_config
from mien.workspace import Workspace, check_new_workspace, open_workspace
from shared_things import MadeOnce, evaluated_workspace

COMMANDS = (
    "render W --out OUT/a.png --size 32",
    "view W",
    "export W --out OUT/a.ply",
    "drive W --by W --out OUT/b.mp4 --size 32",
    "evaluate W --no-perceptual",
    "evaluate W --compare",
    "train W --run other --steps 1",
    "track W",
    "capture OUT/clip.mp4 --out W",
    "create OUT/clip.mp4 --out W",
    "export W --out OUT/folder --format gaussian-avatars",
    "import OUT/avatar --out W",
    "analyze gaussian-avatars W --parts growth",
    "study make W --out OUT/a.html",
    "bench compare W --out OUT/compared --steps 1",
)
FOLDERS = (
    "sequences", "runs", "sequences/clip", "sequences/clip/capture", "sequences/clip/capture/cache",
    "sequences/clip/capture/frames", "sequences/clip/capture/frames/front", "sequences/clip/.capture.partial",
    "sequences/clip/scoring/masks", "sequences/clip/tracking", "sequences/.tracking-0123", "runs/toy",
    "runs/toy/avatar", "runs/toy/checkpoints", "runs/toy/videos", "runs/toy/pictures", "runs/other",
)  # fmt: skip
FILES = (
    "sequences/clip/capture/cache/frames.u8", "sequences/clip/capture/cache/stamp.json",
    "sequences/clip/capture/frames/front/000001.png", "sequences/clip/capture/capture.json",
    "sequences/clip/tracking/report.html", "sequences/clip/tracking/overlay.mp4",
    "sequences/clip/scoring/masks/00/000000.png", "runs/toy/config.json", "runs/toy/report.html",
    "runs/toy/avatar/avatar.safetensors", "runs/toy/.self_reenactment_tail.partial",
)  # fmt: skip


@pytest.fixture
def made(made_once: MadeOnce) -> Path:
    return evaluated_workspace(made_once)


@pytest.fixture
def workspace(made: Path, tmp_path: Path) -> Path:
    return shutil.copytree(made, tmp_path / "received", copy_function=shutil.copy2)


@pytest.fixture
def victim(tmp_path: Path) -> Iterator[Path]:
    """Return a folder of the user that must not change."""
    folder = tmp_path / "home"
    (folder / "deep").mkdir(parents=True)
    for name in ("frames.u8", "000000.png", "deep/a.txt", "notes"):
        (folder / name).write_bytes(b"mine " * 100)
    before = {path: path.is_file() and path.read_bytes() for path in folder.rglob("*")}
    yield folder
    assert {path: path.is_file() and path.read_bytes() for path in folder.rglob("*")} == before


def put(link: Path, target: Path) -> None:
    remove_tree(link)
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(target)


def run_all(workspace: Path, out: Path, capsys: pytest.CaptureFixture[str], told: str) -> None:
    out.mkdir(exist_ok=True)
    (out / "clip.mp4").write_bytes(b"no video")
    (out / "avatar").mkdir(exist_ok=True)
    (out / "avatar" / "flame_param.npz").touch()  # so that `mien import` knows what it is
    for command in COMMANDS:
        arguments = [word.replace("W", str(workspace)) if word == "W" else word.replace("OUT", str(out))
                     for word in command.split()]  # fmt: skip
        assert main(arguments) == 2, command
        error = capsys.readouterr().err.strip()
        assert told in error, command
        assert "\n" not in error, command


@pytest.mark.parametrize("place", ["runs", "sequences/clip/capture/cache", "runs/toy/avatar/avatar.safetensors"])
def test_no_command_follows_a_link(
    place: str, workspace: Path, victim: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    put(workspace / place, victim / "notes" if "." in place else victim)
    run_all(workspace, tmp_path / "out", capsys, f"{workspace / place}: is a link")


def test_links_are_found_wherever_they_are(made: Path, tmp_path: Path, victim: Path) -> None:
    """Every command first calls one of both functions."""
    for number, place in enumerate((*FOLDERS, *FILES)):
        received = shutil.copytree(made, tmp_path / str(number), copy_function=os.link)
        put(received / place, victim / "notes" if place in FILES else victim)
        for door in (open_workspace, check_new_workspace):
            with pytest.raises(UserError, match="a link") as error:
                door(received)
            assert str(received / place) in str(error.value)


def test_a_pipe_is_not_waited_for(workspace: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    place, began = workspace / "runs/toy/config.json", time.monotonic()
    place.unlink()
    os.mkfifo(place)
    run_all(workspace, tmp_path / "out", capsys, f"{place}: is not an ordinary file")
    with pytest.raises(UserError, match="not an ordinary file"):
        read_run_config(workspace / "runs/toy")
    assert time.monotonic() - began < 60


def test_an_analysis_goes_to_no_link(workspace: Path, victim: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A folder that the user names may be reached by a link, but nothing in it may be one."""
    command = ["analyze", "gaussian-avatars", str(workspace), "--parts", "growth"]
    own, other = workspace / "analysis/toy", workspace.parent / "out"
    for place in (own / "runs", own / "analysis.json", own / "growth-ratio.png", own, own.parent, other / "runs",
                  other / "analysis.json", other / "growth-ratio.png"):  # fmt: skip
        put(place, victim / "notes" if "." in place.name else victim)
        assert main([*command, "--out", str(other)] if other in place.parents else command) == 2
        assert f"mien: {place}: is a link" in capsys.readouterr().err
        place.unlink()


def test_an_avatar_is_not_imported_through_links(
    workspace: Path, victim: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, out = tmp_path / "avatar", tmp_path / "new"
    assert main(["export", str(workspace), "--out", str(folder), "--format", "gaussian-avatars"]) == 0
    capsys.readouterr()
    for name in ("point_cloud.ply", "flame_param.npz", "face_model.json", "face_model.safetensors"):
        put(folder / name, victim / "notes")
        assert main(["import", str(folder), "--out", str(out)]) == 2, name
        error = capsys.readouterr().err
        assert f"mien: {folder / name}: is a link" in error
        assert error.count("\n") == 1
        assert not (out / "runs").exists()
        assert main(["export", str(workspace), "--out", str(folder), "--format", "gaussian-avatars"]) == 0
        capsys.readouterr()
        assert not (folder / name).is_symlink(), "a new file takes the place of the link"


def test_the_workspace_itself_may_be_reached_by_a_link(workspace: Path, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(workspace)
    open_workspace(tmp_path / "link")
    assert read_capture(tmp_path / "link/sequences/clip/capture").timesteps == 5


def test_the_library_follows_no_link_either(workspace: Path, victim: Path) -> None:
    """They check for themselves, since no command has checked the workspace. Files are in `test_damage`."""
    clip, run = workspace / "sequences/clip", workspace / "runs/toy"
    for place, read in (
        (clip / "capture/cache", lambda: read_capture(clip / "capture")),
        (clip / "scoring/masks/00", lambda: read_scoring(clip / "scoring")),
        (run / "videos", lambda: evaluate(run, [clip])),
    ):
        aside = workspace / "aside"
        if place.exists():
            place.rename(aside)
        put(place, victim)
        with pytest.raises(UserError, match="a link"):
            read()
        place.unlink()
        if aside.exists():
            aside.rename(place)


def test_a_cache_is_not_written_through_links_nor_second_names(workspace: Path, victim: Path) -> None:
    folder = workspace / "sequences/clip/capture"
    whole, raw = read_capture(folder), folder / "cache/frames.u8"
    raw.unlink()
    os.link(victim / "frames.u8", raw)
    assert_same_capture(read_capture(folder), whole)
    layout = FrameLayout(folder, ("front",), 5, 32, 32)
    for make in (lambda: raw.symlink_to(victim / "frames.u8"), lambda: os.link(victim / "frames.u8", raw)):
        raw.unlink()
        make()
        with pytest.raises(UserError, match="is a link|has another name elsewhere"):
            CacheWriter(layout)


def test_frames_are_not_written_through_links_nor_second_names(tmp_path: Path, victim: Path) -> None:
    layout = FrameLayout(tmp_path / "capture", ("0",), 2, 4, 4)
    (layout.folder / "frames/0").mkdir(parents=True)
    layout.png("frames", 0, 0).symlink_to(victim / "000000.png")
    os.link(victim / "notes", layout.png("frames", 1, 0))
    with FrameWriter(layout) as writer:
        for timestep in range(2):
            writer.submit(timestep, lambda: (np.zeros((1, 4, 4, 3), np.uint8), np.zeros((1, 4, 4), np.uint8)))
        writer.flush()
    assert not layout.png("frames", 0, 0).is_symlink()


def test_partial_figures_are_not_written_through_links_nor_second_names(tmp_path: Path, victim: Path) -> None:
    for make in (lambda path: path.symlink_to(victim / "notes"), lambda path: os.link(victim / "notes", path)):
        path = tmp_path / ".a.partial"
        path.unlink(missing_ok=True)
        make(path)
        partial = PartialScores(path, "0123")
        with pytest.raises(UserError, match="is a link|has another name elsewhere"):
            partial.add(Frame(0, 0, 0), {}, 0.0)
        assert partial.read() == {}
        assert not path.is_symlink()


def test_new_files_and_removed_folders_leave_what_links_lead_to(tmp_path: Path, victim: Path) -> None:
    (tmp_path / "file").symlink_to(victim / "notes")
    with open_new(tmp_path / "file") as file:
        file.write(b"ours")
    assert (tmp_path / "file").read_bytes() == b"ours"
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder/link").symlink_to(victim)
    (tmp_path / "link").symlink_to(victim)
    for name in ("folder", "link", "missing"):
        remove_tree(tmp_path / name)
        assert not os.path.lexists(tmp_path / name)


@pytest.mark.parametrize("name", ["", ".", "..", "../x", "/x", "a/b", "a\\b", "a\0b", "a\x1b[2J", "a\nb", "é" * 200, 3])
def test_names_that_lead_elsewhere(name: Any, tmp_path: Path) -> None:
    """Files that hold such names are in `fuzzing.values`."""
    assert not is_plain_name(name)
    with pytest.raises(UserError, match="give a plain name"):
        inside(tmp_path, name)
    if isinstance(name, str):
        with pytest.raises(UserError, match="give a plain name"):
            Workspace(tmp_path).run_dir(name)


@pytest.mark.parametrize("name", ["clip", "Anna 2", "a:b", "12\u202fAM", "ü", "声", ".hidden"])
def test_names_of_ordinary_files(name: str, tmp_path: Path) -> None:
    assert inside(tmp_path, name) == tmp_path / name


def test_a_deep_tree_is_told(tmp_path: Path) -> None:
    """A tree that is deeper than a path can be is reported."""
    top = os.open(tmp_path, os.O_RDONLY)
    place = top
    for _ in range(30):
        os.mkdir("d" * 200, dir_fd=place)
        below = os.open("d" * 200, os.O_RDONLY, dir_fd=place)
        os.close(place)
        place = below
    os.close(place)
    with pytest.raises(UserError, match="cannot be searched"):
        check_tree(tmp_path)


def test_a_capture_named_like_our_scratch_folder_is_not_removed(workspace: Path) -> None:
    folder = (workspace / "sequences/clip/capture").rename(workspace / "mien-capture-mine")
    assert read_capture(folder).timesteps == 5
    assert read_capture(folder).timesteps == 5
