"""Expected times of the stages of `mien create`, from the number of frames and steps."""

from collections.abc import Sequence
from pathlib import Path

from mien.capture.settings import CaptureSettings
from mien.disk.inside import listed
from mien.errors import UserError
from mien.machine.progress import Piece
from mien.media.video import probe_video
from mien.tracking.settings import TrackingSettings
from mien.training.settings import AlignmentSettings, TrainSettings

_FIND, _CAPTURE, _LANDMARKS, _PIXELS, _SCORING, _OVERLAY = 0.005, 0.036, 0.062, 0.07, 0.015, 0.055
_SHARED_PIXELS = 10.0
_STEP = 0.042
_TEMPLATE_STEP, _ALIGN = 0.03, 0.012
_SCORE, _PERCEPTUAL, _VIDEO = 0.35, 0.9, 0.05
"""Seconds per frame, per step and per scored frame: medians over clips of 216 to 587 frames of 512x512, two cores."""
_PERCEPTUAL_FRAMES = 24
_HELD_OUT = 0.2
"""Share of frames that a split holds out."""


def count_captured(source: Path, settings: CaptureSettings) -> int:
    """About how many frames of a video or a folder of pictures will be captured; 0 if that cannot be told."""
    try:
        if source.is_dir():
            fps, frames = settings.fps, len(listed(source))
        else:
            info = probe_video(source, settings.stream)
            fps, frames = info.fps, info.frames
    except (UserError, OSError):  # the stage itself reports it
        return 0
    last = min(frames, round(settings.end * fps)) if settings.end > 0 else frames
    taken = max(last - round(settings.start * fps), 0) // max(settings.stride, 1)
    return min(taken, settings.max_frames) if settings.max_frames > 0 else taken


def expected_pieces(
    frames: Sequence[int],
    scored: int,
    tracking: TrackingSettings,
    settings: TrainSettings,
    overlay: str,
    alignment: AlignmentSettings | None = None,
) -> list[Piece]:
    """The pieces of `mien create` in their order, with expected times.

    Args:
        frames: Number of frames of each video.
        scored: Number of frames to score.
        tracking: Settings of the tracking.
        settings: Settings of the training.
        overlay: Frames in the overlay: auto, all or none.
        alignment: Settings of the alignment. None if there is none.
    """
    from mien.tracking.report.overlay import overlay_stride  # it needs torch

    pieces, total = [], sum(frames)
    for count in frames:
        pieces += [Piece("capture", "find the face in", _FIND * count), Piece("capture", "capture ", _CAPTURE * count)]
    pieces.append(Piece("tracking", "Tracking", _LANDMARKS * total))
    if tracking.schedule == "fast":
        pieces.append(Piece("tracking", "Fitting to pixels", _SHARED_PIXELS + _PIXELS * total))
    pieces += [Piece("tracking", "Scoring masks", _SCORING * count) for count in frames]
    if alignment is not None:
        pieces.append(Piece("alignment", "template: training", _TEMPLATE_STEP * alignment.template_steps))
        pieces.append(Piece("alignment", "aligning", _ALIGN * alignment.iterations * total))
    for count in frames:
        if overlay != "none":
            every = overlay_stride(count) if overlay == "auto" else 1
            stage = "tracking" if alignment is None else "alignment"  # It shows the final tracking.
            pieces.append(Piece(stage, "Overlay", _OVERLAY * count / every))
    pieces.append(Piece("training", "training", _STEP * settings.steps))
    if settings.holds_out:
        seconds = _SCORE * scored + _PERCEPTUAL * min(scored, _PERCEPTUAL_FRAMES)
        pieces += [Piece("scoring", "evaluate ", seconds), Piece("scoring", "video ", _VIDEO * scored)]
    return pieces


def count_scored(frames: Sequence[int], names: Sequence[str], settings: TrainSettings) -> int:
    """About how many frames will be held out and scored, of videos with these names."""
    held = sum(count for count, name in zip(frames, names, strict=False) if name in settings.held_out_sequences)
    held += (sum(frames) - held) * _HELD_OUT if settings.split != "none" else 0
    return round(held)
