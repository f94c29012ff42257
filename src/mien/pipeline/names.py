"""Checks of what people name, before any work: videos, sequences, runs, avatars, drivers, and what a viewer needs."""

import importlib.util
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import fields
from itertools import combinations
from pathlib import Path
from typing import Literal

from mien.capture.settings import CaptureSettings
from mien.disk.config import Range
from mien.disk.files import file_digest
from mien.disk.reading import is_plain_name
from mien.disk.workspace import check_no_workspace, is_workspace, open_workspace
from mien.errors import UserError
from mien.machine.terminal import plain_name
from mien.media.output import SOUND_ENDINGS

PORT = Range(0, 65_535)
"""Allowed ports of a viewer."""
Kind = Literal["recording", "film", "sequence", "workspace"]
"""A file of another program or a voice; a video, a picture or a folder of pictures; the folder of a tracked sequence;
or a workspace."""
NEUTRALS = ("first", "calm", "model")
"""Words that --neutral takes. Anything else is a file."""
_DRIVERS = (
    "a workspace, a video, a picture, a folder of pictures, a .csv of Live Link Face or of ARKit's names, a .json of "
    "blend shapes, or a sound file"
)


def run_name(name: str) -> str:
    """The name of a run or a sequence, if a folder can have it."""
    if not is_plain_name(name):
        raise UserError(f"{name!r} cannot be the name of a folder; give another with --name or --run")
    return name


def check_new_run(run_dir: Path) -> None:
    """Check that there is no run of this name yet."""
    if run_dir.exists():
        raise UserError(f"{run_dir}: is there already; give the imported run another name (--run NAME)")


def check_new_sequence(folder: Path) -> None:
    """Check that there is no sequence of this name yet."""
    if folder.exists():
        raise UserError(f"{folder}: is there already; delete it to import it again, or import into another workspace")


def sequence_names(videos: Sequence[Path], names: Sequence[str]) -> list[str]:
    """A name for each video: the given names, or else the names of the videos (with "_" for control characters)."""
    if names and len(names) != len(videos):
        counts = f"{len(names)} names, but the number of videos is {len(videos)}"
        raise UserError(f"--name {' '.join(names)}: {counts}; give one name for each")
    found = [run_name(name) for name in names or [plain_name(video.stem) for video in videos]]
    twice = [name for name, count in Counter(found).items() if count > 1]
    if twice:
        raise UserError(f"two videos would both be the sequence {twice[0]!r}; give each a name with --name")
    return found


def rig_name(sources: Sequence[Path], calibration: Path, names: Sequence[str]) -> str:
    """The name of the sequence that several calibrated cameras filmed: the given name, or that of their folder."""
    if not calibration.is_file():
        what = "is a folder" if calibration.is_dir() else "no such file"
        raise UserError(f"--calibration {calibration}: {what}; give the json file of its cameras (docs/using.md)")
    if len(names) > 1:
        raise UserError(f"--name {' '.join(names)}: all cameras together become one sequence; give one name")
    if not names and len(sources) > 1:
        raise UserError("--calibration: several videos become one sequence; name it with --name")
    return run_name(names[0] if names else plain_name(sources[0].resolve().stem))


def check_sources(videos: Sequence[Path], names: Sequence[str], calibration: Path | None) -> None:
    """Check videos and names before anything heavy is loaded. Folders of pictures are left to the capture."""
    if not videos:
        raise UserError("no video given; name a video, or with --calibration those of all cameras or their folder")
    for video in videos:
        if not video.exists():
            raise UserError(f"{video}: no such video or folder of pictures; check the path")
    if calibration is None:
        sequence_names(videos, names)
    else:
        rig_name(videos, calibration, names)
    for video in videos:
        check_no_workspace(video)
        if video.is_file() and is_picture(video):
            raise UserError(f"{video}: is a picture; give a video, or the folder of a video's pictures")


def is_picture(file: Path) -> bool:
    """Whether a file is a single picture."""
    from mien.media.video_file import open_video

    with open_video(file) as (container, _):
        return container.format.name.endswith("_pipe")  # FFmpeg's names of pictures: png_pipe, jpeg_pipe.


def doubled_videos(videos: Sequence[Path], names: Sequence[str], held_out: Sequence[str]) -> Iterator[str]:
    """Yield warnings about videos with the same content: they add nothing, or training uses held-out frames."""

    def is_held_out(name: str) -> bool:
        # A part of a video with cuts is called NAME-1.
        return any(part == name or part.rpartition("-")[0] == name for part in held_out)

    for (first, name), (second, other) in combinations(zip(videos, names, strict=True), 2):
        if not _same_content(first, second):
            continue
        outside = [n for n in (name, other) if is_held_out(n)]
        if len(outside) == 1:
            trained = other if outside == [name] else name
            yield f"{name} and {other} are the same video: {outside[0]} is held out, but {trained} trains on its frames"
        else:
            yield f"{name} and {other} are the same video, which then counts twice and adds nothing"


def _same_content(first: Path, second: Path) -> bool:
    files = first.is_file() and second.is_file() and first.stat().st_size == second.stat().st_size
    return first.samefile(second) or (files and file_digest(first) == file_digest(second))


def no_model_file(path: Path) -> str:
    """Return the message on a path that is neither a file nor ICT-FaceKit's folder."""
    files = "FLAME's own .pkl (generic_model.pkl, flame2023.pkl) or a .npz"
    if path.is_dir():
        return f"{path}: is a folder, and not ICT-FaceKit's FaceXModel; give a file in it: gnm_head.npz, {files}"
    return f"{path}: no such file; give {files}"


def check_avatar(avatar: Path, run: str | None) -> None:
    """Check that there is an avatar: a .mien file, or a run of a workspace."""
    if avatar.is_file():
        if run is not None:
            raise UserError(f"--run {run}: a file holds one avatar; leave --run out")
        if avatar.suffix.lower() != ".mien":
            raise UserError(f"{avatar}: is no .mien file; give one, or a workspace's folder")
    elif avatar.suffix.lower() == ".mien" and not avatar.exists():
        raise UserError(f"{avatar}: no such file; write one with `mien export DIR --out me.mien`")
    else:
        open_workspace(avatar).pick_run(run)


def has_viewer() -> bool:
    """Whether the package of the viewer's page is installed."""
    return importlib.util.find_spec("viser") is not None


def check_viewer() -> None:
    """Check that the package of the viewer's page is installed."""
    if not has_viewer():
        raise UserError("the viewer needs the package viser, which is missing; run `pip install 'mien[viewer]'`")


def check_studio() -> None:
    """Check that the packages of the studio's server are installed."""
    if not all(map(importlib.util.find_spec, ("starlette", "uvicorn", "segno"))):
        raise UserError("the studio's server needs packages that are missing; run `pip install 'mien[studio,create]'`")


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
    kind, settings = kind_of(by), capture or usual
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


def kind_of(by: Path) -> Kind:
    """What something is that drives an avatar."""
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
