"""The preview shows the fit at every stage, at a bounded cost, and does not change its numbers."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from mien.capture import Capture
from mien.face import FaceModel
from mien.tracking import TrackingSettings, track_subject
from mien.tracking.fitting import layout_of, shot_of
from mien.tracking.landmarks import reduce_face_model
from mien.tracking.report import Preview, preview
from mien.tracking.settings import PaperSettings, PhotometricSettings
from photometric_case import FOCAL, assert_alike, make_photometric_case

pytestmark = pytest.mark.unchecked

FAST = TrackingSettings(focal=FOCAL, photometric=PhotometricSettings(texture_size=64, keyframes=4, shared_steps=1))


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


def test_every_stage_is_shown_and_changes_nothing(tmp_path, seen):
    case = make_photometric_case(timesteps=6)
    page = tmp_path / "preview.html"
    found = track_subject([case.capture], case.model, FAST, preview=page)[0]
    assert_alike(track_subject([case.capture], case.model, FAST)[0], found)
    stages = [stage for stage, _, _ in seen]
    for stage in ("landmarks, identity", "landmarks, sequence", "pixels, round 1 of 2, texture and light",
                  "pixels, round 2 of 2, identity", "pixels, round 2 of 2, frames", "done"):  # fmt: skip
        assert stage in stages, stages
    for name in ("landmarks", "pixels"):
        progress = [part for stage, part, _ in seen if stage.startswith(name)]
        assert progress == sorted(progress)
        assert progress[-1] == pytest.approx(1.0)
    heights = [height for _, _, height in seen]
    assert heights[0] < heights[stages.index("landmarks, identity")] < heights[-1], "residuals of colours are missing"
    picture = cv2.imread(str(page.with_suffix(".png")))
    assert picture is not None
    assert picture.shape == (heights[-1], 960, 3)
    assert "refresh" not in page.read_text(), "the last one is not renewed"
    assert "data:image/png" in page.read_text()


def test_two_sequences_and_the_paper_schedule_are_shown(tmp_path, seen):
    captures = [make_photometric_case(timesteps=timesteps).capture for timesteps in (5, 4)]
    short = PaperSettings(start="landmarks", first_steps=6, steps=2, epochs=1, texture_size=64)
    settings = replace(FAST, schedule="paper", paper=short)
    model = make_photometric_case(timesteps=4).model
    track_subject(captures, model, settings, preview=tmp_path / "preview.html")
    stages = [stage for stage, _, _ in seen]
    assert "pixels, frame 3 of 5" in stages
    assert "pixels, frame 3 of 4" in stages
    assert "pixels, epoch 1" in stages


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
    case = make_photometric_case(timesteps=3)
    watch = watch_of(tmp_path, case.capture, case.model)
    for second in range(40):
        now[0] = max(now[0], float(second))
        watch("frames", second / 40, lambda second=second: second)
    assert drawn == [0, 11, 22, 33]
    watch("frames", 1.0)
    assert len(drawn) == 4
    watch("done", 1.0)
    assert drawn[-1] == 39, "what came last is not shown at the end"
    assert [last for _, last in written] == [False] * 4 + [True]


def watch_of(folder: Path, capture: Capture, model: FaceModel) -> Preview:
    with torch.no_grad():
        reduced = reduce_face_model(model, layout_of(model))
    return Preview(folder / "p.html", model, reduced, [shot_of(capture, FAST)], FAST)


def test_before_any_fit_there_is_a_header_alone(tmp_path):
    case = make_photometric_case(timesteps=3)
    watch: Callable = watch_of(tmp_path, case.capture, case.model)
    watch("landmarks, head pose", 0.1)
    header = cv2.imread(str(tmp_path / "p.png"))
    assert header is not None
    assert header.shape == (48, 960, 3)
    assert "refresh" in (tmp_path / "p.html").read_text()
