"""Light in captures: exposure that changes, darkness, noise, and screens behind the person."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from known import known
from mien.capture import CaptureSettings, capture_video, is_light_changing
from mien.capture.quality import measure_face, quality_report, relative_quality
from mien.capture.screen import screen_matte, screen_of, without_screen
from mien.storage import read_json

SIDE = 120
SKIN, HAIR = (0.80, 0.60, 0.48), (0.25, 0.18, 0.12)
CORNERS = np.array([[20.0, 20.0], [100.0, 100.0]])


def head(noise: float = 0.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """The colours [h, w, 3] and the opacity of a face below dark hair, with an edge of some pixels."""
    rows, columns = np.mgrid[:SIDE, :SIDE] - SIDE / 2
    alpha = np.clip((0.3 * SIDE - np.hypot(rows, columns)) / 4 + 0.5, 0, 1)
    colors = np.where((rows < -10)[..., None], HAIR, SKIN)
    return colors + np.random.default_rng(seed).normal(0, noise, colors.shape), alpha


def picture(colors: np.ndarray, alpha: np.ndarray, behind: np.ndarray) -> np.ndarray:
    mixed = alpha[..., None] * colors + (1 - alpha[..., None]) * behind
    return np.rint(255 * np.clip(mixed, 0, 1)).astype(np.uint8)


def report_of(*faces: np.ndarray) -> dict:
    measured = np.array([measure_face(face, CORNERS) for face in faces]).astype(np.float32)
    return quality_report("clip", relative_quality(measured), measured)


@pytest.mark.parametrize(("gains", "noise", "said"), [
    (np.ones(30), 0.01, {}),
    (np.linspace(1, 1.2, 30), 0.0, {}),
    (np.where(np.arange(30) == 7, 0.3, 1.0), 0.0, {}),  # one flash is no light that changes
    (np.linspace(1, 0.4, 30), 0.0, {"changing_light": "factor of 2.3 (mean level 25% in frame 29, 63%"}),
    (np.where(np.arange(30) < 15, 1.0, 0.6), 0.0, {"changing_light": "factor of 1.7"}),
    (np.full(30, 0.2), 0.0, {"dark": "the face is dark (mean level 13%)"}),
    (np.full(30, 0.9), 0.06, {"noisy": "deviation of 10."}),
    (np.full(30, 0.2), 0.06, {"dark": "mean level 13%", "noisy": "more light on the face"}),
])  # fmt: skip
def test_exposure_darkness_and_noise_are_told_with_numbers(gains, noise, said):
    faces = [np.full((SIDE, SIDE, 3), SKIN) * gain for gain in gains]
    grain = np.random.default_rng(0)
    shown = [np.rint(255 * np.clip(one + grain.normal(0, noise, one.shape), 0, 1)).astype(np.uint8) for one in faces]
    report = report_of(*shown)
    assert {name for name in ("changing_light", "dark", "noisy", "overexposed") if report[name]} == set(said)
    assert len(report["hints"]) == len(said)
    for words in said.values():
        assert any(words in hint for hint in report["hints"]), report["hints"]


def test_light_is_measured_where_faces_are_and_is_in_the_report(test_data: Path, tmp_path: Path, capsys):
    assert not is_light_changing(np.full(5, np.nan))
    assert is_light_changing(np.array([np.nan, 0.2, 0.4, np.nan, 0.3]))
    capture_video(test_data / "cases" / "exposure.mp4", tmp_path / "capture", CaptureSettings(size=96, stride=5))
    report = read_json(tmp_path / "capture" / "report.json", "mien.capture_report", 1)
    assert report["face_brightness_change"] == pytest.approx(2.43, abs=0.3)
    assert report["changing_light"]
    assert "the light on the face changes by a factor of 2." in capsys.readouterr().err


SCREENS = {
    "green": (0.0, 0.85, 0.0), "blue": (0.05, 0.2, 0.8), "filmed": (0.24, 0.63, 0.31), "dim": (0.05, 0.3, 0.1),
}  # fmt: skip


@pytest.mark.parametrize("uneven", [0.0, 0.3])
@pytest.mark.parametrize("name", SCREENS)
def test_a_screen_is_keyed_and_its_light_is_taken_off(name: str, uneven: float):
    lamp = 1 - uneven * np.linspace(0, 1, SIDE)[None, :, None]
    behind = np.array(SCREENS[name]) * lamp
    colors, alpha = head()
    rim = np.clip(1 - np.abs(alpha - 1) * 2, 0, 1) * (np.hypot(*(np.mgrid[:SIDE, :SIDE] - SIDE / 2)) > 0.28 * SIDE)
    lit = colors + 0.15 * rim[..., None] * np.array(SCREENS[name])
    image = picture(lit, alpha, behind + np.random.default_rng(1).normal(0, 0.01, behind.shape))
    screen = known(screen_of(image))
    # The network takes the space below the head for shoulders.
    mask = np.zeros((64, 64), np.float32)
    mask[12:, 8:56] = 1
    matte = screen_matte(image, mask, screen)
    assert np.abs(matte / 255 - alpha).max() < 0.45
    assert np.abs(matte / 255 - alpha).mean() < 0.01
    share = matte[..., None] / 255
    front = without_screen(image, matte, screen) - (1 - share) * 128
    tint = np.array(SCREENS[name]) - np.mean(SCREENS[name])
    edge = (matte > 20) & (np.hypot(*(np.mgrid[:SIDE, :SIDE] - SIDE / 2)) > 0.28 * SIDE)
    truth, found, filmed = (one @ tint for one in (255 * alpha[..., None] * colors, front, image.astype(float)))
    assert filmed[edge].max() > 3, "the picture has it"
    assert found[edge].max() < 3
    assert np.abs(found - truth)[alpha == 1].mean() < 3


@pytest.mark.parametrize(
    "behind",
    [(0.5, 0.5, 0.5), (0.95, 0.95, 0.98), (0.7, 0.45, 0.3), (0.8, 0.1, 0.1), (0.02, 0.08, 0.03), (0.5, 0.6, 0.7), None],
)
def test_walls_are_no_screens(behind):
    colors, alpha = head()
    leaves = np.random.default_rng(0).uniform(0, 1, (SIDE, SIDE, 3)) * (0.5, 0.9, 0.5)
    assert screen_of(picture(colors, alpha, leaves if behind is None else np.array(behind))) is None


def test_green_eyes_and_stripes_stay():
    colors, alpha = head()
    colors[58:62, 50:70] = (0.35, 0.55, 0.35)
    image = picture(colors, alpha, np.array(SCREENS["green"]))
    screen = known(screen_of(image))
    matte = screen_matte(image, cv2.resize(alpha.astype(np.float32), (64, 64)), screen)
    assert matte[50:70, 45:75].min() == 255
    assert (without_screen(image, matte, screen)[58:62, 50:70] == image[58:62, 50:70]).all()


def test_a_green_screen_leaves_no_rim(test_data: Path, tmp_path: Path, capsys):
    capture = capture_video(test_data / "cases/green_screen.mp4", tmp_path / "capture", CaptureSettings(max_frames=6))
    assert "the background is an even screen (red" in capsys.readouterr().err
    pictures, mattes = (np.asarray(part)[:, 0].astype(float) for part in (capture.images, capture.mattes))
    green = pictures[..., 1] - pictures[..., [0, 2]].max(-1)
    assert (green * mattes / 255).max() < 25
    assert mattes[:, :, :30].max() == 0
    assert mattes[:, 285:].max() == 0, "shoulders that the network sees are screen"
    assert (mattes == 255).mean() > 0.1
