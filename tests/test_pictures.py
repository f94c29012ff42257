"""Pictures in reports have the right sizes, places and heat scale, and are inlined."""

import base64

import cv2
import numpy as np
import torch

from mien.pictures import error_heat, heat_colors, picture_grid, picture_uri, shrink, side_by_side, to_uint8


def _flat(height: int, width: int, value: int) -> np.ndarray:
    return np.full((height, width, 3), value, np.uint8)


def test_levels_are_rounded_pictures_shrunk_and_errors_shown_up_to_a_limit() -> None:
    image = torch.tensor([[[-0.5, 0.5, 1.5], [0.0, 1.0, 1 / 255]]])
    assert to_uint8(image).tolist() == [[[0, 128, 255], [0, 255, 1]]]
    assert shrink(_flat(100, 50, 3), 40).shape == (40, 20, 3)
    assert shrink(_flat(10, 5, 3), 40).shape == (10, 5, 3), "nothing is enlarged"
    target = torch.zeros(1, 4, 3)
    image = torch.tensor([0.0, 0.1, 0.2, 0.9])[None, :, None].expand(1, 4, 3)
    heat = error_heat(image, target, limit=0.2)
    assert heat[0, 0].tolist() == heat_colors(np.zeros((1, 1), np.float32))[0, 0].tolist()
    assert heat[0, 2].tolist() == heat[0, 3].tolist() == heat_colors(np.ones((1, 1), np.float32))[0, 0].tolist()
    brightness = heat.astype(int).sum(-1)[0]
    assert brightness[0] < brightness[1] < brightness[2]


def test_sheets_and_uris_hold_their_pictures() -> None:
    joined = side_by_side([_flat(10, 8, 0), _flat(20, 30, 100)], gap=2)
    assert joined.shape == (10, 8 + 2 + 15, 3)
    assert (joined[:, :8] == 0).all()
    assert (joined[:, 8:10] == 255).all()
    assert (joined[:, 10:] == 100).all()
    sheet = picture_grid([_flat(4, 6, value) for value in (10, 20, 30)], columns=2, gap=1)
    assert sheet.shape == (9, 13, 3)
    assert sheet[0, 7, 0] == 20
    assert sheet[5, 0, 0] == 30
    assert (sheet[5:, 7:] == 255).all()
    picture = np.random.default_rng(0).integers(0, 255, (12, 9, 3)).astype(np.uint8)
    for quality in (None, 95):
        head, body = picture_uri(picture, quality).split(",")
        assert head == f"data:image/{'png' if quality is None else 'jpeg'};base64"
        decoded = cv2.imdecode(np.frombuffer(base64.b64decode(body), np.uint8), cv2.IMREAD_COLOR_RGB)
        assert decoded is not None
        assert decoded.shape == picture.shape
        if quality is None:
            assert (decoded == picture).all()
