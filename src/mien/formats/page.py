"""One web page that shows an avatar: it opens from a file, and makes no request (docs/web.md).

page.html beside this file is built from web/ and committed, so that writing a page needs no node.
"""

import base64
import html
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import urljoin, urlsplit

import numpy as np
from jaxtyping import Float64, UInt8

from mien import runtime
from mien.disk.files import check_writable, write_atomically
from mien.errors import UserError
from mien.formats.format import Content, Options
from mien.formats.shared.packed import Motion, pack, unpacked
from mien.formats.shared.thinning import fitted
from mien.formats.shared.webcam import POLICY, WebcamFiles, webcam_part
from mien.media.pixels import png_bytes
from mien.runtime import camera_paths
from mien.runtime.baked import PortableAvatar

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


TEMPLATE = Path(__file__).with_name("shared") / "page.html"
WEBGPU = TEMPLATE.with_name("webgpu.js")
MICROPHONE = TEMPLATE.with_name("microphone.html")
_SILENT = "; form-action 'none'; base-uri 'none'"
"""Additions to the policy of a page with a microphone, so that nothing that it hears can leave it."""
_SIDE = 512
"""Sides of the pictures that the loss is measured on, in pixels."""
_SHARE = 0.25
"""Share of its range that each expression has in the second picture."""
_MOST_PSNR = 120.0
"""Figure for equal pictures, in dB."""


@dataclass(frozen=True)
class WrittenPage:
    """A page, or a packed avatar, on disk."""

    count: int
    """Number of its Gaussians."""
    size: int
    """Size in bytes."""
    psnr: float
    """Pictures of the packed avatar against those of the exact one, in dB: the lower of the person at rest and a face
    with all expressions at a quarter of their range, 512x512, over white."""


def write_page(
    path: Path,
    avatar: PortableAvatar,
    motion: Motion | None = None,
    webcam: WebcamFiles | None = None,
    webgpu: bool = False,
    described: Described | None = None,
    microphone: bool = False,
    largest: int | None = None,
) -> WrittenPage:
    """Write a page with an avatar, and a motion that it can play, as one file.

    Args:
        path: The file to write.
        avatar: The avatar.
        motion: What the page can play. None for nothing.
        webcam: Files of the face landmarker, with which a webcam can drive the avatar. None for no webcam.
        webgpu: Whether the page draws with WebGPU where the browser has it on a GPU. WebGL2 is the default.
        described: What the page says of itself. None for the avatar's name. With an address, a poster for messengers is
            written beside the page, with its name and the ending .jpg.
        microphone: Whether a button lets the lips follow a voice.
        largest: Largest size of the page in bytes, for which Gaussians that add least are left out. None for all.
    """
    check_writable(path)
    described = described or Described(avatar.about.name)
    poster = path.with_suffix(".jpg") if described.address else None
    if poster:
        check_writable(poster)
    drawn, filmed = runtime.Avatar(avatar), avatar.camera
    zoom = camera_paths.zoom_at_rest(drawn, (filmed.width, filmed.height))
    if zoom < 1:
        avatar = replace(avatar, camera=camera_paths.fitted(filmed, filmed.width, filmed.height, zoom))
        drawn = runtime.Avatar(avatar)
    parts = {
        "head": head_part(drawn, described, poster),
        "policy": POLICY if webcam else _SILENT if microphone else "",
        "microphone": MICROPHONE.read_text(encoding="utf-8") if microphone else "",
        "webcam": webcam_part(webcam) if webcam else "",
        "title": html.escape(described.title),
        "webgpu": f"\n<script>{WEBGPU.read_text(encoding='utf-8').strip()}</script>" if webgpu else "",
        "avatar": "",
    }
    template = TEMPLATE.read_text(encoding="utf-8")
    shown = avatar
    if largest is not None:
        empty = len(filled(template, parts).encode())
        shown = fitted(path, avatar, motion, largest, lambda packed: empty + 4 * -(-len(packed) // 3))
    parts["avatar"] = base64.b64encode(pack(shown, motion)).decode()
    content = filled(template, parts).encode()
    if poster:
        write_poster(poster, drawn)
    write_atomically(path, lambda temporary: temporary.write_bytes(content))
    return _written(len(content), avatar, shown)


def filled(template: str, parts: Mapping[str, str]) -> str:
    """A template with its marks, {{name}}, replaced in one pass: marks inside of a part, such as a name, stay text."""
    return re.sub(rf"{{{{({'|'.join(parts)})}}}}", lambda mark: parts[mark[1]], template)


def write_packed(
    path: Path, avatar: PortableAvatar, motion: Motion | None = None, largest: int | None = None
) -> WrittenPage:
    """Write the packed form alone, for pages of one's own (`<mien-avatar src=...>`, docs/publishing.md).

    With `largest`, Gaussians that add least are left out until it has at most so many bytes.
    """
    check_writable(path)
    shown = avatar if largest is None else fitted(path, avatar, motion, largest, len)
    content = pack(shown, motion)
    write_atomically(path, lambda temporary: temporary.write_bytes(content))
    return _written(len(content), avatar, shown)


def _written(size: int, avatar: PortableAvatar, shown: PortableAvatar) -> WrittenPage:
    return WrittenPage(len(shown.baked.attributes.opacity_logits), size, _psnr(avatar, shown))


def _psnr(avatar: PortableAvatar, shown: PortableAvatar) -> float:
    exact, read = runtime.Avatar(avatar), runtime.Avatar(unpacked(shown))
    camera = avatar.camera.resized(_SIDE, _SIDE)
    low, high = avatar.expression_bounds.T
    rest = avatar.neutral.expression
    errors = []
    for expression in (rest, (low + _SHARE * (high - low)).astype(np.float32)):
        first, second = (a.render(a.pose(expression), camera)[0].clip(0, 1) for a in (exact, read))
        errors.append(float(np.square(first - second, dtype=np.float64).mean()))
    worst = max(errors)
    return _MOST_PSNR if worst == 0 else min(_MOST_PSNR, -10 * float(np.log10(worst)))


_GAPS = 38
"""PSNR against the picture with all Gaussians, in dB, below which gaps were seen on a filmed person."""


def write(path: Path, content: Content, options: Options) -> str:
    """Write the file, and return what is told of it."""
    motion = content.motion()
    avatar = content.portable(confidence=False, soft_cut=options.soft_cut)
    described = Described(options.title or avatar.about.name, options.address)
    largest = _bytes(options)
    page = write_page(path, avatar, motion, options.webcam, options.webgpu, described, options.microphone, largest)
    poster = f"\n{path.with_suffix('.jpg')}: the picture that messengers show" if options.address else ""
    return _told(content, motion, page) + poster


def write_packed_file(path: Path, content: Content, options: Options) -> str:
    """Write the file, and return what is told of it."""
    motion = content.motion()
    avatar = content.portable(confidence=False, soft_cut=options.soft_cut)
    return _told(content, motion, write_packed(path, avatar, motion, _bytes(options)))


def _bytes(options: Options) -> int | None:
    return None if options.largest is None else round(1e6 * options.largest)


def _told(content: Content, motion: Motion | None, page: WrittenPage) -> str:
    moves = "" if motion is None else f", a motion of {len(motion):,} frames"
    if page.count < content.count:
        kept = f"the {page.count:,} of {content.count:,} Gaussians that add most to its pictures"
        gaps = "; gaps show, in the eyes first, so allow more" if page.psnr < _GAPS else ""
        return (
            f"{kept}{moves}, {page.size / 1e6:.2f} MB ({page.psnr:.0f} dB against the picture with all of them{gaps})"
        )
    return (
        f"{content.count:,} Gaussians{moves}, {page.size / 1e6:.1f} MB; compression changes the picture little "
        f"({page.psnr:.0f} dB)"
    )
