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
from mien.formats.format import Content, MotionOptions, check_options
from mien.formats.mien import MienOptions
from mien.formats.shared.packed import Motion, pack, unpacked
from mien.formats.shared.thinning import fitted
from mien.formats.shared.webcam import POLICY, webcam_files, webcam_part
from mien.media.pixels import png_bytes
from mien.runtime import camera_paths
from mien.runtime.baked import PortableAvatar

TEMPLATE = Path(__file__).parent / "shared" / "page.html"
WEBGPU = TEMPLATE.with_name("webgpu.js")
MICROPHONE = TEMPLATE.with_name("microphone.html")
POSTER = (1200, 630)
"""Width and height of the poster in pixels, which is the shape that messengers show."""
_SILENT = "; form-action 'none'; base-uri 'none'"
"""Additions to the policy of a page with a microphone, so that nothing that it hears can leave it."""
_GAPS = 38
"""PSNR against the picture with all Gaussians, in dB, below which gaps were seen on a filmed person."""


@dataclass(frozen=True)
class PackedOptions(MotionOptions, MienOptions):
    """Options of .packed files."""

    largest: float | None = None
    """Largest size of the file in MB. Gaussians that add least to pictures are left out until it fits (default: all
    stay)."""

    @property
    def most_bytes(self) -> int | None:
        """Largest size in bytes."""
        return None if self.largest is None else round(1e6 * self.largest)


@dataclass(frozen=True)
class PageOptions(PackedOptions):
    """Options of .html files."""

    webgpu: bool = False
    """The page draws with WebGPU where the browser has it on a GPU, and with WebGL2 elsewhere. The page becomes 22 kB
    larger."""
    webcam: bool = False
    """A button with which the viewer's own face drives the avatar. The page becomes 9 MB larger; nothing of the camera
    leaves it."""
    webcam_model: Path | None = None
    """The same with another face_landmarker.task than that of mien (default: the file that MIEN_FACE_LANDMARKER names,
    or mien's)."""
    microphone: bool = False
    """A button after which the lips follow the viewer's voice. The page becomes 4 kB larger; no sound leaves it."""
    title: str | None = None
    """The title of the page (default: the avatar's name)."""
    address: str | None = None
    """The address at which you will publish the page, such as https://example.org/me.html. Messengers then show a
    picture of the avatar, which is written beside the page."""

    @property
    def has_webcam(self) -> bool:
        """Whether the viewer's face can drive the avatar."""
        return self.webcam or self.webcam_model is not None


def check_packed(path: Path, options: PackedOptions) -> None:
    """Check that a file can have the size that is asked for."""
    check_options(path, options)
    if options.largest is not None and not options.largest > 0:
        raise UserError(f"--largest {options.largest:g}: give a number of MB above 0")


def check_page(path: Path, options: PageOptions) -> None:
    """Check the address, and that the files for a webcam are there."""
    check_packed(path, options)
    if options.address is not None:
        parts = urlsplit(options.address)
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise UserError(f"--address {options.address}: is no address; give one such as https://example.org/me.html")
    if options.has_webcam:
        webcam_files(options.webcam_model)


def _head_part(avatar: runtime.Avatar, title: str, address: str | None, poster: Path) -> str:
    """The icon and, with an address, the tags of Open Graph, as html. The poster lies beside the page."""
    icon = base64.b64encode(png_bytes(_icon(avatar))).decode()
    tags = [f'<link rel="icon" href="data:image/png;base64,{icon}">']
    if address:
        facts = {
            "og:type": "website", "og:title": title, "og:description": "A living 3D head. Turn it, and make it smile.",
            "og:url": address, "og:image": urljoin(address, poster.name), "og:image:width": str(POSTER[0]),
            "og:image:height": str(POSTER[1]), "og:image:alt": title, "twitter:card": "summary_large_image",
        }  # fmt: skip
        tags += [f'<meta property="{name}" content="{html.escape(text)}">' for name, text in facts.items()]
    return "".join(tags)


def _write_poster(path: Path, avatar: runtime.Avatar) -> None:
    """Write the picture that messengers show: the person at rest before a soft light. This needs OpenCV."""
    import cv2

    from mien.media.picture_files import encode_picture

    wide, high = POSTER
    x, y = np.meshgrid(np.linspace(-1, 1, wide) * wide / high, np.linspace(-0.84, 1.16, high))
    share = np.clip(np.hypot(x, y) / 1.8, 0, 1)[..., None]
    picture = (1 - share) * np.array((251, 251, 252)) + share * np.array((199, 204, 213))  # as the page
    head, alpha = _drawn(avatar, high)
    left = (wide - high) // 2
    behind = picture[:, left : left + high]
    picture[:, left : left + high] = 255 * head + (1 - alpha[..., None]) * behind
    content = encode_picture(_to_uint8(picture), ".jpg", [cv2.IMWRITE_JPEG_QUALITY, 88])
    write_atomically(path, lambda temporary: temporary.write_bytes(content))


def _icon(avatar: runtime.Avatar) -> UInt8[np.ndarray, "h w 4"]:
    """The head at rest as RGBA, cut to its box, 64x64."""
    head, alpha = _drawn(avatar, 256)
    straight = 255 * head / np.maximum(alpha, 1e-3)[..., None]
    rgba = np.dstack([straight, 255 * alpha])
    rows, columns = np.flatnonzero((alpha > 0.5).any(1)), np.flatnonzero((alpha > 0.5).any(0))
    if len(rows) and len(columns):
        # A square from the top of the head: a neck below it tells little at this size.
        side = max(columns[-1] - columns[0] + 1, 1)
        rgba = rgba[rows[0] : rows[0] + side, columns[0] : columns[-1] + 1]
    down, across = (_means(count, 64) for count in rgba.shape[:2])
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
    path: Path, avatar: PortableAvatar, motion: Motion | None = None, options: PageOptions | None = None
) -> WrittenPage:
    """Write a page with an avatar, and a motion that it can play, as one file.

    With an address, a poster for messengers is written beside the page, with its name and the ending .jpg.
    """
    options, poster = options or PageOptions(), path.with_suffix(".jpg")
    check_writable(path)
    if options.address:
        check_writable(poster)
    drawn, filmed = runtime.Avatar(avatar), avatar.camera
    zoom = camera_paths.zoom_at_rest(drawn, (filmed.width, filmed.height))
    if zoom < 1:
        avatar = replace(avatar, camera=camera_paths.fitted(filmed, filmed.width, filmed.height, zoom))
        drawn = runtime.Avatar(avatar)
    title = options.title or avatar.about.name
    parts = {
        "head": _head_part(drawn, title, options.address, poster),
        "policy": POLICY if options.has_webcam else _SILENT if options.microphone else "",
        "microphone": MICROPHONE.read_text(encoding="utf-8") if options.microphone else "",
        "webcam": webcam_part(options.webcam_model) if options.has_webcam else "",
        "title": html.escape(title),
        "webgpu": f"\n<script>{WEBGPU.read_text(encoding='utf-8').strip()}</script>" if options.webgpu else "",
        "avatar": "",
    }
    template, shown = TEMPLATE.read_text(encoding="utf-8"), avatar
    if options.most_bytes is not None:
        empty = len(_filled(template, parts).encode())
        shown = fitted(path, avatar, motion, options.most_bytes, lambda packed: empty + 4 * -(-len(packed) // 3))
    parts["avatar"] = base64.b64encode(pack(shown, motion)).decode()
    content = _filled(template, parts).encode()
    if options.address:
        _write_poster(poster, drawn)
    write_atomically(path, lambda temporary: temporary.write_bytes(content))
    return _written(len(content), avatar, shown)


def _filled(template: str, parts: Mapping[str, str]) -> str:
    """A template with its marks, {{name}}, replaced in one pass: marks inside of a part, such as a name, stay text."""
    return re.sub(rf"{{{{({'|'.join(parts)})}}}}", lambda mark: parts[mark[1]], template)


def write_packed(
    path: Path, avatar: PortableAvatar, motion: Motion | None = None, options: PackedOptions | None = None
) -> WrittenPage:
    """Write the packed form alone, for pages of one's own (`<mien-avatar src=...>`, docs/publishing.md)."""
    check_writable(path)
    most = None if options is None else options.most_bytes
    shown = avatar if most is None else fitted(path, avatar, motion, most, len)
    content = pack(shown, motion)
    write_atomically(path, lambda temporary: temporary.write_bytes(content))
    return _written(len(content), avatar, shown)


def _written(size: int, avatar: PortableAvatar, shown: PortableAvatar) -> WrittenPage:
    """What was written, with the PSNR of the packed avatar."""
    exact, read = runtime.Avatar(avatar), runtime.Avatar(unpacked(shown))
    camera, rest = avatar.camera.resized(512, 512), avatar.neutral.expression
    low, high = avatar.expression_bounds.T
    errors = []
    for expression in (rest, (low + 0.25 * (high - low)).astype(np.float32)):
        first, second = (a.render(a.pose(expression), camera)[0].clip(0, 1) for a in (exact, read))
        errors.append(float(np.square(first - second, dtype=np.float64).mean()))
    psnr = min(120.0, -10 * float(np.log10(max(*errors, 1e-12))))
    return WrittenPage(len(shown.baked.attributes.opacity_logits), size, psnr)


def write(path: Path, content: Content, options: PageOptions) -> str:
    """Write the file, and return what is told of it."""
    motion, avatar = content.motion(), content.portable(confidence=False, soft_cut=not options.sharp_cut)
    page = write_page(path, avatar, motion, options)
    poster = f"\n{path.with_suffix('.jpg')}: the picture that messengers show" if options.address else ""
    return _told(content, motion, page) + poster


def write_packed_file(path: Path, content: Content, options: PackedOptions) -> str:
    """Write the file, and return what is told of it."""
    motion, avatar = content.motion(), content.portable(confidence=False, soft_cut=not options.sharp_cut)
    return _told(content, motion, write_packed(path, avatar, motion, options))


def _told(content: Content, motion: Motion | None, page: WrittenPage) -> str:
    moves = "" if motion is None else f", a motion of {len(motion):,} frames"
    if page.count < content.count:
        gaps = "; gaps show, in the eyes first, so allow more" if page.psnr < _GAPS else ""
        return (
            f"the {page.count:,} of {content.count:,} Gaussians that add most to its pictures{moves}, "
            f"{page.size / 1e6:.2f} MB ({page.psnr:.0f} dB against the picture with all of them{gaps})"
        )
    return (
        f"{content.count:,} Gaussians{moves}, {page.size / 1e6:.1f} MB; compression changes the picture little "
        f"({page.psnr:.0f} dB)"
    )
