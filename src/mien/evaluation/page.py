"""What report.html and compare.html share: the frame of the page, explanations, pictures and videos.

The functions return HTML. A page is one file that can be sent around. It needs no network and no scripts, and works in
light, in dark and on paper.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from mien.evaluation.metrics_file import COLUMNS
from mien.pictures import ERROR_LIMIT, data_uri, heat_gradient, picture_uri, shrink

GLOSSARY = {
    "Held-out frames": (
        "Frames that training never saw. blocks: every fifth block of 10 frames. tail: the last 20 %, which may show "
        "poses and expressions that never occurred before, so its figures are lower. sequences: whole sequences, posed "
        "as tracked. cameras: held-out cameras, at timesteps that training saw through other cameras."
    ),
    "Target": (
        "The picture inside a frozen mask (the matte, cut at the neck), over white. The mask does not change "
        "when the sequence is tracked again, so that runs can be compared."
    ),
    "Whole frame, head crop": (
        "A white background raises the PSNR of the whole frame by several dB, so compare clips by their head crops. "
        "The head crop is the box of the mask."
    ),
    "Eyes, mouth": (
        "Boxes around the lids and around the lips of the tracked mesh, with a margin, in frames in which it faces the "
        "camera. ST-LPIPS enlarges them if a side is shorter than 64 pixels."
    ),
    "Baselines": (
        "An avatar must beat both: the mean of all training pictures, and the tracked mesh with the colours that "
        "training frames show on it. The green figure is the avatar's lead over the better one, in dB."
    ),
    "Face parameters": (
        "as tracked: the tracker alone poses held-out frames. corrected: training also improved the tracking of the "
        "frames that it saw, and held-out frames get these corrections, interpolated over time. The pixels of held-out "
        "frames are never used."
    ),
    "PSNR, SSIM, L1": (
        "Images are in 0..1 and clamped. Figures are means over frames. SSIM uses an 11x11 Gaussian window of sigma "
        "1.5, with zeros beyond the border."
    ),
    "ST-LPIPS": (
        "A learned distance that tolerates shifts of a few pixels. Its figures cannot be compared with those of LPIPS."
    ),
}
"""Explanation of each term, for readers who see it for the first time."""
FITTED_GLOSSARY = {
    "Faces fitted to the scored pictures": (
        "Expression and pose of each held-out frame, tuned by the difference of colours to the very picture that is "
        "scored. The figures show what the avatar can draw, not what it predicts, so compare them only with each other."
    ),
}
"""Explanation for pages that show such figures."""
_MAX_EMBEDDED_BYTES = 6 << 20


def page_html(title: str, body: str, *, broad: bool = False) -> str:
    """A whole page. `body` is HTML; `title` is text."""
    style = files("mien.evaluation").joinpath("report.css").read_text(encoding="utf-8")
    main = '<main class="broad">' if broad else "<main>"
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>mien: {escape(title)}</title>\n<style>\n{style}</style></head>\n"
        f"<body>{main}\n{body}\n</main></body></html>\n"
    )


def glossary_html(terms: Mapping[str, str] = GLOSSARY) -> str:
    """The explanations, folded."""
    entries = "".join(f"<dt>{term}</dt><dd>{escape(text)}</dd>" for term, text in terms.items())
    return f'<details class="card"><summary>How to read this</summary><dl>{entries}</dl></details>'


def metric_headings(crops: int | None = None) -> str:
    """The heading cells of all metrics, for the whole frame and then for the head crop, or for a number of crops."""
    names = "".join(f"<th>{name} {'↑' if higher else '↓'}</th>" for _, name, _, higher in COLUMNS)
    crop = names.replace("<th>", '<th class="head">', 1)
    return names + crop if crops is None else crops * crop


def metric_groups() -> str:
    """The cells above `metric_headings`."""
    count = len(COLUMNS)
    return (
        f'<th class="group" colspan="{count}">Whole frame</th><th class="group head" colspan="{count}">Head crop</th>'
    )


def error_scale(label: str = "") -> str:
    """The colours of `error_heat`, with their limits."""
    return (
        f'<span class="scale">{label}0 <i style="background:{heat_gradient()}"></i> '
        f"{ERROR_LIMIT * 255:.0f} of 255 and more</span>"
    )


def picture_html(picture: UInt8[np.ndarray, "_ _ 3"], what: str, max_side: int) -> str:
    """A picture whose longer side has at most `max_side` pixels. `what` is its text for readers who do not see it."""
    return f'<img alt="{escape(what)}" src="{picture_uri(shrink(picture, max_side))}">'


def video_html(path: Path, page_folder: Path, note: str) -> str:
    """A video: embedded if it is small, so that the page stays one file, or else linked."""
    link = path.relative_to(page_folder).as_posix()
    is_small = path.stat().st_size <= _MAX_EMBEDDED_BYTES
    source = data_uri("video/mp4", path.read_bytes()) if is_small else link
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
        """The video of truth, rendering and error."""
        part = "" if self.shown == self.scored else f", {self.shown} of {self.scored} frames"
        return video_html(self.path, page_folder, f"Truth, rendering, error{part}")
