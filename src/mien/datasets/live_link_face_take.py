"""A take folder of the Live Link Face app: a video, and a csv of ARKit's coefficients that can drive avatars."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from mien.datasets.content import REMEDY, check_file_inside, is_file_inside, sniff
from mien.datasets.dataset import Clip, Dataset, Findings, Footage, ReadSequence
from mien.datasets.nersemble import frames_in
from mien.disk.reading import listed, read_bytes
from mien.errors import UserError
from mien.face.models.npz import readable

if TYPE_CHECKING:
    from mien.face.model import FaceModel

_DEPTH = "depth_data.bin"


def _video(path: Path) -> Path | None:
    found = [each for each in listed(path) if each.suffix.lower() in (".mov", ".mp4")]
    return found[0] if len(found) == 1 else None


def _table(path: Path) -> Path | None:
    """The csv of coefficients: the calibrated one, or the only one."""
    tables = [each for each in listed(path, "*.csv") if b"blendshapecount" in sniff(each)[:4096].lower()]
    calibrated = [each for each in tables if each.stem.lower().endswith("_cal")]
    others = [each for each in tables if not each.stem.lower().endswith(("_raw", "_neutral"))]
    return next(iter([*calibrated, *others, *tables]), None)


def _recognises(path: Path) -> str | None:
    if not path.is_dir() or _video(path) is None:
        return None
    table = _table(path)
    is_take = (path / "take.json").exists() or (path / "frame_log.csv").exists() or table is not None
    return f"a take of Live Link Face (a video{', coefficients' if table is not None else ''})" if is_take else None


def _survey(path: Path) -> Findings:
    missing = ["cameras and tracking: use `mien track`"]
    if _table(path) is None:
        missing.append("a csv of coefficients" + (
            f": takes with {_DEPTH} have none, and only their video is used" if (path / _DEPTH).exists() else ""
        ))  # fmt: skip
    video = _video(path)
    frames = frames_in([video] if video is not None and is_file_inside(path, video) else [])
    return Findings((Clip(path.resolve().name, frames),), None, None, tuple(missing))


def _read(path: Path, face_model: "FaceModel | None") -> Iterator[ReadSequence]:
    video, table = _video(path), _table(path)
    if video is None:
        raise UserError(f"{path}: has not exactly one video (.mov); copy the whole take")
    check_file_inside(path, video)
    files = {}
    if table is not None:
        check_file_inside(path, table)
        with readable(table, "csv", REMEDY):
            files["driving.csv"] = read_bytes(table, 256 << 20)
        from mien.driving.live_link_face import read_live_link_face

        read_live_link_face(table)  # a damaged one is refused before the video is processed
    yield Footage(path.resolve().name, (video,), files=files)


LIVE_LINK_FACE = Dataset(
    "live-link-face", "a take folder of the Live Link Face app: .mov and .csv", "sequences", _recognises, _read, _survey
)
