"""An interrupted tracking continues to the same numbers; its preview shows every stage and changes nothing."""

import os
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mien.capture import write_capture
from mien.cli import main
from mien.commands.stages import tracking as stage
from mien.tracking import TrackingSettings, track_subject
from mien.tracking.fitting import StageCache, layout_of, shot_of
from mien.tracking.landmarks import reduce_face_model, stages
from mien.tracking.pixels import refine
from mien.tracking.report import Preview, preview
from mien.tracking.settings import PaperSettings, PhotometricSettings
from photometric_case import FOCAL, assert_alike, make_photometric_case, make_textured_model

FAST = TrackingSettings(photometric=PhotometricSettings(texture_size=64, keyframes=4, shared_steps=1))
"""Settings with an unknown focal length, so that it has to be stored as well."""


def stops_after(piece: str, written: list[str], stop: Callable[[], object]):
    """Return a `StageCache.write` that collects the names of pieces, and stops the program after one of them."""
    write = StageCache.write

    def write_then_stop(self: StageCache, name: str, tensors: dict) -> None:
        write(self, name, tensors)
        written.append(name)
        if name == piece:
            stop()

    return write_then_stop


def interrupt() -> None:
    raise KeyboardInterrupt


@pytest.mark.unchecked
def test_goes_on_from_every_piece(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(stages, "FRAMES_AT_ONCE", 5)
    monkeypatch.setattr(refine, "FRAMES_AT_ONCE", 3)
    case, keep = make_photometric_case(timesteps=8), tmp_path / "kept"
    expected = track_subject([case.capture], case.model, FAST)[0]
    for piece in ("identity", "frames-0-0", "sequence-0", "step-0-0-equations-1", "round-1-shared-0", "lids"):
        before, written = {path.stem for path in keep.glob("*")}, []
        with monkeypatch.context() as patched:
            patched.setattr(StageCache, "write", stops_after(piece, written, interrupt))
            pytest.raises(KeyboardInterrupt, track_subject, [case.capture], case.model, FAST, keep)
        assert written[-1] == piece
        assert not before & set(written), "what was finished is done again"
        assert ("continues where it was interrupted" in capsys.readouterr().err) == bool(before)
    for name in ("sequence-1", "round-0"):
        whole = (keep / f"{name}.safetensors").read_bytes()
        (keep / f"{name}.safetensors").write_bytes(whole[: len(whole) // 2])
    assert_alike(expected, track_subject([case.capture], case.model, FAST, keep)[0])
    assert "round-0.safetensors: is damaged, so this part" in capsys.readouterr().err
    assert not keep.exists()


def track_until_killed(piece: str, *words: str) -> None:
    """Run `mien track` in a process that is killed after a piece of its fit."""
    StageCache.write = stops_after(piece, [], lambda: os.kill(os.getpid(), signal.SIGKILL))
    stage.face_model_of = lambda choice: make_textured_model()
    main(["track", *words])


@pytest.mark.unchecked
def test_killed_tracking_goes_on(tmp_path, monkeypatch, capsys, fork_server):
    monkeypatch.setattr(stage, "face_model_of", lambda choice: make_textured_model())
    pixels = {"texture-size": 64, "keyframes": 3, "shared-steps": 1}
    command = ["--overlay", "none", *(f"--tracking.photometric.{name}={value}" for name, value in pixels.items())]
    capture = replace(make_photometric_case(timesteps=3).capture, name="clip")
    for name in ("killed", "undisturbed"):
        write_capture(tmp_path / name / "sequences/clip/capture", capture)
    assert main(["track", str(tmp_path / "undisturbed"), *command]) == 0
    function, folder = f"{Path(__file__).stem}:track_until_killed", tmp_path / "killed"
    assert fork_server.call(function, "round-0-looks", str(folder), *command).wait() == -signal.SIGKILL
    sequences = folder / "sequences"
    assert not (sequences / "clip/tracking/tracking.json").exists()
    assert len(list(sequences.glob(".tracking-*/*.safetensors"))) >= 5
    capsys.readouterr()
    assert main(["track", str(folder), *command]) == 0
    assert "continues where it was interrupted" in capsys.readouterr().err
    assert not list(sequences.glob(".tracking-*"))
    files = [tmp_path / name / "sequences/clip/tracking/tracking.safetensors" for name in ("killed", "undisturbed")]
    assert files[0].read_bytes() == files[1].read_bytes()
    assert (sequences / "clip/tracking/report.html").is_file()
    assert not (sequences / "clip/tracking/overlay.mp4").exists()


def test_pieces_are_the_same_made_or_read(tmp_path):
    cache, odd = StageCache(tmp_path / "kept"), torch.arange(6.0).reshape(2, 3).T[1:]
    made = cache.get_or_compute("odd", lambda: {"odd": odd})
    read = cache.get_or_compute("odd", lambda: pytest.fail("it was kept"))
    assert torch.equal(made["odd"], read["odd"])
    assert made["odd"].stride() == read["odd"].stride()
    cache.drop("od")
    assert cache.read("odd") is None
    assert StageCache(None).get_or_compute("odd", lambda: {"odd": odd})["odd"].is_contiguous()
    cache.forget()
    assert not (tmp_path / "kept").exists()


SHOWN = TrackingSettings(focal=FOCAL, photometric=PhotometricSettings(texture_size=64, keyframes=4, shared_steps=1))


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, float, int]]:
    """Collect stage, progress and height of every picture that is written."""
    monkeypatch.setattr(preview, "INTERVAL_SECONDS", 0.0)
    monkeypatch.setattr(preview, "MAX_SHARE", 1e9)
    shown, with_header = [], Preview.with_header

    def record(self: Preview, stage: str, progress: float) -> np.ndarray:
        picture = with_header(self, stage, progress)
        shown.append((stage, progress, len(picture)))
        return picture

    monkeypatch.setattr(Preview, "with_header", record)
    return shown


@pytest.mark.unchecked
def test_every_stage_is_shown_and_changes_nothing(tmp_path, seen):
    case = make_photometric_case(timesteps=6)
    page = tmp_path / "preview.html"
    found = track_subject([case.capture], case.model, SHOWN, preview=page)[0]
    assert_alike(track_subject([case.capture], case.model, SHOWN)[0], found)
    stages = [stage for stage, _, _ in seen]
    assert {"landmarks, identity", "landmarks, sequence", "pixels, round 1 of 2, texture and light",
            "pixels, round 2 of 2, identity", "pixels, round 2 of 2, frames", "done"} <= set(stages)  # fmt: skip
    for name in ("landmarks", "pixels"):
        progress = [part for stage, part, _ in seen if stage.startswith(name)]
        assert progress == sorted(progress)
        assert progress[-1] == pytest.approx(1.0)
    heights = [height for _, _, height in seen]
    assert heights[0] < heights[stages.index("landmarks, identity")] < heights[-1], "residuals of colours are missing"
    assert "refresh" not in page.read_text(), "the last one is not renewed"
    assert "data:image/png" in page.read_text()


@pytest.mark.unchecked
def test_two_sequences_and_the_paper_schedule_are_shown(tmp_path, seen):
    cases = [make_photometric_case(timesteps=timesteps) for timesteps in (5, 4)]
    short = PaperSettings(start="landmarks", first_steps=6, steps=2, epochs=1, texture_size=64)
    settings = replace(SHOWN, schedule="paper", paper=short)
    track_subject([case.capture for case in cases], cases[0].model, settings, preview=tmp_path / "preview.html")
    stages = {stage for stage, _, _ in seen}
    assert {"pixels, frame 3 of 5", "pixels, frame 3 of 4", "pixels, epoch 1"} <= stages


def watch_of(folder: Path) -> Preview:
    case = make_photometric_case(timesteps=3)
    with torch.no_grad():
        reduced = reduce_face_model(case.model, layout_of(case.model))
    return Preview(folder / "p.html", case.model, reduced, [shot_of(case.capture, SHOWN)], SHOWN)


@pytest.mark.unchecked
def test_looking_takes_a_small_part_of_the_time(tmp_path, monkeypatch):
    """A drawing that takes a second is not repeated within ten; the newest fit is shown then, and the end always."""
    now, drawn, written = [0.0], [], []
    monkeypatch.setattr(preview.time, "monotonic", lambda: now[0])

    def draw(self: Preview, fit: object) -> np.ndarray:
        now[0] += 1.0
        drawn.append(fit)
        return np.zeros((10, 960, 3), np.uint8)

    monkeypatch.setattr(Preview, "draw", draw)
    monkeypatch.setattr(Preview, "write", lambda self, picture, last: written.append((now[0], last)))
    watch = watch_of(tmp_path)
    for second in range(40):
        now[0] = max(now[0], float(second))
        watch("frames", second / 40, lambda second=second: second)
    assert drawn == [0, 11, 22, 33]
    watch("frames", 1.0)
    assert len(drawn) == 4
    watch("done", 1.0)
    assert drawn[-1] == 39, "what came last is not shown at the end"
    assert [last for _, last in written] == [False] * 4 + [True]


@pytest.mark.parametrize("value", [float("inf"), float("-inf"), float("nan")])
def test_a_piece_that_is_not_finite_is_made_again(tmp_path, capsys, value):
    cache = StageCache(tmp_path / "kept")
    cache.write("odd", {"whole": torch.ones(3, dtype=torch.int64), "odd": torch.tensor([1.0, value])})
    assert cache.get_or_compute("odd", lambda: {"odd": torch.ones(2)})["odd"].tolist() == [1, 1]
    assert "odd.safetensors: is damaged, so this part of tracking runs again" in capsys.readouterr().err
    assert cache.read("odd") is not None
