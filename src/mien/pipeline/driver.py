"""Drivers as people name them: what each is, checked before anything heavy is loaded."""

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Literal

from mien.capture.settings import CaptureSettings
from mien.disk.workspace import is_workspace, open_workspace
from mien.errors import UserError
from mien.media.output import SOUND_ENDINGS

NEUTRALS = ("first", "calm", "model")
"""Words that --neutral takes. Anything else is a file."""
_DRIVERS = (
    "a workspace, a video, a picture, a folder of pictures, a .csv of Live Link Face or of ARKit's names, a .json of "
    "blend shapes, or a sound file"
)


@dataclass(frozen=True)
class NamedDriver:
    """What `--by` or `--neutral` names."""

    path: Path
    kind: Literal["recording", "film", "sequence", "workspace"]
    """A file of another program or a voice; a video, a picture or a folder of pictures; the folder of a tracked
    sequence; or a workspace."""
    sequence: str | None = None
    """Name of a sequence of the workspace, or of a part of a film with cuts."""
    fps: float | None = None
    """Frame rate of the timecode in a csv."""
    capture: CaptureSettings = field(default_factory=CaptureSettings)
    """How a film is captured."""


def name_driver(
    by: Path, sequence: str | None = None, fps: float | None = None, capture: CaptureSettings | None = None
) -> NamedDriver:
    """Classify a driver, and check before any work that it exists and that the options are for its kind."""
    suffix = by.suffix.lower() if by.is_file() else ""
    if fps is not None and (suffix != ".csv" or not 0 < fps <= 1000):
        raise UserError(f"--fps {fps:g}: is for the times of a .csv; give a number above 0, at most 1000")
    if not by.exists():
        raise UserError(f"{by}: no such file or folder; give {_DRIVERS}")
    named = NamedDriver(by, _kind_of(by), sequence, fps, capture or CaptureSettings())
    if named.kind == "recording" and sequence is not None:
        raise UserError(f"--sequence {sequence}: {by} has no sequences; leave --sequence out")
    if named.kind != "film":
        _check_no_capture(named)
    named.capture.check()
    if named.kind == "workspace":
        open_workspace(by).pick_sequence(sequence)
    elif named.kind == "film" and by.is_file():
        from mien.media.video_file import open_video

        try:
            with open_video(by):
                pass
        except UserError as error:
            raise UserError(f"{error}; what drives an avatar is {_DRIVERS}") from None
        with open_video(by, named.capture.stream):
            pass
    return named


def name_neutral(neutral: str | None) -> NamedDriver | str | None:
    """Check before any work that a driver's face at rest is a word of `NEUTRALS`, or a driver, which is classified."""
    if neutral is None or neutral in NEUTRALS:
        return neutral
    if not Path(neutral).exists():
        raise UserError(
            f"--neutral {neutral}: no such file; give first, calm or model, or a video, recording, workspace or "
            "sequence folder of the driver at rest"
        )
    return name_driver(Path(neutral))


def _kind_of(by: Path) -> Literal["recording", "film", "sequence", "workspace"]:
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


def _check_no_capture(named: NamedDriver) -> None:
    usual = CaptureSettings()
    for name in (one.name for one in fields(usual)):
        value = getattr(named.capture, name)
        if value != getattr(usual, name):
            option = f"--capture.{'no-' * (value is False)}{name.replace('_', '-')}"
            typed = option if value is False else f"{option} {value}"
            raise UserError(f"{typed}: is for a video or pictures, and --by is {named.path}; leave {option} out")
