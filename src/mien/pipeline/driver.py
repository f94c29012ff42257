"""Drivers as people name them: what each is, checked before anything heavy is loaded."""

from dataclasses import fields
from pathlib import Path
from typing import Literal

from mien.capture.settings import CaptureSettings
from mien.disk.workspace import is_workspace, open_workspace
from mien.errors import UserError
from mien.media.output import SOUND_ENDINGS

Kind = Literal["recording", "film", "sequence", "workspace"]
"""A file of another program or a voice; a video, a picture or a folder of pictures; the folder of a tracked sequence;
or a workspace."""
NEUTRALS = ("first", "calm", "model")
"""Words that --neutral takes. Anything else is a file."""
_DRIVERS = (
    "a workspace, a video, a picture, a folder of pictures, a .csv of Live Link Face or of ARKit's names, a .json of "
    "blend shapes, or a sound file"
)


def check_driver(
    by: Path, sequence: str | None = None, fps: float | None = None, capture: CaptureSettings | None = None
) -> Kind:
    """Classify what `--by` or `--neutral` names, and check before any work that it exists and fits the options.

    `sequence` is one of a workspace, or a part of a film with cuts; `fps` is the rate of a csv's timecode; `capture`
    says how a film is captured.
    """
    suffix, usual = by.suffix.lower() if by.is_file() else "", CaptureSettings()
    if fps is not None and (suffix != ".csv" or not 0 < fps <= 1000):
        raise UserError(f"--fps {fps:g}: is for the times of a .csv; give a number above 0, at most 1000")
    if not by.exists():
        raise UserError(f"{by}: no such file or folder; give {_DRIVERS}")
    kind, settings = _kind_of(by), capture or usual
    if kind == "recording" and sequence is not None:
        raise UserError(f"--sequence {sequence}: {by} has no sequences; leave --sequence out")
    if kind != "film" and settings != usual:
        name = next(one.name for one in fields(usual) if getattr(settings, one.name) != getattr(usual, one.name))
        option = f"--capture.{'no-' * (getattr(settings, name) is False)}{name.replace('_', '-')}"
        raise UserError(f"{option}: is for a video or pictures, and --by is {by}; leave {option} out")
    settings.check()
    if kind == "workspace":
        open_workspace(by).pick_sequence(sequence)
    elif kind == "film" and by.is_file():
        from mien.media.video_file import open_video

        try:
            with open_video(by):
                pass
        except UserError as error:
            raise UserError(f"{error}; what drives an avatar is {_DRIVERS}") from None
        with open_video(by, settings.stream):
            pass
    return kind


def check_neutral(neutral: str | None) -> None:
    """Check before any work that a driver's face at rest is a word of `NEUTRALS`, or a driver."""
    if neutral is None or neutral in NEUTRALS:
        return
    if not Path(neutral).exists():
        raise UserError(
            f"--neutral {neutral}: no such file; give first, calm or model, or a video, recording, workspace or "
            "sequence folder of the driver at rest"
        )
    check_driver(Path(neutral))


def _kind_of(by: Path) -> Kind:
    if by.is_file():
        return "recording" if by.suffix.lower() in (".csv", ".json", *SOUND_ENDINGS) else "film"
    if (by / "tracking").is_dir():
        return "sequence"
    if is_workspace(by):
        return "workspace"
    from mien.media.source import list_images

    try:
        return "film" if list_images(by) else "workspace"
    except UserError:
        return "workspace"
