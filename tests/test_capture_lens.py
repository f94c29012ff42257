"""Lenses and light in captures: distortion, colours, exposure that changes, darkness, noise, and screens."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

import color_charts
from capture_helpers import write_rig
from dataset_writers import FRONTAL, write_nersemble
from known import known
from mien.camera import Camera
from mien.capture import capture_video
from mien.capture.cameras.calibration import read_calibration
from mien.capture.person.crop import whole_picture
from mien.capture.person.given import read_given
from mien.capture.person.plate import screen_matte, screen_of, without_screen
from mien.capture.quality import is_light_changing, measure_face, quality_report, relative_quality
from mien.capture.settings import CaptureSettings
from mien.cli import main
from mien.disk.files import read_json
from mien.errors import UserError
from mien.media.color_correction import ColorCorrection
from mien.media.source import FrameSelection, open_source
from mien.pipeline import import_dataset as import_footage
from mien.render.camera_paths import read_cameras
from refusals import refuses

WIDTH, HEIGHT = 320, 240
CAMERA = Camera(
    torch.tensor([[300.0, 0, 150], [0, 310, 125], [0, 0, 1]]),
    torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1]]), WIDTH, HEIGHT,
)  # fmt: skip
BARREL = [-0.28, 0.09, 0.002, -0.001, 0.01]
ENTRY = {"id": "a", "K": CAMERA.K.tolist(), "viewmat": CAMERA.viewmat.tolist(), "width": WIDTH, "height": HEIGHT}


def filmed(points: np.ndarray) -> np.ndarray:
    """Return where a camera with the lens BARREL shows what an ideal one shows at these pixels, by the formulas."""
    (fx, _, cx), (_, fy, cy), _ = CAMERA.K.double().tolist()
    x, y = (points[..., 0] - cx) / fx, (points[..., 1] - cy) / fy
    k1, k2, p1, p2, k3 = BARREL
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([u * fx + cx, v * fy + cy], axis=-1)


DOTS = np.stack(np.meshgrid(np.linspace(30, 290, 6), np.linspace(25, 215, 5)), axis=-1).reshape(-1, 2)


def dotted(points: np.ndarray) -> np.ndarray:
    """Return a grey picture with a soft dot at each of the points."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    squares = (columns[..., None] - points[:, 0]) ** 2 + (rows[..., None] - points[:, 1]) ** 2
    return (255 * np.exp(-squares / 8).sum(-1)).clip(0, 255).astype(np.uint8)


def found_dots(picture: np.ndarray) -> np.ndarray:
    """Return the centre of brightness near each of DOTS."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    centers = []
    for x, y in DOTS:
        weights = picture * ((abs(columns - x) < 14) & (abs(rows - y) < 14)).astype(float)
        centers.append(((columns * weights).sum() / weights.sum(), (rows * weights).sum() / weights.sum()))
    return np.array(centers)


def lens_of(folder: Path, given: object) -> Any:
    return read_calibration(write_rig(folder / "rig.json", {**ENTRY, "distortion": given}))[0].lens


def test_pictures_mattes_plates_and_landmarks_are_straightened(tmp_path: Path) -> None:
    lens = lens_of(tmp_path, BARREL)
    picture = dotted(filmed(DOTS))
    assert abs(found_dots(picture) - DOTS).max() > 4, "the lens does something"
    folder, mattes = tmp_path / "pictures", tmp_path / "mattes"
    for place in (folder, mattes):
        place.mkdir()
        cv2.imwrite(str(place / "0.png"), picture)
    cv2.imwrite(str(tmp_path / "plate.png"), picture)
    landmarks = np.full((1, 478, 2), 100.0)
    landmarks[0, : len(DOTS)] = filmed(DOTS)
    (tmp_path / "marks.csv").write_text(",".join(map(str, landmarks.ravel())))
    source = open_source(folder, FrameSelection(), 25.0)
    assert abs(found_dots(next(source.frames()).picture()[..., 0]) - DOTS).max() > 4
    source = type(source)(**{**vars(source), "lens": lens})
    assert abs(found_dots(next(source.frames()).picture()[..., 1]) - DOTS).max() < 0.05
    given: Any = read_given(source, tmp_path / "plate.png", mattes, tmp_path / "marks.csv")
    assert abs(found_dots(given.plate[..., 2]) - DOTS).max() < 0.05
    assert abs(found_dots(given.mattes.matte(0, whole_picture(WIDTH, HEIGHT, WIDTH))) - DOTS).max() < 0.05
    assert abs(given.landmarks[0, : len(DOTS)] - DOTS).max() < 0.01
    large = cv2.resize(lens.straighten(cv2.resize(picture, None, fx=0.5, fy=0.5)), (WIDTH, HEIGHT))
    assert abs(found_dots(lens.straighten(picture)) - found_dots(large)).max() < 0.2, "small pictures"


def test_all_lengths_of_opencv_are_read_and_distortion_of_all_cameras_is_refused(tmp_path: Path) -> None:
    for count in (4, 5, 8, 12, 14):
        numbers = [-0.1, 0.01, 0.001, 0.001] + [0.0] * (count - 4)
        assert lens_of(tmp_path, [[number] for number in numbers]).coefficients == tuple(numbers)
    for harmless in (
        *({"distortion": nothing} for nothing in (None, [], [0, 0, 0, 0], [[0.0] * 5])), {"dist": [0, 0, 0, 0]},
        {"model": "Sony A7"}, {"distance": 3}, {"distortion_model": "plumb_bob"}, {"fisheye": False},
    ):  # fmt: skip
        assert read_calibration(write_rig(tmp_path / "rig.json", {**ENTRY, **harmless}))[0].lens is None, harmless
    with pytest.raises(UserError, match="has distortion for all cameras together; write it into the entry of each"):
        read_calibration(write_rig(tmp_path / "rig.json", ENTRY, distortion=BARREL))
    with pytest.raises(UserError, match="camera 0: has distortion, but pictures are drawn as by an ideal lens"):
        read_cameras(write_rig(tmp_path / "path.json", {**ENTRY, "distortion": BARREL}))


@pytest.mark.parametrize(("change", "message"), [
    ({"distortion": [0.1, 0.2, 0.3]}, "distortion has 3 coefficients; give 4, 5, 8, 12 or 14 in OpenCV's order"),
    ({"distortion": 0.1}, "distortion has 1 coefficients"),
    ({"distortion": [0.1, float("nan"), 0, 0]}, "NaN"),
    ({"distortion": {"k1": 0.1}}, "is not a list of numbers"),
    ({"distortion": [-9.0, 0, 0, 0]}, "folds the picture over itself; check the order"),
    ({"distortion": [1e200, 0, 0, 0, 0]}, "folds the picture"),
    ({"distortion": BARREL, "K": [[300, 5, 150], [0, 310, 125], [0, 0, 1]]}, "OpenCV's model has no skew"),
    ({"distCoeffs": BARREL}, "distCoeffs describes a lens in a way that mien does not read; .* as a list `dist"),
    ({"k1": -0.2}, "k1 describes a lens"),
    ({"distortion": BARREL, "fisheye": True}, "fisheye describes a lens"),
    ({"distortion": [0.1, 0, 0, 0], "model": "OPENCV_FISHEYE"}, "model describes a lens"),
])  # fmt: skip
def test_other_descriptions_are_refused(tmp_path: Path, change: dict, message: str) -> None:
    refuses(message, read_calibration, write_rig(tmp_path / "rig.json", {**ENTRY, **change}))


SMALL = {"id": "a", "K": [[300, 0, 40], [0, 300, 30], [0, 0, 1]], "viewmat": np.eye(4).tolist(), "width": 80,
         "height": 60}  # fmt: skip
SERIALS = ("222200036", FRONTAL)


def speckled(seed: int, height: int = 60, width: int = 80) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3)).astype(np.uint8)


def expected(picture: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    light = color_charts.to_light(picture.reshape(-1, 3) / 255)
    return 255 * color_charts.to_srgb(color_charts.polynomial(light, matrix)).reshape(picture.shape)


@pytest.mark.parametrize("terms", sorted(color_charts.ORDERS))
def test_colors_follow_the_formula(terms: int) -> None:
    """To rounding, in every number of terms. Each exchange of two terms would be seen."""
    picture, matrix = speckled(terms), color_charts.correction(terms, terms)
    found = ColorCorrection(matrix).apply(picture).astype(float)
    assert np.abs(found - expected(picture, matrix)).max() < 0.6
    for one in range(terms - 1):
        exchanged = matrix.copy()
        exchanged[:, [one, one + 1]] = matrix[:, [one + 1, one]]
        assert np.abs(found - expected(picture, exchanged)).max() > 2, f"terms {one} and {one + 1}"
    greys = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 3, axis=2)
    assert (ColorCorrection(np.eye(3)).apply(greys) == greys).all()
    assert ColorCorrection(-np.eye(3)).apply(greys).max() == 0
    assert (ColorCorrection(1e6 * np.eye(3)).apply(greys)[0, 1:] == 255).all()


def test_pictures_and_plates_are_corrected_and_mattes_are_not(tmp_path: Path) -> None:
    matrix = color_charts.correction(5)
    entry = {**SMALL, "color_correction": matrix.tolist()}
    (camera,) = read_calibration(write_rig(tmp_path / "rig.json", entry))
    assert camera.colors is not None
    for name, seed in (("pictures/0.png", 1), ("plate.png", 2), ("mattes/0.png", 3)):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / name), speckled(seed)[..., ::-1])
    source = replace(open_source(tmp_path / "pictures", FrameSelection(), 25.0), colors=camera.colors)
    assert np.abs(next(source.frames()).picture() - expected(speckled(1), matrix)).max() < 0.6
    given: Any = read_given(source, tmp_path / "plate.png", tmp_path / "mattes", None)
    assert np.abs(given.plate - expected(speckled(2), matrix)).max() < 0.6
    assert (given.mattes.matte(0, whole_picture(80, 60, 80)) == speckled(3)[..., 1]).all()


@pytest.mark.parametrize(("given", "told"), [
    ([[1, 0, 0], [0, 1, 0], [0, 0]], "is not three rows of numbers"),
    ([[1, 0, 0], [0, 1, 0], [0, 0, 1e30]], "is not three rows of numbers"),
    ([[], [], []], "has 0 terms for each channel"),
    ("red", "is not three rows of numbers"),
    (np.zeros((3, 6)).tolist(), "has 6 terms for each channel; polynomials of Cheung 2004 have 3, 4, 5, 7, 8, 10,"),
])  # fmt: skip
def test_other_matrices_are_refused(tmp_path: Path, given: object, told: str) -> None:
    rig = write_rig(tmp_path / "rig.json", {**SMALL, "color_correction": given})
    refuses(rf"camera 0 \(a\): color_correction.* {told}", read_calibration, rig)


def test_the_option_leaves_colors_as_filmed(tmp_path: Path, monkeypatch, capsys) -> None:
    asked: list[dict[str, Any]] = []

    def capture(videos: list[Path], calibration: Path, out: Path, name: str, settings: CaptureSettings) -> None:
        asked.append({each.camera_id: each.colors for each in read_calibration(calibration)})
        out.mkdir(parents=True)

    def told(person: Path, out: str, *options: str, code: int = 0) -> str:
        assert main(["import", str(person), "--out", str(tmp_path / out), *options]) == code
        return capsys.readouterr().err

    monkeypatch.setattr(import_footage, "capture_cameras", capture)
    corrections = {serial: color_charts.correction(index) for index, serial in enumerate(SERIALS)}
    person = write_nersemble(tmp_path / "017", SERIALS, colors=corrections)
    by_file = "  colour correction: by calibration/color_calibration.json; --no-color-correction leaves it out"
    assert by_file in told(person, "a")
    for serial, found in asked[0].items():
        np.testing.assert_array_equal(found.matrix, corrections[serial])
    assert "  colour correction: left out (--no-color-correction)" in told(person, "b", "--no-color-correction")
    file = person / "calibration/color_calibration.json"
    for content, reason in (
        ({FRONTAL: corrections[FRONTAL].tolist()}, "has no correction of the camera 222200036; copy the files"),
        ({serial: np.zeros((3, 6)).tolist() for serial in SERIALS}, "'222200036': has 6 terms for each channel"),
    ):
        file.write_text(json.dumps(content))
        assert f"mien: {file}: {reason}" in told(person, "c", code=2)
        assert not list(tmp_path.glob("c/sequences/*/*"))
    told(person, "c", "--no-color-correction")
    without = told(write_nersemble(tmp_path / "018", SERIALS), "d")
    assert "  missing or not used: colour correction (calibration/color_calibration.json): cameras differ" in without
    assert "  colour correction:" not in without
    assert asked[1:] == [dict.fromkeys(SERIALS)] * 3


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
    measured = np.array([measure_face(face, CORNERS) for face in shown]).astype(np.float32)
    report = quality_report("clip", relative_quality(measured), measured)
    assert {name for name in ("changing_light", "dark", "noisy", "overexposed") if report[name]} == set(said)
    assert len(report["hints"]) == len(said)
    for words in said.values():
        assert any(words in hint for hint in report["hints"]), report["hints"]


def test_a_white_balance_that_drifts_is_told_with_numbers():
    for blue, told in ((0.9, ()), (0.7, ("blue is 42% of its red in frame 29, and 60% in frame 0;",))):
        faces = [np.full((SIDE, SIDE, 3), SKIN) * [1, 1, gain] for gain in np.linspace(1, blue, 30)]
        shown = (np.rint(255 * face).astype(np.uint8) for face in faces)
        measured = np.array([measure_face(face, CORNERS) for face in shown]).astype(np.float32)
        hints = quality_report("clip", relative_quality(measured), measured)["hints"]
        assert len(hints) == len(told)
        assert all(words in hint for words, hint in zip(told, hints, strict=True)), hints


def test_exposure_of_a_video_is_in_its_report(test_data: Path, tmp_path: Path, capsys):
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
    assert found[edge].mean() < 0.12 * truth[edge].mean() < 0, "what has none of the tint gets none"
    assert np.abs(found - truth)[alpha == 1].mean() < 3


@pytest.mark.parametrize(
    "behind",
    [(0.5, 0.5, 0.5), (0.95, 0.95, 0.98), (0.7, 0.45, 0.3), (0.8, 0.1, 0.1), (0.02, 0.08, 0.03), (0.5, 0.6, 0.7), None],
)
def test_walls_are_no_screens(behind):
    colors, alpha = head()
    leaves = np.random.default_rng(0).uniform(0, 1, (SIDE, SIDE, 3)) * (0.5, 0.9, 0.5)
    assert screen_of(picture(colors, alpha, leaves if behind is None else np.array(behind))) is None


def test_green_eyes_and_stripes_stay_and_light_is_measured_where_faces_are():
    assert not is_light_changing(np.full(5, np.nan))
    assert is_light_changing(np.array([np.nan, 0.2, 0.4, np.nan, 0.3]))
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
    assert ((pictures[..., 1] - pictures[..., [0, 2]].max(-1)) * mattes / 255).max() < 25
    assert mattes[:, :, :30].max() == 0
    assert mattes[:, 285:].max() == 0, "shoulders that the network sees are screen"
    assert (mattes == 255).mean() > 0.1
