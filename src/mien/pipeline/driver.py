"""Checks of a driver as people name it, before anything is opened."""

from dataclasses import fields
from pathlib import Path

from mien.capture.settings import CaptureSettings
from mien.disk.workspace import is_workspace, open_workspace
from mien.errors import UserError
from mien.media.choices import SOUND_ENDINGS

NEUTRALS = ("first", "calm", "model")
"""Words that --neutral takes. Anything else is a file."""


_DRIVERS = (
    "a workspace, a video, a picture, a folder of pictures, a .csv of Live Link Face or of ARKit's names, a .json of "
    "blend shapes, or a sound file"
)


def is_tracked_sequence(folder: Path) -> bool:
    """Whether a folder is that of one tracked sequence of a workspace."""
    return (folder / "tracking").is_dir()


def check_neutral(neutral: str | None) -> None:
    """Check before any work that a driver's face at rest is a word of `NEUTRALS`, or a driver."""
    if neutral is None or neutral in NEUTRALS:
        return
    if not Path(neutral).exists():
        raise UserError(
            f"--neutral {neutral}: no such file; give first, calm or model, or a video, recording, workspace or "
            "sequence folder of the driver at rest"
        )
    if not is_tracked_sequence(Path(neutral)):
        check_driver(Path(neutral), None)


def check_driver(
    by: Path, sequence: str | None, fps: float | None = None, capture: CaptureSettings | None = None
) -> None:
    """Check before any work that the driver exists: a workspace with that sequence, or a file."""
    suffix = by.suffix.lower() if by.is_file() else ""
    if fps is not None and (suffix != ".csv" or not 0 < fps <= 1000):
        raise UserError(f"--fps {fps:g}: is for the times of a .csv; give a number above 0, at most 1000")
    if not by.exists():
        raise UserError(f"{by}: no such file or folder; give {_DRIVERS}")
    if suffix in (".csv", ".json", *SOUND_ENDINGS) and sequence is not None:
        raise UserError(f"--sequence {sequence}: {by} has no sequences; leave --sequence out")
    is_film = holds_pictures(by) or (by.is_file() and suffix not in (".csv", ".json", *SOUND_ENDINGS))
    settings, usual = capture or CaptureSettings(), CaptureSettings()
    for name in () if is_film else (one.name for one in fields(settings)):
        value = getattr(settings, name)
        if value != getattr(usual, name):
            option = f"--capture.{'no-' * (value is False)}{name.replace('_', '-')}"
            typed = option if value is False else f"{option} {value}"
            raise UserError(f"{typed}: is for a video or pictures, and --by is {by}; leave {option} out")
    settings.check()
    if not by.is_file() and not is_film:
        open_workspace(by).pick_sequence(sequence)
    elif by.is_file() and is_film:
        from mien.media.video_file import open_video

        try:
            with open_video(by):
                pass
        except UserError as error:
            raise UserError(f"{error}; what drives an avatar is {_DRIVERS}") from None
        with open_video(by, settings.stream):
            pass


def holds_pictures(folder: Path) -> bool:
    """Whether a folder is one of pictures, and no workspace."""
    if not folder.is_dir() or is_workspace(folder):
        return False
    from mien.media.source import list_images

    try:
        return bool(list_images(folder))
    except UserError:
        return False
