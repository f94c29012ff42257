"""Pages: an .html file that shows an avatar, and the .packed file that it holds (docs/web.md)."""

from pathlib import Path

from mien import export
from mien.formats.format import Content, Format, Options

_GAPS = 38
"""PSNR against the picture with all Gaussians, in dB, below which gaps were seen on a filmed person."""
_ITSELF = {"set": "a page sets every expression itself; leave --set out"}


def _write_page(path: Path, content: Content, options: Options) -> str:
    motion = content.motion()
    avatar = content.portable(confidence=False, soft_cut=options.soft_cut)
    described = export.Described(options.title or avatar.about.name, options.address)
    largest = _bytes(options)
    page = export.write_page(
        path, avatar, motion, options.webcam, options.webgpu, described, options.microphone, largest
    )
    poster = f"\n{path.with_suffix('.jpg')}: the picture that messengers show" if options.address else ""
    return _told(content, motion, page) + poster


def _write_packed(path: Path, content: Content, options: Options) -> str:
    motion = content.motion()
    avatar = content.portable(confidence=False, soft_cut=options.soft_cut)
    return _told(content, motion, export.write_packed(path, avatar, motion, _bytes(options)))


def _bytes(options: Options) -> int | None:
    return None if options.largest is None else round(1e6 * options.largest)


def _told(content: Content, motion: "export.Motion | None", page: "export.WrittenPage") -> str:
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


PAGE = Format(
    "html",
    "avatar",
    _write_page,
    (".html",),
    options=frozenset({"webgpu", "webcam", "microphone", "title", "address", "soft_cut", "largest"}),
    refusals=_ITSELF,
)
PACKED = Format(
    "packed", "avatar", _write_packed, (".packed",), options=frozenset({"soft_cut", "largest"}), refusals=_ITSELF
)
