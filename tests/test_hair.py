"""Hair that no picture shows, and tracked meshes that stand out beyond the mattes."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from mien.avatar.bound_surface import SurfacePrior
from mien.avatar.methods import DEFAULT_METHOD, method_named
from mien.avatar.ops.hair_strands import strand_gaussians
from mien.avatar.ops.triangle_frames import frames_to_world, triangle_frames
from mien.avatar.settings import FaceTuning
from mien.camera import camera_from_fov
from mien.capture.capture import Capture
from mien.face import FaceModel
from mien.face.head_parts import head_parts
from mien.face.mirror import triangle_geometry
from mien.render.mesh import rasterize_mesh, vertex_normals
from mien.rotation import matrix_from_quaternion
from mien.tracking.neck_cut import NeckParts, above_neck_cut, fit_neck_cut
from mien.tracking.tracking import Tracking
from mien.training import PRESETS, TrainSettings
from mien.training.footage.frames import Footage, Frame
from mien.training.footage.sequence import Sequence
from mien.training.trainer import start
from mien.training.whole_head.hair_height import back_hair, hair_height, hanging_hair
from mien.training.whole_head.outline_fit import fit_to_outlines, fitted_faces
from plain_settings import plain_config, plain_run
from toy_scene import rgb_from_sh, surface_of, toy_sequence

_HAIR = 0.02
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


@pytest.mark.unchecked
@pytest.mark.parametrize("height", [0.0, 0.012, 0.03])
def test_the_height_of_a_scalp_that_stands_out(anny, height):
    sequence, frames = _sequence(anny, height), [Frame(0, timestep, 0) for timestep in range(_TIMESTEPS)]
    found = hair_height(Footage(anny, [sequence], [sequence.tracking.face], frames))
    middles, scalp = anny.template[anny.faces].mean(1), head_parts(anny).scalp
    assert abs(float(found[scalp & (middles[:, 1] > 0.07)].median()) - height) < 0.004
    assert abs(float(found[scalp & (middles[:, 2] < -0.06)].median()) - height) < 0.006
    assert not found[~scalp].any()
    sequence.capture.mattes[:] = 255
    assert not hair_height(Footage(anny, [sequence], [sequence.tracking.face], frames)).any(), "no outline"


@pytest.mark.unchecked
def test_hair_that_hangs_beside_the_neck(anny):
    """The sides of the neck stand out by two centimetres, as hair does that hangs there; cheeks and scalp do not."""
    parts, middles = head_parts(anny), anny.template[anny.faces].mean(1)
    neck = parts.neck & (middles[:, 0].abs() > 0.03)
    sequence = _sequence(anny, 0.02, neck)
    frames = [Frame(0, timestep, 0) for timestep in range(_TIMESTEPS)]
    found = hanging_hair(Footage(anny, [sequence], [sequence.tracking.face], frames))
    sides = neck & (middles[:, 0].abs() > 0.05) & (middles[:, 1] > middles[neck, 1].median())
    assert 0.012 < float(found[sides].median()) < 0.03
    bare = _sequence(anny, 0.0)
    without = hanging_hair(Footage(anny, [bare], [bare.tracking.face], frames))
    assert float(without[sides].median()) < 0.004
    assert float(found[parts.face].median()) < 0.004
    assert not found[parts.scalp | parts.interior].any()


def _beside(model: FaceModel, *, low: float = -1.0, left: float = 0.05, right: float = 0.05) -> torch.Tensor:
    """Heights beside skin and neck as `hanging_hair` measures them, from the scalp down to a level."""
    middles, parts = model.template[model.faces].mean(1), head_parts(model)
    hanging = torch.where(middles[:, 0] > 0, left, right)
    return torch.where((parts.skin | parts.neck) & (middles[:, 1] > low), hanging, 0.0)


def _back_hair(model: FaceModel, hanging: torch.Tensor, hair: float = _HAIR) -> torch.Tensor:
    return back_hair(model, model.template, hair * head_parts(model).scalp.float(), hanging)


def test_long_hair_falls_from_the_widest_part_of_the_head_if_it_hangs_at_both_sides(anny):
    middles, _, normals = triangle_geometry(anny.template, anny.faces)
    found, parts = _back_hair(anny, _beside(anny)), head_parts(anny)
    nape = (found > 0) & (normals[:, 2] < -0.8) & (middles[:, 0].abs() < 0.02)
    assert int(nape.sum()) > 10
    low, high = middles[parts.scalp, 2].aminmax()
    outside = middles + found[:, None] * normals
    level = nape & (middles[:, 1] > middles[nape, 1].median())
    assert (outside[level, 2] - (low - _HAIR)).abs().median() < 0.006
    assert not found[(normals[:, 2] >= 0) | parts.face].any()
    cut = fit_neck_cut(NeckParts.of(anny), anny.template, torch.tensor([0.0, 1.0, 0.0]))
    assert (cut.margins(outside[found > 0]) > 0).all(), "no hair hangs below the cut"
    shorter = _back_hair(anny, _beside(anny, low=-0.09))
    assert float(middles[found > 0][:, 1].min()) < float(middles[shorter > 0][:, 1].min()) - 0.01, "as at the sides"
    for hanging in ({"left": 0.0, "right": 0.0}, {"left": 0.05, "right": 0.005}, {"low": 1.0}):
        assert not _back_hair(anny, _beside(anny, **hanging)).any(), hanging
    assert not _back_hair(anny, _beside(anny), hair=0.0).any(), "a bald head"
    # A collar below a bare neck: shoulders stand out beside its lowest part, with nothing between them and the scalp.
    collar = torch.where(anny.template[anny.faces].mean(1)[:, 1] < -0.11, _beside(anny), 0.0)
    assert not _back_hair(anny, collar).any()


def test_margins_are_those_of_pictures(anny):
    cut = fit_neck_cut(NeckParts.of(anny), anny.template, torch.tensor([0.0, 1.0, 0.0]))
    camera = camera_from_fov(0.5, 128, 128, torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])))
    camera.viewmat[2, 3] = 1.0
    origin = torch.from_numpy(cut.origin).float()
    for offset in ([0.09, 0.02, 0.0], [0.09, 0.12, 0.0], [0.07, -0.02, 0.0]):
        point = (origin + torch.tensor(offset))[None]
        column, row = camera.project(point)[0][0].floor().int().tolist()
        assert (float(cut.margins(point)) > 0) == (above_neck_cut(cut, camera)[row, column] > 0.5)


def _back(model: FaceModel) -> torch.Tensor:
    """The scalp behind the ears, where the surface is steep."""
    middles = model.template[model.faces].mean(1)
    return head_parts(model).scalp & (middles[:, 2] < -0.05)


def _strands(model: FaceModel) -> dict[str, torch.Tensor]:
    heights, colors = torch.full((len(model.faces),), _HAIR), torch.full((len(model.faces), 3), 0.4)
    return strand_gaussians(model.template, model.faces, _back(model), heights, colors)


def test_strands_cover_the_chosen_triangles_hang_in_the_surface_and_keep_their_colors(anny):
    strands, frames = _strands(anny), triangle_frames(anny.template, anny.faces)
    counts = torch.bincount(strands["face_index"], minlength=len(anny.faces)).double()
    expected = 150_000 * triangle_geometry(anny.template.double(), anny.faces)[1] * _back(anny)
    assert float((counts - expected).abs().max()) <= 1
    assert not counts[~_back(anny)].any()
    assert len(strands["means"]) > 1000
    # Just below the top of the hair.
    above = strands["means"][:, 1] * frames.k[strands["face_index"]]
    assert float(above.min()) > _HAIR - 0.0031
    assert float(above.max()) <= _HAIR + 1e-6
    # Down, in the surface.
    quats = frames_to_world(frames, *(strands[name] for name in ("face_index", "means", "quats", "log_scales")))[1]
    along = matrix_from_quaternion(quats)[..., 0]
    assert float((along * frames.R[strands["face_index"]][..., 1]).sum(-1).abs().max()) < 1e-4
    assert float(along[:, 1].median()) < -0.8
    assert float(along[:, 0].abs().median()) < 0.4
    # They differ in brightness, and not in tint or between calls.
    colors = rgb_from_sh(strands["sh_constant"][:, 0])
    assert abs(float(colors.mean()) - 0.4) < 0.01
    assert 0.06 < float(colors[:, 0].std()) < 0.1
    torch.testing.assert_close(colors[:, 0], colors[:, 2])
    again = _strands(anny)
    assert all(strands[name].equal(again[name]) for name in strands)
    none = torch.zeros(len(anny.faces), dtype=torch.bool)
    empty = strand_gaussians(anny.template, anny.faces, none, none.float(), none[:, None].expand(-1, 3).float())
    assert not any(len(values) for values in empty.values())
    chosen, count = _back(anny), len(anny.faces)
    config = PRESETS["standard"].config("gaussian_avatars")
    avatar = method_named("gaussian_avatars").avatar(config, anny, anny.neutral(1))
    store, bald = avatar.store, len(avatar.store)
    hair, color = torch.full((count,), _HAIR), torch.full((count, 3), 0.4)
    prior = SurfacePrior(hair, colors=color, doubt=chosen.float(), filled_in=chosen, strands=chosen)
    surface_of(avatar).close(prior)
    assert len(store) == bald + len(_strands(anny)["means"])
    before = store["sh_constant"][bald:].detach().clone()
    for _ in range(20):
        surface_of(avatar).keep_to(prior)
    assert store["sh_constant"][bald:].equal(before)


_SLACK = 0.004
"""Largest shift in metres where nothing is wrong: a pixel and a half. The rim of an ear is thinner than a pixel."""
_FRAMES = [Frame(0, timestep, 0) for timestep in range(_TIMESTEPS)]


def _fitted(model: FaceModel, sequence: Sequence) -> torch.Tensor:
    return fit_to_outlines(Footage(model, [sequence], [sequence.tracking.face], _FRAMES))


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
    faces = fitted_faces(Footage(model, [sequence], [sequence.tracking.face], [Frame(0, 0, 0)]), settings, bound=bound)
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
