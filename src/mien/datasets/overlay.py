"""An import is compared with its pictures, because no file names its version of FLAME or its conventions.

The drawn head must lie on the person, and its landmarks where the detector sees them. Both come from the pictures
alone, so that a misread convention cannot hide in them. A face model of another version passes both, because it is a
head as well. It is found by the colours of the skin (`mien.datasets.steadiness`).
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from mien.capture.person.faces import LandmarkDetector
from mien.datasets.dataset import TrackedSequence
from mien.datasets.steadiness import measure_steadiness
from mien.errors import UserError
from mien.render.mesh import rasterize_mesh

_FRAMES, _CAMERAS = 5, 3
_SOLID = 128
_MIN_INSIDE = 0.7
"""Least share of the drawn head that lies on the person. Right imports have more than 0.9, even without hair. Other
identities have that as well: only misread cameras and poses have less."""
_MAX_DISTANCE = 0.15
"""Largest median distance of landmarks from those that the detector finds, over the distance of the outer corners of
the eyes. A fitted FLAME has about 0.03 to 0.05; drawings have 0.09, because the detector is less exact in them. Another
basis of identities or expressions changes that by 0.01 at most: only misread cameras and poses have more."""
_CORNERS = (33, 263)  # MediaPipe's points at the outer corners of the eyes
_MAX_SPREAD = 1.12
"""Largest spread of the skin's colours, over that without identity or without expressions. Chosen on 200
drawn right trackings, with hard light, noise, jpg and poses that are off by 3 pixels: they had at most 1.10. Of 70
others, none had more than 1.03."""
_OTHER_SIZE = 1.3  # least ratio of the sizes of pictures and of the camera that is told


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
    """Return the sequence, after a check that its tracking fits its pictures, and its face model its tracking."""
    overlay, name = measure_overlay(sequence), sequence.capture.name
    if overlay.inside < _MIN_INSIDE:
        raise UserError(
            f"{path}: only {overlay.inside:.0%} of the tracked head lies on the person in {name}, so tracking and "
            f"pictures do not fit{_sizes(sequence)}; copy the files again, or give another --face-model (it needs "
            f"{version})"
        )
    if overlay.distance is not None and overlay.distance > _MAX_DISTANCE:
        raise UserError(
            f"{path}: in {name}, landmarks of the tracking are {overlay.distance:.0%} of the distance of the eyes "
            f"beside those in the pictures{_sizes(sequence)}; its tracking needs {version}: give that with "
            "--face-model, or track the pictures again (--retrack)"
        )
    check_version(path, sequence, version)
    return sequence


def check_version(path: Path, sequence: TrackedSequence, version: str) -> None:
    """Check that coefficients of the tracking move the face model as the face in the pictures moves."""
    steadiness = measure_steadiness(sequence)
    for spread, what in ((steadiness.identity, "identity"), (steadiness.expression, "expressions")):
        if spread is not None and spread > _MAX_SPREAD:
            raise UserError(
                f"{path}: in {sequence.capture.name}, the skin's colours spread {spread - 1:.0%} more with the "
                f"tracking's {what} on {sequence.face_model.name!r} than without, so this is another version of the "
                f"model; it needs {version}: give that, or whichever of FLAME 2020, FLAME 2023 and FLAME 2023 Open "
                "the authors used, with --face-model, or track the pictures again (--retrack)"
            )


def _sizes(sequence: TrackedSequence) -> str:
    """Return in words that the pictures have another size than the tracking's, by the centre of its camera."""
    view = sequence.tracking.cameras[0]
    width, height = (2 * float(center) for center in view.K[:2, 2])
    ratios = sorted((view.width / max(width, 1e-6), view.height / max(height, 1e-6)))
    if not (ratios[0] > _OTHER_SIZE or ratios[1] < 1 / _OTHER_SIZE):
        return ""
    return (
        f": these have {view.width}x{view.height} pixels, and the tracking was made on about {width:.0f}x{height:.0f}, "
        "so give pictures of that size"
    )
