"""Crops, face following and the guided filter do their part of a capture."""

import numpy as np
import pytest

from mien.capture.crop import choose_crop, whole_picture
from mien.capture.faces import second_difference_jitter
from mien.capture.matte import guided_filter, refine_matte
from mien.capture.source import list_images


def face_box(center_x: float, center_y: float, side: float, width: int, height: int) -> np.ndarray:
    half = side / 2
    sides = np.array([center_x - half, center_y - half, center_x + half, center_y + half])
    return sides / [width, height, width, height]


def test_crop_holds_the_head_of_every_frame():
    centers = np.linspace(600, 1000, 50)
    boxes = np.array([face_box(x, 500, 200, 1920, 1080) for x in centers])
    boxes[7] = np.nan
    crop = choose_crop(boxes, 1920, 1080, 512)
    assert (crop.width, crop.height) == (512, 512)
    for x in centers[1:-1]:
        corners = crop.to_output(np.array([[x - 200, 300], [x + 200, 700]]))
        assert (corners >= 0).all()
        assert (corners <= 512).all()


def test_one_false_detection_does_not_widen_the_crop():
    boxes = np.array([face_box(900, 500, 200, 1920, 1080)] * 200)
    narrow = choose_crop(boxes, 1920, 1080, 512)
    boxes[50] = face_box(100, 100, 60, 1920, 1080)
    assert choose_crop(boxes, 1920, 1080, 512) == narrow


@pytest.mark.parametrize("center", [(30, 30), (1900, 1060), (960, 1070)])
def test_crop_stays_inside_the_picture(center):
    x, y = center
    crop = choose_crop(face_box(x, y, 300, 1920, 1080)[None], 1920, 1080, 512)
    assert crop.left >= 0
    assert crop.top >= 0
    assert crop.left + crop.crop_width <= 1920
    assert crop.top + crop.crop_height <= 1080


def test_head_crops_are_kept_whole_and_never_enlarged():
    assert choose_crop(face_box(250, 300, 190, 512, 512)[None], 512, 512, 512) == whole_picture(512, 512, 512)
    assert choose_crop(face_box(250, 240, 300, 512, 480)[None], 512, 480, 256).height == 240
    small = choose_crop(face_box(500, 300, 60, 1280, 720)[None], 1280, 720, 512)
    assert small.width == small.crop_width == 150


def test_crop_maps_pixels_as_it_maps_pictures():
    """A bright block lands where `to_output` says that its centre lands."""
    picture = np.zeros((300, 400, 3), np.uint8)
    picture[120:136, 200:216] = 255
    crop = choose_crop(face_box(210, 130, 60, 400, 300)[None], 400, 300, 100)
    cut = crop.apply(picture)[..., 0].astype(float)
    rows, columns = np.mgrid[: cut.shape[0], : cut.shape[1]] + 0.5
    found = np.array([(cut * columns).sum(), (cut * rows).sum()]) / cut.sum()
    np.testing.assert_allclose(found, crop.to_output(np.array([208.0, 128.0])), atol=0.1)


def test_jitter_is_the_second_difference():
    times = np.arange(20.0)
    steady = np.stack([3 * times, -times], axis=-1)[:, None]
    assert second_difference_jitter(steady) == pytest.approx(0, abs=1e-9)
    steady[::2, 0, 0] += 0.5
    assert second_difference_jitter(steady) == pytest.approx(1.0)
    steady[5] = np.nan
    assert second_difference_jitter(steady) == pytest.approx(1.0)
    assert np.isnan(second_difference_jitter(steady[:2]))


def test_guided_filter_steps_where_the_picture_does():
    guide = np.full((64, 80, 3), 0.2, np.float32)
    guide[:, 40:] = (0.8, 0.6, 0.5)
    soft = np.broadcast_to(np.clip((np.arange(80) - 35) / 10, 0, 1), (64, 80)).astype(np.float32)
    filtered = guided_filter(guide, soft, radius=8, epsilon=1e-4)
    steps = np.diff(filtered, axis=1)[8:-8]
    assert (steps.argmax(axis=1) == 39).all()
    assert steps.max(axis=1).min() > 0.4  # the input deviates by 0.1
    # Values that follow the guide exactly pass unchanged.
    linear = guide @ np.array([0.3, 0.2, 0.1], np.float32)
    np.testing.assert_allclose(guided_filter(guide, linear, 8, 1e-4)[:, 44:], linear[:, 44:], atol=5e-3)


def test_matte_has_its_border_on_the_edge_of_the_picture():
    """A matte ends at the picture's edge, although the mask is soft and 3 pixels off, as from a 256x256 network."""
    picture = np.full((512, 512, 3), 50, np.uint8)
    picture[:, 260:] = (200, 150, 130)
    truth = (np.arange(512) >= 260).astype(float)
    mask = np.broadcast_to(np.clip((np.arange(256) - 126) / 5, 0, 1), (256, 256)).astype(np.float32)
    soft = np.repeat(mask[:1], 2, axis=1)[0]
    alpha = refine_matte(picture, mask)[256] / 255
    assert np.abs(alpha - truth).sum() < 0.4 * np.abs(soft - truth).sum()
    assert (alpha[:235] == 0).all()
    assert (alpha[285:] == 1).all()


def test_images_sort_by_number(tmp_path):
    for name in ("b2.png", "b10.PNG", "a3.jpg", "notes.txt", "7.png"):
        (tmp_path / name).touch()
    assert [path.name for path in list_images(tmp_path)] == ["7.png", "a3.jpg", "b2.png", "b10.PNG"]
