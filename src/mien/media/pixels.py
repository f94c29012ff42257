"""Pictures as bytes: 8 bits a channel, and the content of a .png file. This needs numpy alone."""

import struct
import zlib

import numpy as np
from jaxtyping import Float32, UInt8

_ROWS = 512  # converted at a time. An 8192x8192 picture would otherwise be in memory four times
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_COLORS = {3: 2, 4: 6}  # channels -> colour type of a PNG (W3C PNG, table 11.1): RGB, and RGB with alpha
_PNG_UP = 2  # filter of a row: its difference to the row above


def to_rgb(image: Float32[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """A picture in 0..1 as bytes, clamped and rounded. It is converted in bands of rows."""
    picture = np.empty(image.shape, np.uint8)
    for top in range(0, len(image), _ROWS):
        picture[top : top + _ROWS] = np.clip(image[top : top + _ROWS], 0, 1) * 255 + 0.5
    return picture


def to_rgba(over_black: Float32[np.ndarray, "h w 3"], alpha: Float32[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 4"]:
    """A picture rendered over black, as straight colours and alpha. Colours are 0 where alpha is 0."""
    picture = np.empty((*alpha.shape, 4), np.uint8)
    for top in range(0, len(alpha), _ROWS):
        band = slice(top, top + _ROWS)
        opacity = alpha[band, :, None]
        colors = np.divide(over_black[band], opacity, out=np.zeros_like(over_black[band]), where=opacity > 1e-6)
        picture[band, :, :3] = np.clip(colors, 0, 1) * 255 + 0.5
        picture[band, :, 3] = np.clip(alpha[band], 0, 1) * 255 + 0.5
    return picture


def png_bytes(picture: UInt8[np.ndarray, "h w c"]) -> bytes:
    """The content of a .png file, for an RGB or RGBA picture. For where OpenCV is not installed."""
    height, width, channels = picture.shape
    rows = picture.reshape(height, width * channels)
    filtered = np.empty((height, 1 + rows.shape[1]), np.uint8)
    filtered[:, 0] = _PNG_UP
    filtered[0, 1:] = rows[0]
    np.subtract(rows[1:], rows[:-1], out=filtered[1:, 1:])  # modulo 256, as the format has it
    header = struct.pack(">IIBBBBB", width, height, 8, _PNG_COLORS[channels], 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(filtered.tobytes(), 6)), (b"IEND", b""))
    return _PNG_SIGNATURE + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )
