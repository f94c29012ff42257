"""An import is compared with its pictures, because no file names its version of FLAME or its conventions.

The drawn head must lie on the person, and its landmarks where the detector sees them. Both come from the pictures
alone, so that a misread convention cannot hide in them.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from mien.capture.faces import LandmarkDetector
from mien.datasets.dataset import TrackedSequence
from mien.errors import UserError
from mien.render import rasterize_mesh

_FRAMES, _CAMERAS = 5, 3
_SOLID = 128
_MIN_INSIDE = 0.7
"""Least share of the drawn head that lies on the person. Right imports have more than 0.9, even without hair."""
_MAX_DISTANCE = 0.15
"""Largest median distance of landmarks from those that the detector finds, over the distance of the outer corners of
the eyes. A fitted FLAME has about 0.03 to 0.05."""
_CORNERS = (33, 263)
"""MediaPipe's points at the outer corners of the eyes."""


@dataclass(frozen=True)
class Overlay:
    """How a tracking fits its pictures."""

    inside: float
    """Share of the drawn head's pixels that lie on the person, 0..1."""
    agreement: float
    """Intersection of the drawn head and the person, over their union, 0..1."""
    distance: float | None
    """Median distance of landmarks from the detector's, relative to the distance of the eyes' outer corners. None if
    the detector finds no face."""


@torch.no_grad()
def measure_overlay(sequence: TrackedSequence) -> Overlay:
    """Compare a tracking with some of its pictures."""
    capture, model = sequence.capture, sequence.face_model
    timesteps = np.unique(np.linspace(0, capture.timesteps - 1, _FRAMES).round().astype(int)).tolist()
    cameras = np.unique(np.linspace(0, len(capture.camera_ids) - 1, _CAMERAS).round().astype(int)).tolist()
    vertices = model(sequence.tracking.face[timesteps])
    faces = model.faces[~model.region_mask(*({"neck"} & set(model.region_names)))]
    drawn, inside, either, distances = 0, 0, 0, []
    with LandmarkDetector(several_faces=False) as detector:
        for index, timestep in enumerate(timesteps):
            for camera in cameras:
                view = sequence.tracking.cameras[camera]
                covered = (rasterize_mesh(vertices[index], faces, view).face_index >= 0).numpy()
                drawn += int(covered.sum())
                solid = capture.mattes[timestep, camera] >= _SOLID
                inside += int((covered & solid).sum())
                either += int((covered | solid).sum())
                found = detector.detect(np.ascontiguousarray(capture.images[timestep, camera]))
                own = capture.landmarks[timestep, camera]
                eyes = np.linalg.norm(own[_CORNERS[0]] - own[_CORNERS[1]])
                if len(found) and eyes > 1:
                    distances.append(float(np.median(np.linalg.norm(found[0] - own, axis=-1)) / eyes))
    return Overlay(inside / max(drawn, 1), inside / max(either, 1), float(np.median(distances)) if distances else None)


def check_overlay(path: Path, sequence: TrackedSequence, version: str) -> TrackedSequence:
    """Return the sequence, after a check that its tracking fits its pictures.

    Raises:
        UserError: it does not, as with another version of FLAME.
    """
    overlay = measure_overlay(sequence)
    if overlay.inside < _MIN_INSIDE:
        raise UserError(
            f"{path}: only {overlay.inside:.0%} of the tracked head lies on the person in {sequence.capture.name}, so "
            f"tracking and pictures do not fit; copy the files again, or give another --face-model (it needs {version})"
        )
    if overlay.distance is not None and overlay.distance > _MAX_DISTANCE:
        raise UserError(
            f"{path}: in {sequence.capture.name}, landmarks of the tracking are {overlay.distance:.0%} of the distance "
            f"of the eyes beside those in the pictures; its tracking needs {version}: give that with --face-model, or "
            "track the pictures again (--retrack)"
        )
    return sequence
