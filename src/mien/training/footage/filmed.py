"""Which sides of a head were filmed: the coverage of a run on disk, and what it says about views of the avatar."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mien.camera import Camera, camera_from_fov
from mien.disk.files import read_tensors, write_tensors
from mien.disk.reading import expect_whole
from mien.face.model import FaceModel
from mien.render.camera_paths import turned_camera
from mien.render.mesh import Headlight, rasterize_mesh, render_mesh
from mien.training.footage.coverage import Coverage

if TYPE_CHECKING:
    from mien.runtime.baked import Filmed

_FILMED_CONFIDENCE = 0.85  # mean confidence of the visible surface from which a view counts as filmed. Set by eye
_SHOWN_CONFIDENCE = 0.5  # the same from which the head of a filled avatar may turn there. Set by eye (log, 11-23)
_SHOWN_MOST_YAW = 60
"""Degrees to the side beyond which that does not hold, since fills have no folds. Set by eye (log, 11-23)."""
_SHOWN_MOST_PITCH = 30  # the same up and down

FILE = "coverage.safetensors"
"""Name of the file in a run's folder."""
_FIELDS = ("seen", "colors", "above")
_REMEDY = "train it again"
_STEP, _SIZE, _FIELD, _DISTANCE = 5, 128, 0.4, 1.0
"""Degrees between the views that are tried; their size in pixels, field of view in radians and distance in metres."""
_FILLED_IN = (0.93, 0.45, 0.30)
_SEEN = (0.25, 0.55, 0.80)


def write_coverage(run_dir: Path, coverage: Coverage) -> None:
    """Write the coverage of a run."""
    tensors = {name: getattr(coverage, name) for name in _FIELDS}
    write_tensors(run_dir / FILE, tensors, {"format": "mien.coverage", "version": "1"})


def read_coverage(run_dir: Path, face_model: FaceModel) -> Coverage | None:
    """The coverage of a run, or None for runs that were trained without it."""
    path = run_dir / FILE
    if not path.is_file():
        return None
    tensors = read_tensors(path, "`mien train`")
    with expect_whole(path, _REMEDY):
        if len(tensors["seen"]) != len(face_model.faces):
            raise ValueError("it has another number of triangles")
        return Coverage(**tensors)


def filmed_share(vertices: Float[Tensor, "v 3"], face_model: FaceModel, coverage: Coverage, camera: Camera) -> float:
    """Mean confidence, 0..1, of the surface above the cut at the neck that a camera sees; 0 if it sees none."""
    index = rasterize_mesh(vertices, face_model.faces, camera).face_index
    shown = index[index >= 0].long()
    above = coverage.above[shown]
    return float((coverage.seen[shown] * above).sum() / above.sum()) if bool(above.any()) else 0.0


def filmed_yaws(face_model: FaceModel, vertices: Float[Tensor, "v 3"], coverage: Coverage) -> tuple[int, int] | None:
    """How far views to the person's right and left show what was filmed, in whole degrees; None if none do."""

    def is_filmed(yaw: int) -> bool:
        return filmed_share(vertices, face_model, coverage, view_of_head(vertices, yaw)) >= _FILMED_CONFIDENCE

    if not is_filmed(0):
        return None
    return _reached(lambda turn: is_filmed(-turn), 180), _reached(is_filmed, 180)


def with_shown_angles(
    filmed: "Filmed", face_model: FaceModel, vertices: Float[Tensor, "v 3"], coverage: Coverage
) -> "Filmed":
    """`filmed` with head angles that also have the views of which at least half was filmed.

    It is for avatars whose other half is filled. What moves the head keeps softly to these angles (`keep_to_filmed`).
    """

    def is_shown(yaw: int, pitch: int) -> bool:
        camera = view_of_head(vertices, yaw, pitch=pitch)
        return filmed_share(vertices, face_model, coverage, camera) >= _SHOWN_CONFIDENCE

    if not is_shown(0, 0):
        return filmed
    right, left = (_reached(lambda turn, to=to: is_shown(to * turn, 0), _SHOWN_MOST_YAW) for to in (-1, 1))
    down, up = (_reached(lambda turn, to=to: is_shown(0, to * turn), _SHOWN_MOST_PITCH) for to in (-1, 1))
    shown, known = np.radians(np.array([[-right, left], [-down, up]], np.float32)), filmed.head_angles
    lowest, highest = np.minimum(known[:, 0], shown[:, 0]), np.maximum(known[:, 1], shown[:, 1])
    return replace(filmed, head_angles=np.stack([lowest, highest], axis=1))


def _reached(holds: Callable[[int], bool], most: int) -> int:
    """The largest angle in degrees, in steps and up to `most`, up to which all angles hold."""
    return next((turn - _STEP for turn in range(_STEP, most + 1, _STEP) if not holds(turn)), most)


def filmed_words(face_model: FaceModel, vertices: Float[Tensor, "v 3"], coverage: Coverage) -> str:
    """One line about which angles were filmed and which are made up."""
    reached = filmed_yaws(face_model, vertices, coverage)
    if reached is None:
        return "filmed: no side was seen well; much of what is shown is made up"
    right, left = reached
    if right == left == 180:
        return "filmed: all around the head"
    return f"filmed: from {right} degrees on the person's right to {left} on the left; what is beyond is made up"


def view_of_head(vertices: Float[Tensor, "v 3"], yaw: int, size: int = _SIZE, pitch: int = 0) -> Camera:
    """A camera that looks at a head in the head frame from `yaw` degrees to the person's left and `pitch` above."""
    center = (vertices.amin(0) + vertices.amax(0)) / 2
    viewmat = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    viewmat[:3, 3] = -viewmat[:3, :3] @ (center + torch.tensor([0.0, 0.0, _DISTANCE]))
    return turned_camera(camera_from_fov(_FIELD, size, size, viewmat), center, math.radians(yaw), math.radians(pitch))


@torch.no_grad()
def confidence_picture(
    face_model: FaceModel, vertices: Float[Tensor, "v 3"], coverage: Coverage, yaw: int, size: int
) -> Float[Tensor, "h w 3"]:
    """The head in the colours of its confidence: blue for filmed, orange for made up, lit, over white."""
    mixed = torch.lerp(torch.tensor(_FILLED_IN), torch.tensor(_SEEN), coverage.seen[:, None])
    mixed = torch.lerp(torch.tensor([0.8, 0.8, 0.8]), mixed, coverage.above[:, None])
    corners = mixed[:, None].expand(-1, 3, -1).contiguous()
    camera = view_of_head(vertices, yaw, size)
    return render_mesh(vertices, face_model.faces, camera, corners, light=Headlight(), supersample=2)[0].clamp(0, 1)
