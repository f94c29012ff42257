"""Pages: an .html file that shows an avatar, and the .packed file that it holds (docs/web.md)."""

from pathlib import Path
from typing import TYPE_CHECKING

from mien.formats.format import Content, Format, Options

if TYPE_CHECKING:
    from mien.export import Motion, WrittenPage

_ITSELF = {"set": "a page sets every expression itself; leave --set out"}


def _write_page(path: Path, content: Content, options: Options) -> str:
    from mien.export import write_page

    motion = content.motion()
    page = write_page(path, content.portable(confidence=False), motion, options.webcam, options.webgpu)
    return _told(content, motion, page)


def _write_packed(path: Path, content: Content, options: Options) -> str:
    from mien.export import write_packed

    motion = content.motion()
    return _told(content, motion, write_packed(path, content.portable(confidence=False), motion))


def _told(content: Content, motion: "Motion | None", page: "WrittenPage") -> str:
    moves = "" if motion is None else f", a motion of {len(motion):,} frames"
    return (
        f"{content.count:,} Gaussians{moves}, {page.size / 1e6:.1f} MB; compression changes the picture little "
        f"({page.psnr:.0f} dB)"
    )


PAGE = Format(
    "html", "avatar", _write_page, (".html",), options=frozenset({"webgpu", "webcam"}), refusals=_ITSELF
)  # fmt: skip
PACKED = Format("packed", "avatar", _write_packed, (".packed",), refusals=_ITSELF)
