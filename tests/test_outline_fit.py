"""A tracked mesh that stands out beyond the mattes is drawn into them before training."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from mien.avatar.methods import DEFAULT_METHOD
from mien.avatar.settings import FaceTuning
from mien.face import FaceModel
from mien.face.head_parts import head_parts
from mien.render.mesh import rasterize_mesh
from mien.training import TrainSettings
from mien.training.footage.frames import Frame
from mien.training.footage.sequence import Sequence
from mien.training.trainer import start
from mien.training.whole_head.outline_fit import fit_to_outlines, fitted_faces
from plain_settings import plain_config, plain_run
from test_hair import _TIMESTEPS, _sequence
from toy_scene import toy_sequence

_SLACK = 0.004
"""Largest shift in metres where nothing is wrong: a pixel and a half. The rim of an ear is thinner than a pixel."""
_FRAMES = [Frame(0, timestep, 0) for timestep in range(_TIMESTEPS)]


def _fitted(model: FaceModel, sequence: Sequence) -> torch.Tensor:
    return fit_to_outlines(model, [sequence], [sequence.tracking.face], _FRAMES, threads=1)


@pytest.mark.unchecked
def test_a_skull_that_is_too_high_sinks_into_the_outline(anny: FaceModel) -> None:
    """The face of a person whose skull is 12 mm lower than the tracked one does not move, and the skull stays round."""
    sequence = _sequence(anny, -0.012)
    offsets = _fitted(anny, sequence)

    def outside(offsets: torch.Tensor | None) -> float:
        """The share of the mesh's pixels that lie outside of the mattes, over all frames."""
        out = drawn = 0
        for frame in _FRAMES:
            face = replace(sequence.tracking.face[frame.timestep], vertex_offsets=offsets)
            mesh = rasterize_mesh(anny(face)[0], anny.faces, sequence.tracking.cameras[0]).face_index.numpy() >= 0
            out += int((mesh & (sequence.capture.mattes[frame[1:]] < 128)).sum())
            drawn += int(mesh.sum())
        return out / drawn

    before = outside(None)
    assert before > 0.02
    assert outside(offsets) < 0.25 * before
    crown = anny.template[:, 1].argmax()
    assert -0.016 < float(offsets[crown, 1]) < -0.008, "the crown sinks by what it was too high"
    face = anny.faces[head_parts(anny).face].long().flatten()
    assert float(offsets[face].norm(dim=1).mean()) < 0.0005
    # Seen from the front, the crown alone is too high. From the side, it still stands out above what is around it.
    away = anny.template - anny.template[crown]
    beside = (away[:, 0].abs() < 0.01) & (away[:, 2].abs() > 0.03) & (away[:, 2].abs() < 0.05) & (away[:, 1] > -0.03)
    top = away.norm(dim=1) < 0.012
    meshes = (anny.template, anny.template + offsets)
    old, new = (float(each[top, 1].mean() - each[beside, 1].mean()) for each in meshes)
    assert new > 0.8 * old
    # A frame without a person says nothing: its distances from the matte are infinite.
    mattes = sequence.capture.mattes.copy()
    mattes[1] = 0
    found = _fitted(anny, replace(sequence, capture=replace(sequence.capture, mattes=mattes)))
    assert float((found - offsets).norm(dim=1).max()) < 0.005
    nobody = replace(sequence.capture, mattes=np.zeros_like(mattes))
    assert not _fitted(anny, replace(sequence, capture=nobody)).any()


def test_hair_draws_nothing_and_offsets_that_tracking_found_are_kept(anny: FaceModel) -> None:
    sequence, own = _sequence(anny, 0.03), torch.full_like(anny.template, 0.001)
    tracking = replace(sequence.tracking, face=replace(sequence.tracking.face, vertex_offsets=own))
    assert float((_fitted(anny, replace(sequence, tracking=tracking)) - own).norm(dim=1).max()) < _SLACK


@pytest.mark.parametrize(("mesh", "unseen", "bound", "fits"), [
    ("fitted", "filled", True, True), ("fitted", "trained", True, True), ("auto", "filled", True, True),
    ("auto", "trained", True, False), ("tracked", "filled", True, False), ("fitted", "filled", False, False),
])  # fmt: skip
def test_which_meshes_are_fitted(mesh, unseen, bound: bool, fits: bool) -> None:
    model, sequence = toy_sequence(timesteps=3, size=32)
    settings = TrainSettings(mesh=mesh, unseen=unseen)
    faces = fitted_faces(model, [sequence], [Frame(0, 0, 0)], settings, bound=bound)
    assert (faces is not None) is fits


def test_training_starts_from_the_fitted_mesh() -> None:
    model, sequence = toy_sequence(timesteps=3, size=32)
    config = plain_config(DEFAULT_METHOD, face_tuning=FaceTuning(enabled=True))
    # Nobody is in the pictures, so every vertex is drawn to the nearest pixel of a person in a corner.
    mattes = np.zeros_like(sequence.capture.mattes)
    mattes[:, :, :8, :8] = 255
    away = Sequence(sequence.name, replace(sequence.capture, mattes=mattes), sequence.tracking, sequence.scoring)
    state = start([away], model, config, plain_run(mesh="fitted", split="none"))
    offsets = state.avatar.subject.vertex_offsets
    assert offsets is not None
    assert float(offsets.norm(dim=1).max()) > 0.002
    assert state.track.face(1).vertex_offsets is not None
    assert torch.equal(state.track.params().vertex_offsets, offsets)  # type: ignore[arg-type]
