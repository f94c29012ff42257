"""A tracking on another version of its face model is refused, by the colours of the skin in its pictures."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from dataset_checks import read
from dataset_layouts import draw_at
from dataset_scene import NoDetector, Scene, drawn_person
from dataset_writers import write_benchmark, write_flash_avatar, write_imavatar, write_insta, write_vhap
from flame_like import write_npz
from mien.datasets import overlay
from mien.datasets.dataset import TrackedSequence
from mien.datasets.overlay import Steadiness, check_overlay, measure_steadiness
from mien.errors import UserError
from mien.face import FaceModel, FaceParams
from mien.face.models.flame import flame_face_model, read_flame
from mien.tracking.landmarks.regions import with_regions_by_landmarks

pytestmark = pytest.mark.unchecked
TIMESTEPS = 10
PAINTS = {
    "lips": (0.7, 0.25, 0.25), "brows": (0.2, 0.12, 0.08), "irises": (0.1, 0.1, 0.15), "scalp": (0.2, 0.15, 0.1),
    "eyes": (0.95, 0.95, 0.95),
}  # fmt: skip


@pytest.fixture(autouse=True)
def larger_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw pictures of twice the size, and leave out the detector, which takes seconds."""
    monkeypatch.setattr(overlay, "LandmarkDetector", NoDetector)
    draw_at(2, monkeypatch)


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Return a head with lips, brows and eyes that moves, with an identity as large as a person's."""
    made = drawn_person(TIMESTEPS)
    painted = with_regions_by_landmarks(made.model)
    colors = torch.tensor([0.85, 0.65, 0.55]).repeat(len(made.model.template), 1)
    for region, color in PAINTS.items():
        colors[painted.faces[painted.region_mask(region)].unique()] = torch.tensor(color)
    return replace(made, colors=colors)


def mixed(scene: Scene, folder: Path, of: str) -> FaceModel:
    """Return another version: the mean head is the same, and its identities or expressions are in another order."""
    random, count = np.random.default_rng(0), int(scene.arrays["identities"])
    identities, expressions = np.split(scene.arrays["shapedirs"], [count], axis=2)
    if of != "expressions":
        identities = identities[..., random.permutation(count)]
    if of != "identity":
        expressions = expressions[..., random.permutation(expressions.shape[2])]
    basis = np.concatenate([identities, expressions], axis=2)
    path = write_npz(folder / f"{of}.npz", {**scene.arrays, "shapedirs": basis})
    return replace(flame_face_model(read_flame(path), f"other_{of}"), landmarks=scene.model.landmarks)


def insta(scene: Scene, tmp_path: Path) -> TrackedSequence:
    (sequence,) = read(write_insta(tmp_path / "me", scene), "insta", scene.model)
    return sequence


@pytest.fixture(scope="module")
def others(scene: Scene, tmp_path_factory) -> dict[str, FaceModel]:
    folder = tmp_path_factory.mktemp("other")
    return {of: mixed(scene, folder, of) for of in ("identity", "expressions")}


def test_other_versions_are_found_in_every_layout(scene: Scene, others: dict[str, FaceModel], tmp_path: Path) -> None:
    layouts: dict[str, tuple[str, Callable[[Path, Scene], Path]]] = {
        "flash-avatar": ("insta", write_flash_avatar),
        "imavatar": ("imavatar", lambda folder, scene: write_imavatar(folder, scene, ("MVI_1810",))),
        "vhap": ("vhap", write_vhap),
        "benchmark": ("nersemble-benchmark", write_benchmark),
    }
    for name, (dataset, write) in layouts.items():
        folder = write(tmp_path / name, scene)
        assert read(folder, dataset, scene.model)
        for of, told in (("identity", "identity"), ("expressions", "expressions")):
            with pytest.raises(UserError, match=f"{told} on 'other_{of}' than without, so this is another version"):
                read(folder, dataset, others[of])


def test_what_cannot_be_compared_is_left_out(scene: Scene, tmp_path: Path) -> None:
    """Few frames, a small face, a face without expressions, and a head without motion say nothing of a version."""
    sequence = insta(scene, tmp_path)
    face, capture = sequence.tracking.face, sequence.capture

    def measured(face: FaceParams, images: np.ndarray = capture.images) -> Steadiness:
        tracking = replace(sequence.tracking, face=face)
        few = replace(
            capture, images=images, timestamps=capture.timestamps[: len(face)], mattes=capture.mattes[: len(face)],
            landmarks=capture.landmarks[: len(face)], valid=capture.valid[: len(face)],
        )  # fmt: skip
        return measure_steadiness(replace(sequence, capture=few, tracking=tracking))

    assert measured(face[:7], capture.images[:7]) == Steadiness(None, None)
    assert measured(replace(face, head_translation=3 * face.head_translation)) == Steadiness(None, None)
    assert measured(replace(face, expression=0.1 * face.expression)).expression is None
    fixed = {name: getattr(face, name)[:1].expand(len(face), 3) for name in ("head_rotation", "head_translation")}
    assert measured(replace(face, **fixed)).identity is None
    # Each frame is moved to where it fits best: without that, the shares below are 0.73 and 0.81.
    off = torch.tensor(np.random.default_rng(2).uniform(-0.0025, 0.0025, (TIMESTEPS, 3)) * (1, 1, 0)).float()
    face = replace(sequence.tracking.face, head_translation=sequence.tracking.face.head_translation + off)
    found = measure_steadiness(replace(sequence, tracking=replace(sequence.tracking, face=face)))
    assert 0 < (found.identity or 0) < 0.66
    assert 0 < (found.expression or 0) < 0.75
    # Pictures of another size are told.
    capture, (view,) = sequence.capture, sequence.tracking.cameras
    images, mattes = (
        np.stack([cv2.resize(each, (400, 384)) for each in all_of[:, 0]])[:, None]
        for all_of in (capture.images, capture.mattes)
    )
    views = (replace(view, width=400, height=384),)
    resized = replace(capture, images=images, mattes=mattes, calibration=views)
    larger = replace(sequence, capture=resized, tracking=replace(sequence.tracking, cameras=views))
    with pytest.raises(UserError, match="these have 400x384 pixels, and the tracking was made on about 265x248, so"):
        check_overlay(tmp_path, larger, "FLAME")
    check_overlay(tmp_path, sequence, "FLAME")
