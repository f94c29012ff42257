"""A stranger's workspace leads nowhere else, and is refused if its files do not fit together.
mien follows no link and no name out of it. Single values are in `fuzzing.values`."""

import json
import os
import shutil
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from capture_helpers import assert_same_capture
from damage import edit_json
from mien.capture import read_capture
from mien.capture.frame_files import CacheWriter, FrameLayout, FrameWriter
from mien.disk.files import file_digest, read_tensors, write_tensors
from mien.disk.reading import check_tree, inside, is_plain_name, remove_tree
from mien.disk.workspace import Workspace, check_new_workspace, open_workspace
from mien.evaluation import evaluate
from mien.evaluation.experiment import Frame
from mien.evaluation.protocols import EvaluationSettings, PartialScores
from mien.face.loading import read_landmarks
from mien.tracking import read_tracking, track_subject
from mien.tracking.pipeline import track as pipeline
from mien.tracking.scoring_files import read_scoring
from mien.tracking.settings import TrackingSettings
from mien.training import read_sequence, trainer
from mien.training.run import read_run_config
from refusals import complaint, refuses
from shared_things import MadeOnce, evaluated_workspace
from toy_scene import toy_face_model, toy_sequence

COMMANDS = (
    "render W --out OUT/a.png --size 32", "view W", "export W --out OUT/a.ply",
    "drive W --by W --out OUT/b.mp4 --size 32", "evaluate W --no-perceptual", "evaluate compare W",
    "train W --run other --steps 1", "track W", "capture OUT/clip.mp4 --out W", "create OUT/clip.mp4 --out W",
    "export W --out OUT/folder --format gaussian-avatars", "import OUT/avatar --out W",
    "analyze gaussian-avatars W --parts growth", "study make W --out OUT/a.html",
    "bench compare W --out OUT/compared --steps 1",
)  # fmt: skip
FOLDERS = (
    "sequences", "runs", "sequences/clip", "sequences/clip/capture", "sequences/clip/capture/cache",
    "sequences/clip/capture/frames/front", "sequences/clip/.capture.partial", "sequences/clip/scoring/masks",
    "sequences/.tracking-0123", "runs/toy", "runs/toy/avatar", "runs/toy/pictures", "runs/other",
)  # fmt: skip
FILES = (
    "sequences/clip/capture/cache/frames.u8", "sequences/clip/capture/frames/front/000001.png",
    "sequences/clip/tracking/report.html", "sequences/clip/scoring/masks/00/000000.png", "runs/toy/config.json",
    "runs/toy/avatar/avatar.safetensors", "runs/toy/.self_reenactment_tail.partial",
)  # fmt: skip


@pytest.fixture
def workspace(made_once: MadeOnce, tmp_path: Path) -> Path:
    return shutil.copytree(evaluated_workspace(made_once), tmp_path / "received", copy_function=shutil.copy2)


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


@pytest.mark.parametrize("place", ["sequences/clip/capture/cache", "runs/toy/avatar/avatar.safetensors", "a pipe"])
def test_no_command_follows_a_link(place: str, workspace: Path, victim: Path, tmp_path: Path, capsys) -> None:
    """Nor waits for a pipe."""
    out, told, began = tmp_path / "out", f"{workspace / place}: is a link", time.monotonic()
    if place == "a pipe":
        config = workspace / "runs/toy/config.json"
        config.unlink()
        os.mkfifo(config)
        told = f"{config}: is not an ordinary file"
        refuses("not an ordinary file", read_run_config, config.parent)
    else:
        put(workspace / place, victim / "notes" if "." in place else victim)
    (out / "avatar").mkdir(parents=True)
    (out / "clip.mp4").write_bytes(b"no video")
    (out / "avatar" / "flame_param.npz").touch()  # so that `mien import` knows what it is
    for command in COMMANDS:
        words = [word.replace("OUT", str(out)) for word in command.split()]
        assert told in complaint(capsys, *(workspace if word == "W" else word for word in words)), command
    assert time.monotonic() - began < 60


def test_links_are_found_wherever_they_are(made_once: MadeOnce, tmp_path: Path, victim: Path) -> None:
    """Every command first calls one of both functions."""
    for number, place in enumerate((*FOLDERS, *FILES)):
        received = shutil.copytree(evaluated_workspace(made_once), tmp_path / str(number), copy_function=os.link)
        put(received / place, victim / "notes" if place in FILES else victim)
        for door in (open_workspace, check_new_workspace):
            error = refuses("a link", door, received)
            assert str(received / place) in error


def test_an_analysis_goes_to_no_link(workspace: Path, victim: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A folder that the user names may be reached by a link, but nothing in it may be one."""
    command = ["analyze", "gaussian-avatars", str(workspace), "--parts", "growth"]
    own, other = workspace / "analysis/toy", workspace.parent / "out"
    for place in (own / "runs", own / "growth-gaussians.svg", own, own.parent, other / "runs", other / "analysis.json"):
        put(place, victim / "notes" if "." in place.name else victim)
        options = ["--out", other] if other in place.parents else []
        assert f"mien: {place}: is a link" in complaint(capsys, *command, *options)
        place.unlink()


def test_the_library_follows_no_link_either(workspace: Path, victim: Path, tmp_path: Path) -> None:
    """Readers check for themselves, since no command has checked the workspace. Files are in `test_damage`."""
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
        refuses("a link", read)
        place.unlink()
        if aside.exists():
            aside.rename(place)
    (tmp_path / "link").symlink_to(workspace)  # the workspace itself may be reached by one
    open_workspace(tmp_path / "link")
    assert read_capture(tmp_path / "link/sequences/clip/capture").timesteps == 5
    named_as_ours = (clip / "capture").rename(workspace / "mien-capture-mine")  # as our scratch folders, yet it stays
    for _ in range(2):
        assert read_capture(named_as_ours).timesteps == 5


def test_nothing_is_written_through_links_nor_second_names(workspace: Path, tmp_path: Path, victim: Path) -> None:
    folder = workspace / "sequences/clip/capture"
    whole, raw = read_capture(folder), folder / "cache/frames.u8"
    raw.unlink()
    os.link(victim / "frames.u8", raw)
    assert_same_capture(read_capture(folder), whole)
    partial = PartialScores(tmp_path / ".a.partial", "0123")
    layout = FrameLayout(folder, ("front",), 5, 32, 32)
    for path, write in (
        (raw, lambda: CacheWriter(layout)), (tmp_path / ".a.partial", lambda: partial.add(Frame(0, 0, 0), {}, 0.0))
    ):  # fmt: skip
        for make in (os.symlink, os.link):
            path.unlink(missing_ok=True)
            make(victim / "frames.u8", path)
            refuses("is a link|has another name elsewhere", write)
    assert partial.read() == {}
    layout = FrameLayout(tmp_path / "capture", ("0",), 2, 4, 4)
    (layout.folder / "frames/0").mkdir(parents=True)
    layout.png("frames", 0, 0).symlink_to(victim / "000000.png")
    os.link(victim / "notes", layout.png("frames", 1, 0))
    with FrameWriter(layout) as writer:
        for timestep in range(2):
            writer.submit(timestep, lambda: (np.zeros((1, 4, 4, 3), np.uint8), np.zeros((1, 4, 4), np.uint8)))
        writer.flush()
    assert not layout.png("frames", 0, 0).is_symlink()
    # What is removed is the link, and not what it leads to.
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder/link").symlink_to(victim)
    (tmp_path / "link").symlink_to(victim)
    for name in ("folder", "link", "missing"):
        remove_tree(tmp_path / name)
        assert not os.path.lexists(tmp_path / name)


def test_names_that_lead_elsewhere(tmp_path: Path) -> None:
    """Files that hold such names are in `fuzzing.values`."""
    names: tuple[Any, ...] = ("", ".", "..", "../x", "/x", "a/b", "a\\b", "a\0b", "a\x1b[2J", "a\nb", "é" * 200, 3)
    for name in names:
        assert not is_plain_name(name)
        for find in (lambda name: inside(tmp_path, name), Workspace(tmp_path).run_dir)[: 1 + isinstance(name, str)]:
            refuses("give a plain name", find, name)
    for name in ("../x", "/etc/x", "a\0b", ""):
        refuses("cannot be the name of a face model", read_landmarks, name, toy_face_model())
    for name in ("clip", "Anna 2", "a:b", "12\u202fAM", "ü", "声", ".hidden"):
        assert inside(tmp_path, name) == tmp_path / name


def test_a_deep_tree_is_told(tmp_path: Path) -> None:
    """A tree that is deeper than a path can be is reported."""
    place = os.open(tmp_path, os.O_RDONLY)
    for _ in range(30):
        os.mkdir("d" * 200, dir_fd=place)
        below = os.open("d" * 200, os.O_RDONLY, dir_fd=place)
        os.close(place)
        place = below
    os.close(place)
    refuses("cannot be searched", check_tree, tmp_path)


def test_partial_figures_of_other_kinds_are_dropped(workspace: Path) -> None:
    """Partial figures with impossible content are dropped, although their first line is right."""
    run, clip = workspace / "runs/toy", workspace / "sequences/clip"
    settings = EvaluationSettings(perceptual=False, video_frames=0)
    fingerprint = next(iter(json.loads((run / "metrics.json").read_text())["fingerprints"].values()))
    for line in (
        '{"frame": [0, 4, 0], "scores": {"avatar": {"psnr": "high"}}, "seconds": 1}',
        f'{{"frame": [0, {10**400}, 0], "scores": {{}}, "seconds": 1}}',
        "[" * 5000,
    ):
        (run / ".self_reenactment_tail.partial").write_text(f'{{"scores_of": "{fingerprint}"}}\n{line}\n')
        assert evaluate(run, [clip], settings)["protocols"]["self_reenactment_tail"]["psnr"] > 0


def test_a_picture_larger_than_it_should_be_is_not_decoded(workspace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its header claims 30,000 x 30,000 pixels."""
    folder = workspace / "sequences/clip"
    decoded: list[object] = []
    monkeypatch.setattr("mien.media.picture_files.cv2.imdecode", lambda *arguments: decoded.append(arguments))
    shutil.rmtree(folder / "capture/cache")
    for file, read in (
        (folder / "capture/frames/front/000000.png", lambda: read_capture(folder / "capture")),
        (folder / "scoring/masks/00/000000.png", lambda: read_scoring(folder / "scoring")),
    ):
        data = file.read_bytes()
        file.write_bytes(data[:16] + (30000).to_bytes(4, "big") * 2 + data[24:])
        refuses("damaged, or not of 32x32 pixels", read)
    assert decoded == []
    assert not (folder / "capture/cache/frames.u8").exists()


def test_parts_of_a_sequence_have_to_be_of_the_same_pictures(workspace: Path) -> None:
    clip = workspace / "sequences/clip"
    path = clip / "tracking/tracking.safetensors"
    tensors = read_tensors(path)
    for name in ("expression", "joints", "head_rotation", "head_translation", "valid", "neck_lines", "residuals"):
        tensors[name] = tensors[name][:3].clone()
    write_tensors(path, tensors)
    edit_json(path.with_suffix(".json"), lambda content: content.update(tensors_sha256=file_digest(path)))
    read_tracking(clip / "tracking")
    refuses("other pictures than the capture", read_sequence, clip)


def test_kept_pieces_of_a_tracking_that_are_of_no_use(workspace: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    """Tracking starts again, once, if the kept files are whole but hold something else."""
    keep, seen = tmp_path / ".tracking-0123", []
    keep.mkdir()

    def fit(captures: object, model: object, settings: object, keep: Path, *others: object) -> list[object]:
        seen.append(keep.exists())
        if keep.exists():
            raise KeyError("rows")
        return []

    monkeypatch.setattr(pipeline, "track_once", fit)
    capture = read_capture(workspace / "sequences" / "clip" / "capture")
    arguments: Any = ([capture], toy_face_model(), TrackingSettings(), keep, None)
    assert track_subject(*arguments) == []
    assert seen == [True, False]
    assert "starts again" in capsys.readouterr().err
    monkeypatch.setattr(pipeline, "track_once", lambda *_: {}["a bug of ours"])
    pytest.raises(KeyError, track_subject, *arguments)


def test_a_tracking_with_the_hash_of_another_model_names_its_folder(tmp_path: Path) -> None:
    model, sequence = toy_sequence(timesteps=2, size=32)
    foreign = replace(sequence, folder=tmp_path, tracking=replace(sequence.tracking, face_model_hash="f" * 16))
    refuses(f"^{tmp_path}: was tracked with another version of face model", trainer.check_trackings, [foreign], model)
