"""Measure where a detector finds a face model's points: `python benchmarks/detector_calibration.py anny`.

It draws people through many kinds of lenses, runs the detector on them, and fits a `DetectorResponse`. The result ships
with mien (src/mien/tracking/data). Run this only after a change of a face model, its landmarks or the painter: 200
people take half an hour.

`--detector litert --people 20` measures how the other detector differs on the same pictures, and adds that to the
response of mediapipe. Fewer people suffice for it, because both see the same faces.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import tyro
from jaxtyping import Float
from torch import Tensor

from mien.capture.person.backend import Detector
from mien.capture.person.faces import LandmarkDetector
from mien.errors import UserError
from mien.face.loading import load_face_model
from mien.face.model import FaceModel
from mien.lab.synthetic.recipe import Segment, SyntheticRecipe
from mien.lab.synthetic.scene import SyntheticScene
from mien.machine.progress import say, track_progress
from mien.rotation import matrix_from_axis_angle
from mien.tracking.landmarks.detector_response import DetectorResponse, read_response, response_path, write_response

_MAX_OFFSET = 0.008
"""Median offset in metres above which the detector has found something else."""
_NOISE = 1e-3
"""Noise of a landmark that a tracker expects, in metres."""
_COMPONENTS, _FOLDS = 40, 5


@dataclass(frozen=True, eq=False)
class Sightings:
    """Detections in n pictures of one person, and the truth beside them."""

    R_seen: Float[Tensor, "n 2 3"]
    """Rotation from the head frame onto the picture's axes."""
    across: Float[Tensor, "n l 2"]
    """Offsets from the model's points to the detector's, in metres at the points' depth."""
    habits: Float[Tensor, "n h"]
    """Regressors that offsets may depend on: two turns, then the expression."""


def sight_person(seed: int, face_model: FaceModel, detectors: Sequence[Detector]) -> list[Sightings]:
    """Draw one person who turns the head and makes faces, and run each detector."""
    scene = SyntheticScene(_recipe(seed, face_model), seed)
    images = [scene.frame(timestep).image for timestep in range(scene.recipe.timesteps)]
    return [_sight(scene, images, face_model, detector) for detector in detectors]


def _sight(scene: SyntheticScene, images: Sequence[np.ndarray], face_model: FaceModel, detector: Detector) -> Sightings:
    found = []
    with LandmarkDetector(several_faces=False, detector=detector) as finder:
        for timestep, image in enumerate(images):
            faces = [finder.detect(image) for _ in range(2)][-1]  # It follows a face from picture to picture.
            if len(faces):
                found.append((timestep, torch.from_numpy(np.asarray(faces[0])).float()))
    if not found:
        return Sightings(torch.zeros(0, 2, 3), torch.zeros(0, 1, 2), torch.zeros(0, 1))
    face = scene.face[torch.tensor([timestep for timestep, _ in found])].to(torch.zeros(()))
    points = face_model.landmark_positions(face_model(face), "mediapipe")
    pixels, depth = scene.camera.project(points.flatten(0, 1))
    pixels, depth = pixels.reshape(*points.shape[:2], 2), depth.reshape(points.shape[:2])
    detected = torch.stack([marks for _, marks in found])
    across = (detected - pixels) * (depth / scene.camera.K[0, 0].float())[..., None]
    right = across.norm(dim=-1).median(1).values < _MAX_OFFSET
    R_seen = scene.camera.viewmat[:2, :3].float() @ matrix_from_axis_angle(face.head_rotation)
    habits = torch.cat([face.head_rotation[:, :2], face.expression], dim=1)
    return Sightings(R_seen[right], across[right], habits[right])


def fit_response(people: Sequence[Sightings], components: int = _COMPONENTS) -> DetectorResponse:
    """Fit the linear model that explains the detections of these people by least squares."""
    people = [person for person in people if len(person.R_seen) >= 5]
    if len(people) < 2 * _FOLDS:
        raise UserError(
            f"the detector found {len(people)} people, but {2 * _FOLDS} are needed: draw more, and check the pictures"
        )
    offsets = [_offsets(person, person.across) for person in people]
    habits = torch.zeros(0)
    for _ in range(6):
        habits = _fit_habits(people, offsets)
        offsets = [_offsets(person, person.across - _explained(person, habits)) for person in people]
    found = torch.stack(offsets)
    mean = found.mean(0)
    of_people = (found - mean).flatten(1)
    return DetectorResponse(
        mean=mean.double(), by_turn=habits[:2].double(), by_expression=habits[2:].double(),
        by_person=_principal_components(of_people, components).reshape(-1, *mean.shape).double(),
        rest_sigma=_unexplained(of_people, components),
    )  # fmt: skip


def differing_response(
    known: DetectorResponse, seen: Sequence[Sightings], seen_by_other: Sequence[Sightings]
) -> DetectorResponse:
    """Return the response of another detector, from a known one and from the sightings of both in the same pictures.

    Only means and the part by turns change: what few people say about expressions and people did not help on others.
    """
    pairs = [
        (own, other)
        for own, other in zip(seen, seen_by_other, strict=True)
        if own.habits.shape == other.habits.shape and torch.equal(own.habits, other.habits)
    ]
    apart = [Sightings(own.R_seen, other.across - own.across, own.habits[:, :2]) for own, other in pairs]
    difference = fit_response(apart, components=1)
    mean, basis = known.mean + difference.mean, known.by_person.flatten(1)
    habits = torch.cat([known.by_turn + difference.by_turn, known.by_expression]).float()
    own = torch.stack([_offsets(other, other.across - _explained(other, habits)) for _, other in pairs]).double()
    of_people = (own - mean).flatten(1)
    hessian = basis @ basis.T + _NOISE**2 * torch.eye(len(basis), dtype=basis.dtype)
    missed = of_people - torch.linalg.solve(hessian, basis @ of_people.T).T @ basis
    rest_sigma = max(float(missed.square().mean().sqrt()), known.rest_sigma)
    return replace(known, mean=mean, by_turn=known.by_turn + difference.by_turn, rest_sigma=rest_sigma)


def _recipe(seed: int, face_model: FaceModel) -> SyntheticRecipe:
    random = np.random.default_rng(seed)
    focal = float(random.choice((1.2, 1.7, 2.4, 3.2)))  # in picture widths
    return SyntheticRecipe(
        width=384, height=384, fps=2.5, texture_size=512, face_model=face_model.name,
        glasses=bool(random.random() < 0.15), hair="long" if seed % 4 == 3 else "short",
        beard=0.012 if seed % 6 == 5 else 0.0, turns=(34.0, 18.0), rotation=(22.0, 12.0, 7.0), focal=focal,
        distance=focal / SyntheticRecipe.focal * float(random.uniform(0.9, 1.1)),
        script=(Segment("free", 1.6), Segment("turns", 2.4)),
    )  # fmt: skip


def _offsets(person: Sightings, across: Float[Tensor, "n l 2"]) -> Float[Tensor, "l 3"]:
    """Fit offsets in the head frame to offsets across the line of sight. Only turned heads show depth."""
    n = len(across)
    hessian = torch.einsum("nxc,nxd->cd", person.R_seen, person.R_seen) / n + 0.05 * torch.eye(3)
    return torch.linalg.solve(hessian, torch.einsum("nxc,nlx->cl", person.R_seen, across) / n).T


def _fit_habits(people: Sequence[Sightings], offsets: Sequence[Float[Tensor, "l 3"]]) -> Float[Tensor, "h l 3"]:
    count, points = people[0].habits.shape[1], len(offsets[0])
    hessian, right = 2.0 * torch.eye(3 * count), torch.zeros(3 * count, points)
    for person, own in zip(people, offsets, strict=True):
        seen = (person.habits[:, None, :, None] * person.R_seen[:, :, None, :]).flatten(2)
        left = person.across - torch.einsum("nxc,lc->nlx", person.R_seen, own)
        hessian += torch.einsum("nxi,nxj->ij", seen, seen)
        right += torch.einsum("nxi,nlx->il", seen, left)
    return torch.linalg.solve(hessian, right).reshape(count, 3, points).mT


def _explained(person: Sightings, habits: Float[Tensor, "h l 3"]) -> Float[Tensor, "n l 2"]:
    return torch.einsum("nxc,nh,hlc->nlx", person.R_seen, person.habits, habits)


def _principal_components(of_people: Float[Tensor, "n f"], count: int) -> Float[Tensor, "k f"]:
    """Return principal components, each as long as its standard deviation."""
    _, lengths, directions = torch.linalg.svd(of_people, full_matrices=False)
    count = min(count, len(of_people) - 1)
    return directions[:count] * lengths[:count, None] / (len(of_people) - 1) ** 0.5


def _unexplained(of_people: Float[Tensor, "n f"], count: int) -> float:
    """Return the RMS per axis of what components of other people miss of a person, in a fit with unit noise."""
    squares, fold = [], torch.arange(len(of_people)) % _FOLDS
    for left_out in range(_FOLDS):
        basis, others = _principal_components(of_people[fold != left_out], count), of_people[fold == left_out]
        hessian = basis @ basis.T + _NOISE**2 * torch.eye(len(basis))
        squares.append((others - torch.linalg.solve(hessian, basis @ others.T).T @ basis).square().flatten())
    return float(torch.cat(squares).mean().sqrt())


def main(name: tyro.conf.Positional[str] = "anny", people: int = 200, detector: Detector = "mediapipe") -> None:
    """Measure where the landmark detector finds a face model's points, and write the result into the package's data.

    Args:
        name: The face model.
        people: Number of people to draw; each takes about 8 seconds.
        detector: The detector. Any but mediapipe is measured against mediapipe, whose response must be there.
    """
    face_model = load_face_model(name)
    seeds = range(500, 500 + people)  # far from those of the reference captures: nobody is calibrated and measured on
    detectors = ("mediapipe",) if detector == "mediapipe" else ("mediapipe", detector)
    rounds = track_progress(seeds, "Drawing and detecting", people)
    seen = list(zip(*(sight_person(seed, face_model, detectors) for seed in rounds), strict=True))
    response = (
        fit_response(seen[0])
        if detector == "mediapipe"
        else differing_response(read_response(face_model, _MAX_OFFSET), seen[0], seen[1])
    )
    path = response_path(name, detector)
    write_response(path, face_model, response, people, detector)
    deviation = 1e3 * float(response.by_person.square().sum(0).mean().sqrt())
    say(
        f"{path}: mean offset {1e3 * float(response.mean.norm(dim=1).mean()):.2f} mm; people differ by "
        f"{deviation:.2f} mm along each axis; components learned from other people still miss "
        f"{1e3 * response.rest_sigma:.2f} mm of it"
    )


if __name__ == "__main__":
    tyro.cli(main)
