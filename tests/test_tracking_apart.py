"""Held-out sequences that are tracked apart share nothing with the others; an interrupted tracking continues."""

import json
import os
import signal
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from known import known
from mien.capture import write_capture
from mien.capture.capture import Capture
from mien.cli import main
from mien.pipeline import track as stage
from mien.tracking import read_tracking, track, track_subject
from mien.tracking.fitting.parameters import layout_of
from mien.tracking.fitting.resume import StageCache
from mien.tracking.fitting.sequence import sequence_data
from mien.tracking.landmarks import stages
from mien.tracking.landmarks.model import reduce_face_model
from mien.tracking.landmarks.problem import Problem
from mien.tracking.pipeline.held_out import mean_light
from mien.tracking.pixels import refine
from mien.tracking.pixels.outcome import turn_light
from mien.tracking.report import preview
from mien.tracking.report.preview import Preview
from mien.tracking.settings import PaperSettings, PhotometricSettings, TrackingSettings
from mien.tracking.tracking import Tracking
from photometric_case import FOCAL, PhotometricCase, assert_alike, make_photometric_case, make_textured_model
from refusals import complaint
from test_photometric_tracking import turn_error, wobble

LANDMARKS = TrackingSettings(schedule="landmarks")
"""Settings with an unknown focal length, because the held-out sequence must not decide it."""
FAST = replace(
    LANDMARKS, schedule="fast", photometric=PhotometricSettings(texture_size=64, keyframes=4, shared_steps=1)
)
PAPER = replace(FAST, schedule="paper", paper=PaperSettings("fast", texture_size=64, epochs=2))
PAPER_ALONE = replace(PAPER, paper=replace(PAPER.paper, start="landmarks", first_steps=30, steps=25))
SCHEDULES = {"landmarks": LANDMARKS, "fast": FAST, "paper": PAPER, "paper from landmarks": PAPER_ALONE}


def part_of(case: PhotometricCase, frames: slice, name: str) -> PhotometricCase:
    arrays = ("timestamps", "images", "mattes", "landmarks", "valid")
    capture = replace(case.capture, name=name, **{key: getattr(case.capture, key)[frames] for key in arrays})
    return replace(case, face=case.face[frames], landmarks=case.landmarks[frames], capture=capture)


case = pytest.fixture(scope="module")(lambda: make_photometric_case(timesteps=10))
shaping = pytest.fixture(scope="module")(lambda case: part_of(case, slice(0, 6), "shaping").capture)
apart = pytest.fixture(scope="module")(lambda case: part_of(case, slice(6, 10), "apart"))


def another_person(capture: Capture) -> Capture:
    """Return other pictures of a wider face by a longer lens."""
    middle = capture.landmarks.mean((0, 2), keepdims=True)
    landmarks = middle + (capture.landmarks - middle) * np.array([1.15, 0.95], np.float32)
    return replace(capture, landmarks=landmarks.astype(np.float32), images=255 - capture.images)


def assert_same_file(expected: Tracking, found: Tracking) -> None:
    """Check that two trackings are the same to the bit, with or without a fit to pixels."""
    if expected.appearance is not None:
        assert_alike(expected, found)
    assert_same_person(expected, found)
    for name, tensor in expected.face.tensors().items():
        assert torch.equal(tensor, found.face.tensors()[name]), name
    assert torch.equal(expected.residuals, found.residuals)
    assert expected.settings == found.settings


def assert_same_person(expected: Tracking, found: Tracking) -> None:
    assert torch.equal(found.face.identity, expected.face.identity)
    assert torch.equal(found.cameras[0].K, expected.cameras[0].K)
    pairs: list[Any] = [(expected.face.vertex_offsets, found.face.vertex_offsets)]
    for name in ("texture", "trust", "light"):
        pairs.append([getattr(one.appearance, name, None) for one in (expected, found)])
    for one, other in pairs:
        assert one is other or torch.equal(one, other)
    assert getattr(expected.appearance, "sigma", None) == getattr(found.appearance, "sigma", None)


@pytest.fixture(scope="module")
def tracked(case, shaping, apart) -> Callable[[str], list[Tracking]]:
    """Return trackings of the shaping sequence alone, then of all with held-out ones of this person and another."""

    @cache
    def tracked_by(schedule: str) -> list[Tracking]:
        settings, held_out = SCHEDULES[schedule], [apart.capture, another_person(apart.capture)]
        together = track_subject([shaping], case.model, settings, held_out=held_out)
        return [track(shaping, case.model, settings), *together]

    return tracked_by


SLOW = [name if name in ("landmarks", "fast") else pytest.param(name, marks=pytest.mark.slow) for name in SCHEDULES]


@pytest.mark.unchecked
@pytest.mark.parametrize("schedule", SLOW)
def test_the_person_is_the_same_whatever_the_held_out_sequences_hold(tracked, schedule: str):
    alone, shaping, *held_out = tracked(schedule)
    assert_same_file(alone, shaping)
    for own in held_out:
        assert_same_person(alone, own)
        assert len(own.face) == 4
    assert (alone.appearance is None) == (schedule == "landmarks")


@pytest.mark.unchecked
@pytest.mark.parametrize("schedule", SLOW[1:])
def test_pixels_calm_the_held_out_sequence(apart, tracked, schedule: str):
    by_landmarks, by_pixels = tracked("landmarks")[2], tracked(schedule)[2]
    assert wobble(apart, by_pixels) < 0.5 * wobble(apart, by_landmarks)
    assert turn_error(apart, by_pixels) < 0.3
    assert by_pixels.pixel_residuals.isfinite().all()


def test_focal_length_and_light_of_what_is_held_out_are_those_of_the_others(case, shaping, apart):
    small = replace(
        apart.capture, landmarks=apart.capture.landmarks / 2, images=apart.capture.images[:, :, ::2, ::2],
        mattes=apart.capture.mattes[:, :, ::2, ::2], principal_point=apart.capture.principal_point / 2,
    )  # fmt: skip
    first, second = track_subject([shaping], case.model, LANDMARKS, held_out=[small])
    assert float(second.cameras[0].K[0, 0]) == pytest.approx(float(first.cameras[0].K[0, 0]) / 2, rel=1e-6)
    assert turn_error(apart, second) < 1.5
    # Sequences of a rig have frames of their own, so a light is turned twice on its way.
    random = torch.Generator().manual_seed(0)
    shot, straight = sequence_data(shaping, LANDMARKS), torch.eye(4, dtype=torch.float64)
    turn = torch.tensor([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]], dtype=torch.float64)
    lights = tuple(torch.randn(9, 3, generator=random) for _ in range(3))
    turned, level = replace(shot, T_world_fit=turn), replace(shot, T_world_fit=straight)
    others, to_world = [turned, level, shot], turn[:3, :3].float()
    expected = (turn_light(lights[0], to_world) + lights[1]) / 2
    torch.testing.assert_close(mean_light(level, others, lights), expected, atol=1e-5, rtol=0)
    found = turn_light(mean_light(turned, others, lights), to_world)
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)
    assert torch.equal(mean_light(shot, others, lights), lights[2]), "other kinds of sequences do not count"


def stops_after(piece: str, written: list[str], stop: Callable[[], object], folder: str | None = None):
    """Return a `StageCache.write` that collects the names of pieces, and stops the program after one of them."""
    write = StageCache.write

    def write_then_stop(self: StageCache, name: str, tensors: dict) -> None:
        write(self, name, tensors)
        if folder in (None, known(self.folder).name):
            written.append(name)
            if name == piece:
                stop()

    return write_then_stop


def interrupt() -> None:
    raise KeyboardInterrupt


@pytest.mark.unchecked
def test_an_interrupted_tracking_goes_on(case, shaping, apart, tracked, tmp_path, monkeypatch, capsys):
    """Another held-out sequence, which `tracked` has beside it, changes nothing."""
    keep, names = tmp_path / "kept", []
    for last in ("sequence-1", "lids"):
        names.clear()
        with monkeypatch.context() as patched:
            patched.setattr(StageCache, "write", stops_after(last, names, interrupt, folder="held_out"))
            pytest.raises(KeyboardInterrupt, track_subject, [shaping], case.model, FAST, keep, held_out=[apart.capture])
        assert names[-1] == last
    assert "sequence-1" not in names, "what was finished is done again"
    found = track_subject([shaping], case.model, FAST, keep, held_out=[apart.capture])
    assert capsys.readouterr().err.count("continues where it was interrupted") == 2
    assert not keep.exists()
    for one, other in zip(tracked("fast")[1:3], found, strict=True):
        assert_same_file(one, other)


@pytest.fixture
def workspace(case, shaping, apart, tmp_path, monkeypatch) -> Path:
    monkeypatch.setattr("mien.pipeline.track.face_model_of", lambda choice: case.model)
    for capture in (apart.capture, shaping):
        write_capture(tmp_path / "out/sequences" / capture.name / "capture", capture)
    return tmp_path / "out"


QUICKLY = ("--overlay", "none", "--tracking.schedule", "landmarks")


@pytest.mark.unchecked
@pytest.mark.slow
def test_the_command_tracks_apart(case, shaping, apart, workspace, capsys):
    overlay = workspace / "sequences/apart/tracking/overlay.png"
    overlay.parent.mkdir()
    overlay.touch()
    assert main(["track", str(workspace), "--hold-out", "apart", *QUICKLY]) == 0
    assert not overlay.exists(), "an import's, which shows another tracking"
    assert "apart: tracked apart; the person's shape, texture and light come from shaping" in capsys.readouterr().err
    expected = track_subject([shaping], case.model, LANDMARKS, held_out=[apart.capture])
    for capture, tracking in zip((shaping, apart.capture), expected, strict=True):
        found = read_tracking(workspace / "sequences" / capture.name / "tracking")
        assert torch.equal(found.face.head_rotation, tracking.face.head_rotation)
        assert found.settings["held_out"] == ["apart"]
    assert main(["track", str(workspace), "--hold-out", "apart", *QUICKLY]) == 0
    assert "the tracking is current, nothing to do" in capsys.readouterr().err
    assert main(["track", str(workspace), *QUICKLY]) == 0
    assert "tracked again, so that they share one identity" in capsys.readouterr().err
    stored = json.loads((workspace / "sequences/apart/tracking/tracking.json").read_text())
    assert "held_out" not in stored["settings"]


def test_wrong_names_are_refused(workspace, tmp_path, capsys):
    (tmp_path / "a.mp4").touch()
    for command, words in (
        (["track", str(workspace), "--hold-out", "nobody", *QUICKLY], "nobody"),
        (["track", str(workspace), "--hold-out", "apart", "shaping", *QUICKLY], "apart shaping: leaves no sequence"),
        (["create", str(tmp_path / "a.mp4"), "--out", str(tmp_path / "new"), "--track-apart"],
         "--track-apart: needs the sequences to track apart; add --hold-out NAME"),
    ):  # fmt: skip
        assert words in complaint(capsys, *command)
    assert not list(workspace.glob("sequences/*/tracking"))


@pytest.mark.unchecked
def test_goes_on_from_every_piece(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(stages, "FRAMES_AT_ONCE", 5)
    monkeypatch.setattr(refine, "FRAMES_AT_ONCE", 3)
    case, keep = make_photometric_case(timesteps=8), tmp_path / "kept"
    expected = track_subject([case.capture], case.model, FAST)[0]
    for piece in ("identity", "frames-0-0", "sequence-0", "step-0-0-equations-1", "iteration-1-shared-0", "lids"):
        before, written = {path.stem for path in keep.glob("*")}, []
        with monkeypatch.context() as patched:
            patched.setattr(StageCache, "write", stops_after(piece, written, interrupt))
            pytest.raises(KeyboardInterrupt, track_subject, [case.capture], case.model, FAST, keep)
        assert written[-1] == piece
        assert not before & set(written), "what was finished is done again"
        assert ("continues where it was interrupted" in capsys.readouterr().err) == bool(before)
    for name in ("sequence-1", "iteration-0"):
        whole = (keep / f"{name}.safetensors").read_bytes()
        (keep / f"{name}.safetensors").write_bytes(whole[: len(whole) // 2])
    assert_alike(expected, track_subject([case.capture], case.model, FAST, keep)[0])
    assert "iteration-0.safetensors: is damaged, so this part" in capsys.readouterr().err
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
    assert fork_server.call(function, "iteration-0-appearance", str(folder), *command).wait() == -signal.SIGKILL
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


SHOWN = replace(FAST, focal=FOCAL)


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, float, int]]:
    """Collect stage, progress and number of charts of every page that is written."""
    monkeypatch.setattr(preview, "INTERVAL_SECONDS", 0.0)
    monkeypatch.setattr(preview, "MAX_SHARE", 1e9)
    shown, render = [], preview.render

    def record(template: str, **content: Any) -> str:
        shown.append((content["stage"], float(content["done"].split()[0]) / 100, len(content["charts"])))
        return render(template, **content)

    monkeypatch.setattr(preview, "render", record)
    return shown


@pytest.mark.unchecked
def test_every_stage_is_shown_and_changes_nothing(tmp_path, seen):
    case = make_photometric_case(timesteps=6)
    page = tmp_path / "preview.html"
    found = track_subject([case.capture], case.model, SHOWN, preview=page)[0]
    assert_alike(track_subject([case.capture], case.model, SHOWN)[0], found)
    stages = [stage for stage, _, _ in seen]
    assert {"landmarks, identity", "landmarks, sequence", "pixels, iteration 1 of 2, texture and light",
            "pixels, iteration 2 of 2, identity", "pixels, iteration 2 of 2, frames",
            "done"} <= set(stages)  # fmt: skip
    for name in ("landmarks", "pixels"):
        progress = [part for stage, part, _ in seen if stage.startswith(name)]
        assert (progress, progress[-1]) == (sorted(progress), pytest.approx(1.0))
    counts = [count for _, _, count in seen]
    assert (counts[0], counts[stages.index("landmarks, identity")], counts[-1]) == (0, 1, 2)
    assert "refresh" not in page.read_text(), "the last one is not renewed"
    assert page.read_text().count("data:image/jpeg") == 4 * 4


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
    return Preview(folder / "p.html", case.model, Problem(reduced, [sequence_data(case.capture, SHOWN)], [None], SHOWN))


@pytest.mark.unchecked
def test_looking_takes_a_small_part_of_the_time(tmp_path, monkeypatch):
    """A drawing that takes a second is not repeated within ten; the newest fit is shown then, and the end always."""
    now, drawn, written = [0.0], [], []
    monkeypatch.setattr(preview.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(Preview, "draw", lambda self, fit: (drawn.append(fit), now.append(now.pop() + 1)))
    monkeypatch.setattr(Preview, "write", lambda self, stage, progress: written.append(stage == "done"))
    watch = watch_of(tmp_path)
    for second in range(40):
        now[0] = max(now[0], float(second))
        watch("frames", second / 40, lambda second=second: second)
    assert drawn == [0, 11, 22, 33]
    watch("frames", 1.0)
    assert len(drawn) == 4
    watch("done", 1.0)
    assert drawn[-1] == 39, "what came last is not shown at the end"
    assert written == [False] * 4 + [True]


@pytest.mark.parametrize("value", [float("inf"), float("-inf"), float("nan")])
def test_a_piece_that_is_not_finite_is_made_again(tmp_path, capsys, value):
    cache = StageCache(tmp_path / "kept")
    cache.write("odd", {"whole": torch.ones(3, dtype=torch.int64), "odd": torch.tensor([1.0, value])})
    assert cache.get_or_compute("odd", lambda: {"odd": torch.ones(2)})["odd"].tolist() == [1, 1]
    assert "odd.safetensors: is damaged, so this part of tracking runs again" in capsys.readouterr().err
    assert cache.read("odd") is not None
