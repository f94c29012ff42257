"""Captures on disk survive a round trip and report damage. Long clips take bounded memory."""

import dataclasses
import os
import shutil
import weakref
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from bounded_memory import MIB, allocating_at_most
from capture_helpers import assert_same_capture, random_capture, tree_bytes, write_face_clip
from damage import edit_json
from mien.camera import camera_from_fov
from mien.capture import capture_video, process, read_capture, write_capture
from mien.capture.frame_files import FrameLayout
from mien.capture.settings import CaptureSettings
from mien.capture.store import capture_bytes, check_room, read_capture_hash
from mien.cli import main
from mien.media import picture_files
from mien.media.picture_files import map_pictures
from mien.tracking import track
from mien.tracking.fitting import solver
from mien.tracking.landmarks import stages, term
from mien.tracking.landmarks.model import LandmarkModel
from mien.tracking.scoring import make_scoring
from mien.tracking.scoring_files import read_scoring, write_scoring
from needs import NO_PROC
from refusals import refuses
from small_face_model import make_small_face_model
from test_tracking_scoring import _tracking, _upright
from tracking_case import capture_of, make_tracking_case


@pytest.fixture
def stored(tmp_path):
    path = tmp_path / "capture"
    write_capture(path, random_capture())
    return path


def test_round_trip_is_exact_and_maps_memory(tmp_path):
    capture = random_capture()
    cameras = tuple(camera_from_fov(0.5 + 0.1 * index, capture.width, capture.height) for index in range(2))
    hashes = {write_capture(tmp_path / "capture", each) for each in (capture, capture)}
    read = read_capture(tmp_path / "capture")
    assert_same_capture(capture, read)
    assert read.calibration is None
    assert isinstance(read.images, np.memmap)
    assert isinstance(read.mattes, np.memmap)
    assert {read_capture_hash(tmp_path / "capture")} == hashes
    assert [entry.name for entry in tmp_path.iterdir()] == ["capture"]
    hashes.add(write_capture(tmp_path / "known", dataclasses.replace(capture, calibration=cameras)))
    for expected, camera in zip(cameras, read_capture(tmp_path / "known").calibration or (), strict=True):
        assert torch.equal(camera.K, expected.K)
        assert torch.equal(camera.viewmat, expected.viewmat)
        assert (camera.width, camera.height) == (capture.width, capture.height)
    for field in ("images", "mattes", "landmarks", "timestamps"):
        changed = getattr(capture, field).copy()
        changed.flat[0] += 1
        hashes.add(write_capture(tmp_path / field, dataclasses.replace(capture, **{field: changed})))
    assert len(hashes) == 6


def flip(path, place=7):
    content = bytearray(path.read_bytes())
    content[place] ^= 255
    path.write_bytes(content)


def test_stale_cache_is_rebuilt(stored):
    before, raw = tree_bytes(stored), stored / "cache/frames.u8"

    def clear_without_stamp() -> None:
        (stored / "cache/stamp.json").unlink()
        raw.write_bytes(bytes(raw.stat().st_size))

    for damage in (
        lambda: shutil.rmtree(stored / "cache"), lambda: os.truncate(raw, 100), lambda: flip(raw), clear_without_stamp,
        lambda: os.utime(stored / "frames/camera0/000001.png", ns=(1, 1)),
    ):  # fmt: skip
        damage()
        assert_same_capture(random_capture(), read_capture(stored))
        assert tree_bytes(stored) == before
    shutil.rmtree(stored / "cache")
    (stored / "cache").touch()  # a file in the way, as a read-only disk would be for a user
    assert_same_capture(random_capture(), read_capture(stored))


def edit(**content):
    return lambda path: edit_json(path / "capture.json", lambda entries: entries.update(content))


DAMAGES = [
    (lambda path: (path / "capture.json").unlink(), "capture.json: missing"),
    (edit(version=2), "version 2, expected"),
    (edit(format="mien.tracking"), "expected 'mien.capture'"),
    (edit(timesteps=2), "expected uint64 .2, 2."),
    (edit(fps=0), "frame rate, name or source"),
    (edit(fps=25.0), "does not belong"),
    (lambda path: (path / "frames/camera1/000002.png").unlink(), "000002.png: missing"),
    (lambda path: shutil.rmtree(path / "mattes/camera1"), "missing .3 of 3 are"),
    (lambda path: flip(path / "frames/camera0/000002.png", 700), "000002.png: (damaged|its pixels have changed)"),
    (lambda path: shutil.copy(path / "frames/camera1/000001.png", path / "frames/camera0/000000.png"),
     "000000.png: its pixels have changed"),
]  # fmt: skip


def test_every_damage_is_named(stored, tmp_path):
    for index, (damage, message) in enumerate(DAMAGES):
        path = tmp_path / str(index) / "capture"
        shutil.copytree(stored, path)
        damage(path)
        error = refuses(message, read_capture, path)
        assert str(path) in error, message
        assert "`mien capture`" in error, message
    refuses("no capture there", read_capture, tmp_path / "nowhere")


def test_only_captures_are_replaced(stored, tmp_path):
    replacement = random_capture(seed=1)
    write_capture(stored, replacement)
    assert_same_capture(replacement, read_capture(stored))
    chapter = tmp_path / "thesis/chapter1.txt"
    chapter.parent.mkdir()
    chapter.write_text("do not delete")
    for place, refusal in (
        (chapter.parent, "not part of a capture"), (chapter, "is a file"), (chapter / "below", "cannot be written")
    ):  # fmt: skip
        refuses(refusal, write_capture, place, replacement)
    assert chapter.read_text() == "do not delete"


def leave(monkeypatch: pytest.MonkeyPatch, free: int) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(total=1 << 40, used=0, free=free))


def test_what_an_interrupted_run_has_written_counts_as_room_and_a_hole_in_a_file_does_not(
    tmp_path, monkeypatch
) -> None:
    out = tmp_path / "capture"
    layout = FrameLayout(tmp_path / "work", ("front",), 100, 200, 200)
    cache = layout.folder / "cache"
    cache.mkdir(parents=True)
    leave(monkeypatch, capture_bytes(layout) - 10**6)
    with (cache / "hole.u8").open("wb") as file:
        file.truncate(10**8)
    refuses("left", check_room, layout, "s", out)
    (cache / "frames.u8").write_bytes(bytes(range(256)) * 8000)
    check_room(layout, "s", out)


def test_too_little_room_is_refused_before_a_picture_is_written(test_data, tmp_path, monkeypatch, capsys) -> None:
    clip = tmp_path / "face.mp4"
    write_face_clip(clip, test_data)
    leave(monkeypatch, 10**6)
    with monkeypatch.context() as patched:
        patched.setattr(process, "FrameWriter", lambda *_: pytest.fail("pictures were written"))
        assert main(["capture", str(clip), "--out", str(tmp_path / "w"), "--capture.size", "200"]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert "12 frames of 200x200 take about 3 MB on disk, and there are 1 MB left; free disk space" in error
    assert not (tmp_path / "w" / "sequences").exists()
    leave(monkeypatch, 10**9)
    assert capture_video(clip, tmp_path / "capture", CaptureSettings(size=200)).timesteps == 12


@pytest.fixture
def _tiny_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limit the memory of mapped pictures to a mebibyte."""
    monkeypatch.setattr(picture_files, "MAX_MAPPED_BYTES", MIB)
    monkeypatch.setattr(picture_files, "MAX_HELD_BYTES", MIB)


def mapped_bytes() -> int:
    """Return the bytes of file pages in this process's memory."""
    status = Path("/proc/self/status")
    if not status.is_file():
        pytest.skip(NO_PROC)
    line = next(line for line in status.read_text().splitlines() if line.startswith("RssFile"))
    return int(line.split()[1]) << 10


def largest_share(pictures: np.ndarray) -> int:
    """Return the growth of the mapped pages while every picture is read."""
    before, most = mapped_bytes(), 0
    for index in np.ndindex(pictures.shape[:2]):
        pictures[index].sum()
        most = max(most, mapped_bytes() - before)
    return most


@pytest.mark.usefixtures("_tiny_limit")
def test_maps_and_captures_give_their_pages_back(tmp_path: Path) -> None:
    file, shape = tmp_path / "pictures.u8", (64, 1, 512, 512)
    file.write_bytes(bytes(range(256)) * (64 << 10))
    pictures, held = map_pictures(file, shape), np.memmap(file, np.uint8, "r", shape=shape)
    assert largest_share(pictures) < 6 * MIB
    assert largest_share(held) > 12 * MIB, "the test sees what is held"
    np.testing.assert_array_equal(pictures, held)
    assert largest_share(pictures[:, 0][:, None]) < 6 * MIB, "views count, too"
    write_capture(tmp_path / "capture", random_capture(timesteps=40, height=256, width=300))
    images = read_capture(tmp_path / "capture").images
    assert images.nbytes > 16 * MIB
    assert largest_share(images) < 6 * MIB


@pytest.mark.usefixtures("_tiny_limit")
@pytest.mark.unchecked
def test_scoring_is_made_written_and_read_without_being_held(tmp_path: Path) -> None:
    model, face = _upright(64)
    short, long = (capture_of(torch.full((timesteps, 478, 2), 100.0)) for timesteps in (2, 64))
    expected = make_scoring(short, _tracking(model, face[:2]), model)
    write_scoring(tmp_path / "short", expected, "so that all code is in the memory before it is measured")
    before = mapped_bytes()
    with allocating_at_most(12 * MIB):
        made = make_scoring(long, _tracking(model, face), model, scratch=tmp_path)
        write_scoring(tmp_path / "scoring", made, "of this capture")
        read = read_scoring(tmp_path / "scoring", "of this capture")
    assert read.masks.nbytes == 16 * MIB
    assert mapped_bytes() - before < 6 * MIB
    left = sorted(entry.name for entry in tmp_path.iterdir())
    assert left == ["scoring", "short"], "files for the time being have no name"
    np.testing.assert_array_equal(read.masks, made.masks)
    np.testing.assert_array_equal(read.masks[7], expected.masks[1])


@pytest.mark.unchecked
def test_tracking_looks_at_a_bounded_number_of_frames_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    case = make_tracking_case(timesteps=24)
    model = make_small_face_model()
    expected = track(case.capture, model)
    largest = {"project": 0, "linearize": 0}
    for name in largest:
        original = getattr(LandmarkModel, name)

        def watched(self, state, *arguments, original=original, name=name, **options):
            largest[name] = max(largest[name], len(state))
            return original(self, state, *arguments, **options)

        monkeypatch.setattr(LandmarkModel, name, watched)
    monkeypatch.setattr(term, "PROJECTED", 16)
    monkeypatch.setattr(term, "LINEARIZED", 14)
    monkeypatch.setattr(stages, "FRAMES_AT_ONCE", 18)
    monkeypatch.setattr(solver, "SEGMENT", 5)
    found = track(case.capture, model)
    assert largest == {"project": 16, "linearize": 14}
    for name, tensor in expected.face.tensors().items():
        torch.testing.assert_close(getattr(found.face, name), tensor, atol=1e-6, rtol=0)


def test_the_chain_holds_the_factors_of_one_segment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(solver, "SEGMENT", 4)
    alive: weakref.WeakSet[torch.Tensor] = weakref.WeakSet()
    most = 0
    cholesky = torch.linalg.cholesky

    def watched(matrix: torch.Tensor) -> torch.Tensor:
        nonlocal most
        factor = cholesky(matrix)
        alive.add(factor)
        most = max(most, len(alive))
        return factor

    monkeypatch.setattr(torch.linalg, "cholesky", watched)
    random, blocks, size = torch.Generator().manual_seed(0), 19, 3
    root, upper = torch.randn(2, blocks, size, size, generator=random, dtype=torch.float64)
    own = root @ root.mT + 5 * torch.eye(size, dtype=torch.float64)
    right = torch.randn(blocks, size, generator=random, dtype=torch.float64)
    solver.solve_tridiagonal(own.__getitem__, upper.__getitem__, right)
    assert most <= 6, most
