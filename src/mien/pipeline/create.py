"""The end of `mien create`: a page and a film of the avatar, and the next commands."""

import shlex
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from mien.avatar.files import load_avatar
from mien.capture.settings import CaptureSettings
from mien.disk.files import write_atomically
from mien.disk.inside import listed
from mien.disk.workspace import Workspace
from mien.errors import UserError
from mien.evaluation.living import FILM, living, write_film
from mien.formats.page import write_page
from mien.formats.shared.packed import Motion
from mien.machine.progress import Piece, say
from mien.media.video import probe_video
from mien.pages.pages import LIVING_PAGE
from mien.pipeline.export import RunContent, Series
from mien.tracking.settings import TrackingSettings
from mien.training.alignment_settings import AlignmentSettings
from mien.training.footage.filmed import read_coverage
from mien.training.run import read_run_config, run_camera
from mien.training.settings import TrainSettings

MOVIE = "me.mp4"
"""Name of the film in the workspace."""
_SECONDS = 8.0
"""Length of the filmed motion that the page plays, in seconds."""


def show_film(workspace: Workspace, run: str) -> None:
    """Write DIR/me.mp4 of a run."""
    root, run_dir = workspace.root, workspace.run_dir(run)
    try:
        film = run_dir / FILM
        if not film.is_file():
            avatar = load_avatar(run_dir)
            coverage = read_coverage(run_dir, avatar.face_model)
            alive = living(avatar, run_camera(run_dir), root.resolve().name, coverage)
            if alive is not None:
                write_film(film, alive)
        if film.is_file():
            write_atomically(root / MOVIE, lambda aside: _copy(film, aside))
            say(f"{root / MOVIE}: five seconds of the avatar")
    except UserError as error:
        say(f"no film: {error}")


def show_page(workspace: Workspace, run: str) -> None:
    """Write DIR/me.html of a run. The report links it, so it comes first.

    An avatar that may not be passed on, or that pages cannot draw, gets no page, with a message.
    """
    root, run_dir = workspace.root, workspace.run_dir(run)
    try:
        content = RunContent(workspace, run, (), Series(read_run_config(run_dir)["data"][0]["sequence"]))
        page = write_page(
            root / LIVING_PAGE, content.portable(confidence=False, soft_cut=True), _first_seconds(content.motion())
        )
        say(f"{root / LIVING_PAGE}: the living avatar, {page.size / 1e6:.1f} MB; open it in a browser, or send it")
    except UserError as error:
        say(f"no page: {error}")


def name_next_commands(workspace: Workspace, run: str) -> None:
    """Name what can be done with the avatar of a run."""
    root, which = workspace.root, ["--run", run] if len(workspace.run_names()) > 1 else []
    for command, does in (
        (["view", str(root), *which], "turn it, and move its face"),
        (["drive", str(root), *which, "--by", "camera"], "your own face drives it"),
        (["export", str(root), *which, "--webcam", "--out", "be_me.html"], "a page that the viewer's face drives"),
        (["export", str(root), *which, "--out", "me.glb"], "for Blender and engines"),
    ):
        say(f"Next: {shlex.join(['mien', *command])}   # {does}")


def _copy(film: Path, aside: Path) -> None:
    shutil.copyfile(film, aside)


def _first_seconds(motion: Motion | None) -> Motion | None:
    if motion is None:
        return None
    count = max(1, round(_SECONDS * motion.fps))
    names = ("expression", "joints", "head_rotation", "head_translation")
    return replace(motion, **{name: getattr(motion, name)[:count] for name in names})


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
