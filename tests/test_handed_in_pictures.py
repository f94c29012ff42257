"""The announced size of a user's picture is checked before memory is allocated."""

import struct
import subprocess
import sys
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from mien.capture.crop import whole_picture
from mien.capture.given import GivenMattes
from mien.capture.picture import MAX_PICTURE_PIXELS, announced_size, decode_picture
from mien.capture.source import read_image
from mien.errors import UserError
from mien.evaluation.image_source import read_picture


def png(width: int, height: int, rows: int) -> bytes:
    """Return a black grey PNG that announces a size and holds this many rows of it."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packer = zlib.compressobj(9)
    row = bytes(width + 1)
    packed = b"".join(packer.compress(row) for _ in range(rows)) + packer.flush()
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", packed) + chunk(b"IEND", b"")


def tiff(width: int, height: int, order: str) -> bytes:
    entries = ((256, 4, 1, width), (257, 4, 1, height), (258, 3, 1, 8))
    packed = b"".join(struct.pack(order + "HHII", *entry) for entry in entries)
    return (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "IH", 8, len(entries)) + packed


pytestmark = pytest.mark.unchecked
HUGE = {
    "a.png": png(30_000, 30_000, 1),
    "a.jpg": b"\xff\xd8\xff\xe0\x00\x04ab\xff\xff\xc2\x00\x11\x08" + struct.pack(">HH", 30_000, 30_000),
    "a.bmp": b"BM" + bytes(12) + struct.pack("<Iii", 40, 30_000, -30_000),
    "old.bmp": b"BM" + bytes(12) + struct.pack("<IHH", 12, 30_000, 30_000),
    "x.webp": b"RIFF    WEBPVP8X\n\0\0\0\0\0\0\0" + 2 * (29_999).to_bytes(3, "little"),
    "a.tif": tiff(30_000, 30_000, "<"),
    "b.tif": tiff(30_000, 30_000, ">"),
    "jpeg.png": b"\xff\xd8\xff\xc0\x00\x11\x08" + struct.pack(">HH", 30_000, 30_000),
}


@pytest.mark.parametrize("name", HUGE)
def test_a_huge_picture_is_refused_with_its_size(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(HUGE[name] + b"IEND\xaeB`\x82")
    mattes = [lambda _: GivenMattes(tmp_path, (8, 8)).matte(0, whole_picture(8, 8, 8))] * name.endswith(".png")
    for read in (read_image, read_picture, *mattes):
        with pytest.raises(UserError, match="has 30000x30000 pixels, .* at most 67,108,864") as error:
            read(path)
        assert str(error.value).startswith(f"{path}: ")


@pytest.mark.parametrize("ending", [".png", ".jpg", ".bmp", ".webp", ".tif", ".tiff"])
def test_what_is_announced_is_what_is_decoded(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"a{ending}"
    for shape in ((7, 13, 3), (13, 7), (1, 1, 3)):
        assert cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8))
        assert announced_size(path.read_bytes()) == (shape[1], shape[0])
        assert read_image(path).shape == (*shape[:2], 3)
        for length in range(0, 40, 3):
            assert announced_size(path.read_bytes()[:length]) in (None, (shape[1], shape[0]))


def test_lossless_and_lossy_webp_are_read(tmp_path: Path) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (21, 34, 4), dtype=np.uint8)
    for channels, quality, kind in ((3, 50, b"VP8 "), (3, 101, b"VP8L"), (4, 50, b"VP8X")):
        data = cv2.imencode(".webp", picture[..., :channels], [cv2.IMWRITE_WEBP_QUALITY, quality])[1].tobytes()
        assert (announced_size(data), data[12:16]) == ((34, 21), kind)


def test_other_kinds_of_pictures_are_not_decoded(tmp_path: Path) -> None:
    """Other kinds of pictures are not decoded under any name, since every decoder may have faults."""
    path = tmp_path / "a.png"
    path.write_bytes(b"P5 2 2 255 abcd")
    assert cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_COLOR) is not None
    assert decode_picture(path, cv2.IMREAD_COLOR) is None
    with pytest.raises(UserError, match="cannot be read as an image"):
        read_image(path)
    # Nor is a picture of thousands of scans.
    data = cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    path.write_bytes(data)
    assert decode_picture(path, cv2.IMREAD_COLOR) is not None
    path.write_bytes(data[:-2] + b"\xff\xda\x00\x08\x01\x01\x00\x01\x3f\x00" * 5000 + b"\xff\xd9")
    assert decode_picture(path, cv2.IMREAD_COLOR) is None
    # The largest picture is read.
    path.write_bytes(png(MAX_PICTURE_PIXELS // 256, 256, 256))
    assert decode_picture(path, cv2.IMREAD_GRAYSCALE) is not None
    path.write_bytes(png(MAX_PICTURE_PIXELS // 256 + 1, 256, 256))
    with pytest.raises(UserError, match="at most 67,108,864"):
        decode_picture(path, cv2.IMREAD_GRAYSCALE)


def test_opencv_itself_refuses_what_our_reader_would_miss(tmp_path: Path) -> None:
    """OpenCV refuses what mien's reader would miss. The command line sets OpenCV's limit before it is imported."""
    path = tmp_path / "a.png"
    path.write_bytes(png(10_000, 8_000, 8_000))
    code = (
        "import sys, mien.cli; mien.cli.main(['capture', 'none.mp4', '--out', 'none']); import cv2\n"
        "try: print(cv2.imread(sys.argv[1]) is None)\nexcept cv2.error: print(True)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, cwd=tmp_path)
    assert done.stdout.strip() == "True", done
