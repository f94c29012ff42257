"""Alpha that a source brings is the matte, and what lies under alpha 0 counts nowhere."""

from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from capture_helpers import encode, face_picture
from mien.capture import CaptureSettings, capture_video_parts
from mien.capture.source import FrameSelection, open_source
from mien.capture.video import write_video

SIDE = 160
_DRAWN = cv2.ellipse(np.zeros((SIDE, SIDE), np.uint8), (80, 84), (52, 70), 0, 0, 360, 255, -1)
ALPHA = cv2.GaussianBlur(_DRAWN, (0, 0), 3)
VIDEOS = {
    "prores 4444.mov": ("prores_ks", "yuva444p10le", {}),
    "vp9.webm": ("libvpx-vp9", "yuva420p", {"crf": "4", "b": "0"}),
    "vp8.webm": ("libvpx", "yuva420p", {"auto-alt-ref": "0", "b": "4000000"}),
    "png.mov": ("png", "rgba", {}),
    "ffv1.mkv": ("ffv1", "yuva444p", {}),
}
PICTURES = ("png", "webp", "tiff", "16.png", "16.tiff", "grey.png")
Pixels = np.ndarray


def with_alpha(colors: Pixels, hidden: int, premultiplied: bool = False) -> Pixels:
    """Return RGBA, with a colour under alpha 0 that counts nowhere."""
    shown = colors * (ALPHA[..., None] / 255) if premultiplied else np.where(ALPHA[..., None] > 0, colors, hidden)
    return np.dstack([np.rint(shown).astype(np.uint8), ALPHA])


def expected(colors: Pixels) -> Pixels:
    share = ALPHA[..., None] / 255
    return colors * share + 128 * (1 - share)


def colors_of(kind: str) -> Pixels:
    y, x = np.mgrid[:SIDE, :SIDE]
    return np.full((SIDE, SIDE, 3), 170) if kind == "grey" else np.dstack([180 + 0 * x, 90 + x // 4, 120 + y // 4])


def write_picture(path: Path, pixels: Pixels, kind: str) -> None:
    if kind.startswith("16"):
        cv2.imwrite(str(path), pixels[..., [2, 1, 0, 3]].astype(np.uint16) * 257)
    elif kind.startswith("grey"):
        Image.fromarray(pixels[..., [0, 3]], "LA").save(path)
    else:
        # Only WebP takes the options.
        Image.fromarray(pixels).save(path, lossless=True, exact=True)


def frame_of(path: Path) -> tuple[Pixels, Pixels | None, tuple[int, ...]]:
    """Return the first picture, its alpha, and the shape of the picture when it is shrunk."""
    source = open_source(path, FrameSelection(), 25.0)
    first = next(source.frames())
    return first.picture(), first.alpha(), next(source.frames(80)).picture().shape


# A TIFF says itself which of the two it is, and OpenCV makes the colours premultiplied.
@pytest.mark.parametrize(
    ("kind", "premultiplied"),
    [*((kind, False) for kind in [*PICTURES, *VIDEOS]), *((kind, True) for kind in ["png", "16.tiff", *VIDEOS])],
)
def test_alpha_is_read_and_hides_what_lies_under_it(kind: str, premultiplied: bool, tmp_path: Path) -> None:
    colors = colors_of(kind.split(".")[0])
    for hidden in (0, 255):
        pixels = with_alpha(colors, hidden, premultiplied)
        if kind in VIDEOS:
            path = tmp_path / kind
            codec, layout, options = VIDEOS[kind]
            frame = av.VideoFrame.from_ndarray(pixels, format="rgba").reformat(format=layout)
            encode(path, [frame] * 2, codec, layout, options=options)
        else:
            path = tmp_path / str(hidden)
            path.mkdir()
            for index in range(2):
                write_picture(path / f"{index}.{kind.split('.')[-1]}", pixels, kind)
        picture, alpha, shrunk = frame_of(path)
        assert alpha is not None
        assert shrunk == (80, 80, 3)
        assert np.abs(alpha.astype(int) - ALPHA).mean() < 2
        wrong = np.abs(picture - expected(colors))
        assert wrong.mean() < 3
        assert wrong[ALPHA == 0].mean() < 2


@pytest.mark.parametrize("kind", ["png", "webp", "tiff"])
def test_an_opaque_channel_is_no_matte(kind: str, tmp_path: Path) -> None:
    colors = colors_of(kind).astype(np.uint8)
    write_picture(tmp_path / f"0.{kind}", np.dstack([colors, np.full((SIDE, SIDE), 255, np.uint8)]), kind)
    picture, alpha, _ = frame_of(tmp_path)
    assert alpha is None
    assert (picture == colors).all()


@pytest.mark.unchecked
@pytest.mark.parametrize("turn", [0, 90])
def test_a_capture_has_the_alpha_as_its_matte_and_sees_nobody_under_it(test_data, tmp_path, capsys, turn):
    """Another face lies under alpha 0: it is not found, and the picture does not show it."""
    face = face_picture(test_data)
    wide, alpha = np.hstack([face, face]), np.hstack([ALPHA, np.zeros_like(ALPHA)])
    folder = tmp_path / "pictures"
    folder.mkdir()
    for index in range(3):
        Image.fromarray(np.rot90(np.dstack([wide, alpha]), turn // 90).copy()).save(folder / f"{index}.png")
    settings = CaptureSettings(crop="none", turn=turn)
    (capture,) = capture_video_parts(folder, tmp_path / "sequences", settings)
    assert capture.valid.all()
    assert (capture.mattes == alpha).all()
    assert (capture.images[:, 0, :, SIDE:] == 128).all()
    said = capsys.readouterr().err
    assert "its alpha is the matte" in said
    assert "several faces" not in said


@pytest.mark.unchecked
def test_mattes_that_are_given_count_more_than_alpha(test_data, tmp_path):
    folder, mattes = tmp_path / "pictures", tmp_path / "mattes.mp4"
    folder.mkdir()
    Image.fromarray(np.dstack([face_picture(test_data), ALPHA])).save(folder / "0.png")
    write_video(mattes, [np.full((SIDE, SIDE, 3), 255, np.uint8)], 25, crf=1)
    settings = CaptureSettings(crop="none", mattes=mattes)
    (capture,) = capture_video_parts(folder, tmp_path / "sequences", settings)
    assert capture.mattes.min() >= 254
