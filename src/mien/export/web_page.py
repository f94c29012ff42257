"""One web page that shows an avatar: it opens from a file, and makes no request (docs/web.md).

page.html beside this file is built from web/ and committed, so that writing a page needs no node.
"""

import base64
import html
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mien import runtime
from mien.disk.files import check_writable, write_atomically
from mien.export.page_head import Described, head_part, write_poster
from mien.formats.shared.packed import Motion, pack, unpacked
from mien.formats.shared.thinning import fitted
from mien.formats.shared.webcam import POLICY, WebcamFiles, webcam_part
from mien.runtime import camera_paths
from mien.runtime.baked import PortableAvatar

TEMPLATE = Path(__file__).with_name("page.html")
WEBGPU = Path(__file__).with_name("webgpu.js")
MICROPHONE = Path(__file__).with_name("microphone.html")
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
