"""The distortion of a lens in a calibration is taken out of pictures, mattes and landmarks, or refused."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from capture_helpers import write_rig
from mien.camera import Camera
from mien.capture.calibration import read_calibration
from mien.capture.crop import whole_picture
from mien.capture.given import read_given
from mien.capture.lens import Lens
from mien.capture.settings import CaptureSettings
from mien.capture.source import FrameSelection, open_source
from mien.errors import UserError
from mien.render.camera_paths import read_cameras

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


def lens_of(folder: Path, given: object) -> Lens | None:
    return read_calibration(write_rig(folder / "rig.json", {**ENTRY, "distortion": given}))[0].lens


def test_pictures_mattes_plates_and_landmarks_are_straightened(tmp_path: Path) -> None:
    lens = lens_of(tmp_path, BARREL)
    assert lens is not None
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
    settings = CaptureSettings(clean_plate=tmp_path / "plate.png", mattes=mattes, landmarks=tmp_path / "marks.csv")
    given = read_given(settings, source)
    assert given.plate is not None
    assert given.mattes is not None
    assert given.landmarks is not None
    assert abs(found_dots(given.plate[..., 2]) - DOTS).max() < 0.05
    assert abs(found_dots(given.mattes.matte(0, whole_picture(WIDTH, HEIGHT, WIDTH))) - DOTS).max() < 0.05
    assert abs(given.landmarks[0, : len(DOTS)] - DOTS).max() < 0.01
    half = cv2.resize(picture, None, fx=0.5, fy=0.5)
    large = cv2.resize(lens.straighten(half), (WIDTH, HEIGHT))
    assert abs(found_dots(lens.straighten(picture)) - found_dots(large)).max() < 0.2, "small pictures"


def test_all_lengths_of_opencv_are_read_in_a_row_or_column(tmp_path: Path) -> None:
    for count in (4, 5, 8, 12, 14):
        numbers = [-0.1, 0.01, 0.001, 0.001] + [0.0] * (count - 4)
        lens = lens_of(tmp_path, [[number] for number in numbers])
        assert lens is not None
        assert lens.coefficients == tuple(numbers)
    for harmless in (
        *({"distortion": nothing} for nothing in (None, [], [0, 0, 0, 0], [[0.0] * 5])), {"dist": [0, 0, 0, 0]},
        {"model": "Sony A7"}, {"distance": 3}, {"distortion_model": "plumb_bob"}, {"fisheye": False},
    ):  # fmt: skip
        assert read_calibration(write_rig(tmp_path / "rig.json", {**ENTRY, **harmless}))[0].lens is None, harmless


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"distortion": [0.1, 0.2, 0.3]}, "distortion has 3 coefficients; give 4, 5, 8, 12 or 14 in OpenCV's order"),
        ({"distortion": 0.1}, "distortion has 1 coefficients"),
        ({"distortion": [0.1, float("nan"), 0, 0]}, "NaN"),
        ({"distortion": {"k1": 0.1}}, "is not a list of numbers"),
        ({"distortion": [-9.0, 0, 0, 0]}, "folds the picture over itself; check the order"),
        ({"distortion": [1e200, 0, 0, 0, 0]}, "folds the picture"),
        ({"distortion": BARREL, "K": [[300, 5, 150], [0, 310, 125], [0, 0, 1]]}, "OpenCV's model has no skew"),
        ({"distCoeffs": BARREL}, "distCoeffs describes a lens in a way that mien does not read; .* as a list `dist"),
        ({"radial_distortion": BARREL}, "radial_distortion describes a lens"),
        ({"D": BARREL}, "D describes a lens"),
        ({"k1": -0.2}, "k1 describes a lens"),
        ({"distortion": BARREL, "fisheye": True}, "fisheye describes a lens"),
        ({"distortion": [0.1, 0, 0, 0], "model": "OPENCV_FISHEYE"}, "model describes a lens"),
    ],
)
def test_other_descriptions_are_refused(tmp_path: Path, change: dict, message: str) -> None:
    with pytest.raises(UserError, match=message) as error:
        read_calibration(write_rig(tmp_path / "rig.json", {**ENTRY, **change}))
    assert "\n" not in str(error.value)


def test_distortion_of_all_cameras_and_of_camera_paths_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="has distortion for all cameras together; write it into the entry of each"):
        read_calibration(write_rig(tmp_path / "rig.json", ENTRY, distortion=BARREL))
    with pytest.raises(UserError, match="camera 0: has distortion, but pictures are drawn as by an ideal lens"):
        read_cameras(write_rig(tmp_path / "path.json", {**ENTRY, "distortion": BARREL}))
