"""What stands in the head of a page: its icon, and what messengers and social networks show of its address."""

import base64
import html
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urljoin, urlsplit

import numpy as np
from jaxtyping import Float64, UInt8

from mien import runtime
from mien.disk.files import write_atomically
from mien.errors import UserError
from mien.media.pixels import png_bytes

_ICON = 64
"""Side of the icon in pixels."""
POSTER = (1200, 630)
"""Width and height of the poster in pixels, which is the shape that messengers show."""
_GLOW, _EDGE = (251, 251, 252), (199, 204, 213)
"""Colours of the poster behind the head and at its edge, as those of the page."""
_QUALITY = 88


@dataclass(frozen=True)
class Described:
    """What a page says of itself."""

    title: str
    """Title of the page: the avatar's name, or what the user gives."""
    address: str | None = None
    """Address at which the page will be published. None for a page that is a file."""


def check_address(address: str) -> None:
    """Refuse what is no address of a page."""
    parts = urlsplit(address)
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise UserError(f"--address {address}: is no address; give one such as https://example.org/me.html")


def head_part(avatar: runtime.Avatar, described: Described, poster: Path | None) -> str:
    """The icon and, with an address, the tags of Open Graph, as html.

    Args:
        avatar: The avatar.
        described: What the page says of itself.
        poster: The file with the poster. It lies beside the page.
    """
    icon = base64.b64encode(png_bytes(_icon(avatar))).decode()
    tags = [f'<link rel="icon" href="data:image/png;base64,{icon}">']
    if described.address and poster:
        facts = {
            "og:type": "website",
            "og:title": described.title,
            "og:description": "A living 3D head. Turn it, and make it smile.",
            "og:url": described.address,
            "og:image": urljoin(described.address, poster.name),
            "og:image:width": str(POSTER[0]),
            "og:image:height": str(POSTER[1]),
            "og:image:alt": described.title,
            "twitter:card": "summary_large_image",
        }
        tags += [f'<meta property="{name}" content="{html.escape(text)}">' for name, text in facts.items()]
    return "".join(tags)


def write_poster(path: Path, avatar: runtime.Avatar) -> None:
    """Write the picture that messengers show: the person at rest before a soft light, 1200x630. This needs OpenCV."""
    import cv2

    from mien.media.picture_files import encode_picture

    wide, high = POSTER
    x, y = np.meshgrid(np.linspace(-1, 1, wide) * wide / high, np.linspace(-0.84, 1.16, high))
    share = np.clip(np.hypot(x, y) / 1.8, 0, 1)[..., None]
    picture = (1 - share) * np.array(_GLOW) + share * np.array(_EDGE)
    head, alpha = _drawn(avatar, high)
    left = (wide - high) // 2
    behind = picture[:, left : left + high]
    picture[:, left : left + high] = 255 * head + (1 - alpha[..., None]) * behind
    content = encode_picture(_to_uint8(picture), ".jpg", [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    write_atomically(path, lambda temporary: temporary.write_bytes(content))


def _icon(avatar: runtime.Avatar) -> UInt8[np.ndarray, "h w 4"]:
    """The head at rest as RGBA, cut to its box."""
    head, alpha = _drawn(avatar, 4 * _ICON)
    straight = 255 * head / np.maximum(alpha, 1e-3)[..., None]
    rgba = np.dstack([straight, 255 * alpha])
    rows, columns = np.flatnonzero((alpha > 0.5).any(1)), np.flatnonzero((alpha > 0.5).any(0))
    if len(rows) and len(columns):
        # A square from the top of the head: a neck below it tells little at this size.
        side = max(columns[-1] - columns[0] + 1, 1)
        rgba = rgba[rows[0] : rows[0] + side, columns[0] : columns[-1] + 1]
    down, across = (_means(count, _ICON) for count in rgba.shape[:2])
    return _to_uint8(np.einsum("ih,hwc,jw->ijc", down, rgba, across, optimize=True))


def _drawn(avatar: runtime.Avatar, side: int) -> tuple[np.ndarray, np.ndarray]:
    """The person at rest in a square picture, premultiplied, and its alpha."""
    return avatar.render(camera=avatar.camera.square(side), background=(0, 0, 0))


def _means(count: int, parts: int) -> Float64[np.ndarray, "parts count"]:
    """Weights that average `count` neighbours in `parts` equal spans."""
    edges = np.linspace(0, count, parts + 1)[:, None]
    covered = np.clip(edges - np.arange(count), 0, 1)  # share of each neighbour before each edge
    return np.diff(covered, axis=0) * parts / count


def _to_uint8(picture: np.ndarray) -> np.ndarray:
    return np.rint(picture.clip(0, 255)).astype(np.uint8)
