"""The scoring mask on disk: scoring.json, crops.safetensors, masks/CAMERA/000000.png. It is written once."""

import hashlib
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mien.disk.files import read_arrays, read_json, replace_folder, write_arrays, write_json
from mien.disk.limits import checked_side
from mien.disk.locks import read_beside_writers
from mien.disk.reading import check_tree, expect_whole, open_new, remove_tree
from mien.errors import UserError
from mien.media.picture_files import PictureStack, decode_png, encode_picture
from mien.tracking.scoring import Scoring
from mien.tracking.settings import Cut

_FORMAT, _VERSION = "mien.scoring", 1
_STAGE = "`mien track`"
_REMEDY = "delete the folder and run `mien track` again (scores from before and after cannot be compared)"


def scoring_exists(path: Path, capture_hash: str | None = None) -> bool:
    """Whether the folder `path` already holds a scoring. With a hash, only a scoring of that capture counts."""
    file = path / "scoring.json"
    if capture_hash is None or not file.is_file():
        return file.is_file()
    return read_json(file, _FORMAT, _VERSION, _STAGE).get("capture_hash") == capture_hash


def write_scoring(path: Path, scoring: Scoring, capture_hash: str) -> None:
    """Write a scoring as the folder `path`, all or nothing. An existing scoring of the same capture is kept."""
    if scoring_exists(path, capture_hash):
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.parent / f".{path.name}.{secrets.token_hex(4)}"
    temporary.mkdir()
    try:
        _write_into(temporary, scoring, capture_hash)
        replace_folder(path, temporary)
    except BaseException:
        remove_tree(temporary)
        raise


def check_scoring_cut(path: Path, asked: Cut, capture_hash: str) -> None:
    """Check that the masks in the folder `path`, if there are any of this capture, have the cut that is asked for."""
    if not scoring_exists(path, capture_hash):
        return
    cut = _cut_of(path, read_json(path / "scoring.json", _FORMAT, _VERSION, _STAGE))
    if cut != asked:
        raise UserError(
            f"--scoring.cut {asked}: the masks in {path} were made with the cut {cut}, and masks are written "
            f"once, so that runs compare; give --scoring.cut {cut}, or delete that folder (scores from before and "
            "after cannot be compared)"
        )


def read_scoring(path: Path, capture_hash: str | None = None) -> Scoring:
    """Read a scoring that `write_scoring` wrote, of any capture or of the one with this hash."""
    return read_beside_writers(lambda: _read_scoring(path, capture_hash), [path], [path.parent])


def _read_scoring(path: Path, capture_hash: str | None) -> Scoring:
    check_tree(path)
    content = read_json(path / "scoring.json", _FORMAT, _VERSION, _STAGE)
    if capture_hash is not None and content.get("capture_hash") != capture_hash:
        raise UserError(
            f"{path}: its masks belong to other pictures than the capture beside it; run `mien track` again "
            "to make new ones"
        )
    with expect_whole(path / "scoring.json", _REMEDY):
        sides = checked_side(content["height"]), checked_side(content["width"])
        counts = content["timesteps"], content["cameras"]
    file = path / "crops.safetensors"
    crops = read_arrays(file, _STAGE).get("crops")
    # The size of the crops bounds the number of masks that are read. The json may claim any number.
    if crops is None or crops.shape != (*counts, 4) or crops.dtype != np.int32 or crops.size == 0:
        raise UserError(f"{file}: does not hold 4 whole numbers for each frame; {_REMEDY}")
    shape = (*crops.shape[:2], *sides)
    left, top, width, height = np.moveaxis(crops.astype(np.int64), -1, 0)
    if min(left.min(), top.min(), width.min(), height.min()) < 0 or not (
        (left + width).max() <= shape[3] and (top + height).max() <= shape[2]
    ):
        raise UserError(f"{file}: a crop extends beyond the picture; {_REMEDY}")
    # Check this before memory for all masks is reserved: a damaged size may ask for more than there is.
    missing = [t_c for t_c in np.ndindex(*shape[:2]) if not _mask_file(path, *t_c).is_file()]
    if missing:
        raise UserError(f"{_mask_file(path, *missing[0])}: missing; {_REMEDY}")
    decode_png(_mask_file(path, 0, 0), shape[2:], _REMEDY)
    masks, digest = PictureStack(shape, path), hashlib.sha256()
    for timestep, camera in np.ndindex(*shape[:2]):
        mask = decode_png(_mask_file(path, timestep, camera), shape[2:], _REMEDY)
        if mask.any() and not crops[timestep, camera, 2:].all():
            raise UserError(f"{file}: a crop is empty although its mask is not; {_REMEDY}")
        masks.write(timestep, camera, mask)
        digest.update(mask.tobytes())
    digest.update(crops.astype(np.int32).tobytes())
    if digest.hexdigest() != content.get("sha256"):
        raise UserError(f"{path}: masks or crops have changed since they were written; {_REMEDY}")
    return Scoring(masks.array(), crops.astype(np.int64), _cut_of(path, content))


def read_scoring_hash(path: Path) -> str:
    """The hash of masks and crops of a scoring on disk, without reading them."""
    return str(read_json(path / "scoring.json", _FORMAT, _VERSION, _STAGE).get("sha256"))


def _write_into(folder: Path, scoring: Scoring, capture_hash: str) -> None:
    timesteps, cameras, height, width = scoring.masks.shape
    digest = hashlib.sha256()
    for timestep, camera in np.ndindex(timesteps, cameras):
        file = _mask_file(folder, timestep, camera)
        file.parent.mkdir(parents=True, exist_ok=True)
        mask = np.array(scoring.masks[timestep, camera])
        digest.update(mask.tobytes())
        with open_new(file) as opened:
            opened.write(encode_picture(mask))
    crops = scoring.crops.astype(np.int32)
    write_arrays(folder / "crops.safetensors", {"crops": crops})
    digest.update(crops.tobytes())
    about = {"timesteps": timesteps, "cameras": cameras, "height": height, "width": width, "capture_hash": capture_hash}
    about |= {"cut": scoring.cut, "sha256": digest.hexdigest()}
    write_json(folder / "scoring.json", _FORMAT, _VERSION, about)


def _cut_of(path: Path, content: Mapping[str, Any]) -> Cut:
    cut = content.get("cut")
    if cut not in ("plane", "line", "none"):
        raise UserError(f"{path / 'scoring.json'}: cut {cut!r:.60} is not plane, line or none; {_REMEDY}")
    return cut


def _mask_file(folder: Path, timestep: int, camera: int) -> Path:
    return folder / "masks" / f"{camera:02d}" / f"{timestep:06d}.png"
