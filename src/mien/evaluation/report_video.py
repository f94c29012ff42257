"""Videos in report.html: small ones inside the page, large ones as links."""

from dataclasses import dataclass
from html import escape
from pathlib import Path

from mien.pictures import data_uri

_EMBEDDED_BYTES = 6 << 20


def video_html(path: Path, page_folder: Path, note: str) -> str:
    """A video for the page: embedded if it is small, so that the page stays one file, or else linked."""
    link = path.relative_to(page_folder).as_posix()
    data = path.read_bytes()
    source = data_uri("video/mp4", data) if len(data) <= _EMBEDDED_BYTES else link
    return (
        f'<video controls muted loop preload="metadata" src="{escape(source)}"></video>'
        f'<p class="note">{escape(note)}: <a href="{escape(link)}">{escape(link)}</a></p>'
    )


@dataclass(frozen=True)
class ReportVideo:
    """A side-by-side video of a protocol."""

    path: Path
    shown: int
    """Number of frames in the video."""
    scored: int
    """Number of frames that were scored."""

    def html(self, page_folder: Path) -> str:
        """The video of truth, rendering and error, as HTML for the page."""
        part = "" if self.shown == self.scored else f", {self.shown} of {self.scored} frames"
        return video_html(self.path, page_folder, f"Truth, rendering, error{part}")
