"""The height of hair above the scalp comes from the mattes' outlines."""

import numpy as np
import pytest
import torch

from mien.camera import camera_from_fov
from mien.capture import Capture
from mien.face import FaceModel
from mien.face.head_parts import head_parts
from mien.render.mesh import rasterize_mesh, vertex_normals
from mien.tracking import Tracking
from mien.training import Sequence
from mien.training.footage.frames import Frame
from mien.training.whole_head.hair_height import hair_height, hanging_hair

_SIZE, _TIMESTEPS = 160, 7


def _sequence(model: FaceModel, height: float, grows: torch.Tensor | None = None) -> Sequence:
    """A head that turns and nods, in mattes on which some triangles (the scalp) stand out by a height in metres."""
    angles = torch.linspace(-0.4, 0.4, _TIMESTEPS)
    face = model.neutral(_TIMESTEPS)
    face.head_rotation[:, 1], face.head_rotation[:, 0] = angles, 0.5 * angles.abs() - 0.1
    face.head_translation[:, 2] = -0.8
    camera = camera_from_fov(0.5, _SIZE, _SIZE, torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])))
    grown = torch.zeros(len(model.template), dtype=torch.bool)
    grown[model.faces[head_parts(model).scalp if grows is None else grows]] = True
    mattes = np.zeros((_TIMESTEPS, 1, _SIZE, _SIZE), np.uint8)
    for timestep in range(_TIMESTEPS):
        vertices = model(face[timestep])[0]
        vertices = vertices + height * grown[:, None] * vertex_normals(vertices, model.faces)
        mattes[timestep, 0] = 255 * (rasterize_mesh(vertices, model.faces, camera).face_index >= 0).numpy()
    images = np.zeros((*mattes.shape, 3), np.uint8)
    capture = Capture(
        name="head", camera_ids=("front",), fps=25.0, timestamps=np.arange(_TIMESTEPS) / 25, images=images,
        mattes=mattes, landmarks=np.zeros((_TIMESTEPS, 1, 478, 2), np.float32),
        valid=np.ones((_TIMESTEPS, 1), bool), principal_point=np.full((1, 2), _SIZE / 2, np.float32), source={},
    )  # fmt: skip
    tracking = Tracking(
        face_model=model.name, face_model_hash=model.content_hash, face=face,
        valid=torch.ones(_TIMESTEPS, dtype=torch.bool), cameras=(camera,),
        neck_lines=torch.tensor([0.0, 1.0, 1e6]).expand(_TIMESTEPS, 1, 3), residuals=torch.zeros(_TIMESTEPS, 1),
    )  # fmt: skip
    return Sequence("head", capture, tracking, mattes)


def _height(model: FaceModel, sequence: Sequence) -> torch.Tensor:
    frames = [Frame(0, timestep, 0) for timestep in range(_TIMESTEPS)]
    return hair_height(model, [sequence], [sequence.tracking.face], frames, threads=1)


@pytest.mark.parametrize("height", [0.0, 0.012, 0.03])
def test_the_height_of_a_scalp_that_stands_out(anny, height):
    found = _height(anny, _sequence(anny, height))
    middles, scalp = anny.template[anny.faces].mean(1), head_parts(anny).scalp
    top = scalp & (middles[:, 1] > 0.07)
    back = scalp & (middles[:, 2] < -0.06)
    assert abs(float(found[top].median()) - height) < 0.004
    assert abs(float(found[back].median()) - height) < 0.006
    assert not found[~scalp].any()


def test_without_an_outline_there_is_no_height(anny):
    sequence = _sequence(anny, 0.01)
    sequence.capture.mattes[:] = 255
    found = _height(anny, sequence)
    assert (found == 0).all()


def test_hair_that_hangs_beside_the_neck(anny):
    """The sides of the neck stand out by two centimetres, as hair does that hangs there; cheeks and scalp do not."""
    parts, middles = head_parts(anny), anny.template[anny.faces].mean(1)
    neck = parts.neck & (middles[:, 0].abs() > 0.03)
    sequence = _sequence(anny, 0.02, neck)
    frames = [Frame(0, timestep, 0) for timestep in range(_TIMESTEPS)]
    found = hanging_hair(anny, [sequence], [sequence.tracking.face], frames, threads=1)
    sides = neck & (middles[:, 0].abs() > 0.05) & (middles[:, 1] > middles[neck, 1].median())
    assert 0.012 < float(found[sides].median()) < 0.03
    bare = _sequence(anny, 0.0)
    without = hanging_hair(anny, [bare], [bare.tracking.face], frames, threads=1)
    assert float(without[sides].median()) < 0.004
    assert float(found[parts.face].median()) < 0.004
    assert not found[parts.scalp | parts.interior].any()
