"""The scoring mask: the part of each picture that shows the head, fixed once per sequence so that runs compare."""

import hashlib
import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from mien.camera import Camera
from mien.capture.capture import Capture
from mien.errors import UserError
from mien.face import FaceModel
from mien.inside import check_tree, open_new, remove_tree
from mien.limits import side
from mien.locks import read_beside_writers
from mien.picture_files import PictureStack, decode_png
from mien.progress import track_progress
from mien.render.mesh import rasterize_mesh
from mien.storage import expect_whole, read_arrays, read_json, replace_folder, write_arrays, write_json
from mien.tracking.neck_line import neck_vertices
from mien.tracking.tracking import Tracking

_SILHOUETTE_MARGIN = 0.015
"""Margin around the projected head, in its own widths, because tracking is not exact to the pixel."""
_NECK_MARGIN = 1.15
"""Half of the width that is kept at the neck line, in half widths of the neck."""
_SLOPE = 1.0
"""Growth of that half width with every pixel above the neck line. Hair is kept; collars and shoulders are cut off."""
_FAINT = 32
"""Least opacity (of 255) of a pixel that counts for connection and for the crop."""
_FORMAT, _VERSION = "mien.scoring", 1
_STAGE = "`mien track`"
_REMEDY = "delete the folder and run `mien track` again (scores before and after will not compare)"


@dataclass(frozen=True, eq=False)
class Scoring:
    """The parts of the pictures of t timesteps and c cameras that are trained on and scored."""

    masks: UInt8[np.ndarray, "t c h w"]
    """Opacity of the head (255 is head): the matte, cut below the neck line. It is a memory map if there are many."""
    crops: Int[np.ndarray, "t c 4"]
    """Left, top, width and height of the head crop in pixels: the box of the mask."""


def make_scoring(capture: Capture, tracking: Tracking, face_model: FaceModel, scratch: Path | None = None) -> Scoring:
    """Make masks and head crops of every frame. Masks too large for the memory are in an unnamed file in `scratch`.

    A pixel keeps its matte if it is above the neck line and not far beside the neck, or inside the projected head,
    because a lowered chin is below the line. Parts that are then not connected to the head are removed.
    """
    masks = PictureStack(capture.mattes.shape, scratch)
    crops = np.zeros((*capture.mattes.shape[:2], 4), np.int64)
    head_faces = face_model.faces[~face_model.region_mask("neck")]
    ring = neck_vertices(face_model)
    for timestep in track_progress(range(capture.timesteps), "Scoring masks", capture.timesteps):
        vertices = face_model(tracking.face[timestep])[0]
        for index, camera in enumerate(tracking.cameras):
            head = rasterize_mesh(vertices, head_faces, camera).face_index.numpy() >= 0
            neck = camera.project(vertices[ring])[0].numpy()
            keep = above_neck_line(tracking.neck_lines[timestep, index].numpy(), neck, camera)
            mask = cut_matte(np.asarray(capture.mattes[timestep, index]), head, keep)
            masks.write(timestep, index, mask)
            crops[timestep, index] = head_crop(mask)
    return Scoring(masks.array(), crops)


def above_neck_line(
    line: Float[np.ndarray, " 3"], neck: Float[np.ndarray, "n 2"], camera: Camera
) -> Float[np.ndarray, "h w"]:
    """1 above the neck line and near the neck, 0 elsewhere, with soft borders one pixel wide.

    Args:
        line: The neck line (`Tracking.neck_lines`).
        neck: Projected vertices of the middle of the neck in pixels, which give its place and width.
        camera: The camera that took the picture.
    """
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    a, b, d = (float(value) for value in line)
    above = a * x + b * y + d
    along = b * x - a * y
    neck_along = neck @ np.array([b, -a])
    middle, half_width = (neck_along.max() + neck_along.min()) / 2, np.ptp(neck_along) / 2
    beside = half_width * _NECK_MARGIN + _SLOPE * above - np.abs(along - middle)
    return (np.clip(above + 0.5, 0, 1) * np.clip(beside + 0.5, 0, 1)).astype(np.float32)


def cut_matte(
    matte: UInt8[np.ndarray, "h w"], head: Bool[np.ndarray, "h w"], keep: Float[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w"]:
    """The matte times `keep`, but whole inside the head. Parts that do not touch the head are removed.

    Args:
        matte: The matte; 255 is person.
        head: The projected head without its neck.
        keep: The share of the matte that is kept outside of the head, 0..1.
    """
    columns = np.flatnonzero(head.any(0))
    margin = round(_SILHOUETTE_MARGIN * (columns[-1] - columns[0] + 1)) if len(columns) else 0
    if margin:
        head = cv2.dilate(head.astype(np.uint8), _disc(margin)).astype(bool)
    mask = np.round(matte * np.where(head, np.float32(1), keep)).astype(np.uint8)
    _, labels = cv2.connectedComponents((mask >= _FAINT).astype(np.uint8))
    ours = np.unique(labels[head & (labels > 0)])
    faint_or_ours = (labels == 0) | np.isin(labels, ours)
    return np.where(faint_or_ours, mask, 0).astype(np.uint8)


def head_crop(mask: UInt8[np.ndarray, "h w"]) -> Int[np.ndarray, " 4"]:
    """Left, top, width and height of the box of the mask; the whole picture if the mask is empty."""
    rows, columns = np.flatnonzero((mask >= _FAINT).any(1)), np.flatnonzero((mask >= _FAINT).any(0))
    if len(rows) == 0:
        return np.array([0, 0, mask.shape[1], mask.shape[0]])
    return np.array([columns[0], rows[0], columns[-1] - columns[0] + 1, rows[-1] - rows[0] + 1])


def _disc(radius: int) -> UInt8[np.ndarray, "k k"]:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)).astype(np.uint8)


def scoring_exists(path: Path, capture_hash: str | None = None) -> bool:
    """Whether the folder `path` already holds a scoring. With a hash, only a scoring of that capture counts."""
    file = path / "scoring.json"
    if capture_hash is None or not file.is_file():
        return file.is_file()
    # Scorings of the first release have no hash. They were removed whenever their capture changed.
    return read_json(file, _FORMAT, _VERSION, _STAGE).get("capture_hash", capture_hash) == capture_hash


def write_scoring(path: Path, scoring: Scoring, capture_hash: str | None = None) -> None:
    """Write a scoring as the folder `path`, all or nothing. An existing scoring of the same capture is kept.

    Args:
        path: The folder.
        scoring: The scoring.
        capture_hash: Hash of the capture that it belongs to.

    Raises:
        UserError: There is a scoring that cannot be read.
    """
    if scoring_exists(path, capture_hash):
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
    try:
        _write_into(temporary, scoring, capture_hash)
        temporary.chmod(0o755)
        replace_folder(path, temporary)
    except BaseException:
        remove_tree(temporary)
        raise


def read_scoring(path: Path, capture_hash: str | None = None) -> Scoring:
    """Read a scoring that `write_scoring` wrote.

    Args:
        path: The folder.
        capture_hash: Hash of the capture that it must belong to; None for any.

    Raises:
        UserError: A file is missing, damaged, changed, of another capture, being written, or a link.
    """
    return read_beside_writers(lambda: _read_scoring(path, capture_hash), [path], [path.parent])


def _read_scoring(path: Path, capture_hash: str | None) -> Scoring:
    check_tree(path)
    content = read_json(path / "scoring.json", _FORMAT, _VERSION, _STAGE)
    if capture_hash is not None and content.get("capture_hash", capture_hash) != capture_hash:
        raise UserError(
            f"{path}: its masks are of other pictures than the capture beside it has; run `mien track` again, "
            "which makes them anew"
        )
    with expect_whole(path / "scoring.json", _REMEDY):
        sides = side(content["height"]), side(content["width"])
        counts = content["timesteps"], content["cameras"]
    crops = read_arrays(path / "crops.safetensors", _STAGE).get("crops")
    # The size of the crops bounds the number of masks that are read. The json may claim any number.
    if crops is None or crops.shape != (*counts, 4) or crops.dtype != np.int32 or crops.size == 0:
        raise UserError(f"{path / 'crops.safetensors'}: has not 4 whole numbers for each frame; {_REMEDY}")
    shape = (*crops.shape[:2], *sides)
    left, top, width, height = np.moveaxis(crops.astype(np.int64), -1, 0)
    if min(left.min(), top.min(), width.min(), height.min()) < 0 or not (
        (left + width).max() <= shape[3] and (top + height).max() <= shape[2]
    ):
        raise UserError(f"{path / 'crops.safetensors'}: a crop reaches out of the picture; {_REMEDY}")
    # Check this before memory for all masks is reserved: a damaged size may ask for more than there is.
    missing = [t_c for t_c in np.ndindex(*shape[:2]) if not _mask_file(path, *t_c).is_file()]
    if missing:
        raise UserError(f"{_mask_file(path, *missing[0])}: missing; {_REMEDY}")
    decode_png(_mask_file(path, 0, 0), shape[2:], _REMEDY)
    masks, digest = PictureStack(shape, path), hashlib.sha256()
    for timestep, camera in np.ndindex(*shape[:2]):
        mask = decode_png(_mask_file(path, timestep, camera), shape[2:], _REMEDY)
        if mask.any() and not crops[timestep, camera, 2:].all():
            raise UserError(f"{path / 'crops.safetensors'}: a crop holds nothing of its mask; {_REMEDY}")
        masks.write(timestep, camera, mask)
        digest.update(mask.tobytes())
    digest.update(crops.astype(np.int32).tobytes())
    if digest.hexdigest() != content.get("sha256"):
        raise UserError(f"{path}: masks or crops are not those that were written; {_REMEDY}")
    return Scoring(masks.array(), crops.astype(np.int64))


def read_scoring_hash(path: Path) -> str:
    """The hash of masks and crops of a scoring on disk, without reading them.

    Raises:
        UserError: There is no scoring, or it has another version.
    """
    return str(read_json(path / "scoring.json", _FORMAT, _VERSION, _STAGE).get("sha256"))


def _write_into(folder: Path, scoring: Scoring, capture_hash: str | None) -> None:
    timesteps, cameras, height, width = scoring.masks.shape
    digest = hashlib.sha256()
    for timestep, camera in np.ndindex(timesteps, cameras):
        file = _mask_file(folder, timestep, camera)
        file.parent.mkdir(parents=True, exist_ok=True)
        mask = np.array(scoring.masks[timestep, camera])
        digest.update(mask.tobytes())
        encoded, data = cv2.imencode(".png", mask)
        assert encoded
        with open_new(file) as opened:
            opened.write(data.tobytes())
    crops = scoring.crops.astype(np.int32)
    write_arrays(folder / "crops.safetensors", {"crops": crops})
    size = {"timesteps": timesteps, "cameras": cameras, "height": height, "width": width}
    origin = {} if capture_hash is None else {"capture_hash": capture_hash}
    digest.update(crops.tobytes())
    write_json(folder / "scoring.json", _FORMAT, _VERSION, {**size, **origin, "sha256": digest.hexdigest()})


def _mask_file(folder: Path, timestep: int, camera: int) -> Path:
    return folder / "masks" / f"{camera:02d}" / f"{timestep:06d}.png"
