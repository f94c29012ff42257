"""What the `paper` schedule fits: the parameters, and what stays the same while they move."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import interpolate

from mien.camera import Camera
from mien.face import FaceModel, Landmarks
from mien.render.mesh_gradients import LitMesh, mesh_edges
from mien.tracking.landmark_groups import LEFT_IRIS, RIGHT_IRIS
from mien.tracking.landmark_model import LandmarkModel
from mien.tracking.landmark_term import LandmarkTerm, Subject
from mien.tracking.paper_settings import PaperSettings
from mien.tracking.parameters import ParameterLayout
from mien.tracking.photometric_fit import PhotometricFit
from mien.tracking.photometric_pictures import Pictures
from mien.tracking.photometric_texture import HIDING_REGIONS, even_light, texture_space
from mien.tracking.settings import TrackingSettings
from mien.tracking.shot import Shot
from mien.tracking.solver import Smoothness
from mien.tracking.stages import Fit, SequenceFit, all_landmarks, quiet_landmarks, smoothness_of
from mien.tracking.views import CameraBatch

_STIFF_REGIONS = ("eyes", "irises", "eyelids", "teeth", "tongue", "mouth", "eye_sockets", "scalp", "neck", "ears")
"""Regions without offsets: they close on each other, or nothing shows where they are."""


@dataclass(eq=False)
class PaperState:
    """All that is fitted; float32. Mutable: Adam writes into it."""

    identity: Float[Tensor, " i"]
    offsets: Float[Tensor, "v 3"]
    texture: Float[Tensor, "th tw 3"]
    lights: Float[Tensor, "s 9 3"]
    log_focals: Float[Tensor, " g"]
    frames: list[Float[Tensor, "_ p"]]
    """Of each sequence, a row a timestep with a face (their numbers differ)."""
    sight: Float[Tensor, " f"]
    """The best cosine between a triangle's normal and the direction to a camera of a frame that its texels are from."""

    def tensors(self) -> dict[str, Tensor]:
        """By name, for a file."""
        frames = {f"frames_{index}": rows for index, rows in enumerate(self.frames)}
        names = ("identity", "offsets", "texture", "lights", "log_focals", "sight")
        return {name: getattr(self, name) for name in names} | frames


@dataclass(frozen=True, eq=False)
class SequenceScene:
    """One sequence as it was found."""

    timesteps: Int[Tensor, " t"]
    pictures: Pictures
    cameras: CameraBatch
    """float32, with the focal length of the fit to landmarks."""
    smoothness: Smoothness
    lens: int | None
    terms: tuple[LandmarkTerm, ...]
    """Landmarks of each row alone; float64."""

    def seen_by(self, row: int) -> list[int]:
        """The cameras that found a face."""
        return self.terms[row].views.camera.tolist()

    def cameras_at(self, log_focals: Float[Tensor, " g"]) -> CameraBatch:
        """With the present focal lengths. Differentiable."""
        if self.lens is None:
            return self.cameras
        factor, one = log_focals[self.lens].exp(), log_focals.new_ones(())
        scale = torch.stack([torch.stack([factor, one, one]), torch.stack([one, factor, one]), torch.ones(3)])
        return CameraBatch(self.cameras.K * scale, self.cameras.viewmat)


@dataclass(frozen=True, eq=False)
class PaperScene:
    """Everything that does not move."""

    face_model: FaceModel
    layout: ParameterLayout
    precision: Float[Tensor, "p p"]
    landmarks: Landmarks
    bias: Float[Tensor, "l 3"]
    """Of landmarks, as `Subject.bias`; float64."""
    mesh: LitMesh
    used: Float[Tensor, " f"]
    identity: Float[Tensor, " i"]
    """Where landmarks had it."""
    offset_share: Float[Tensor, "v 1"]
    """0 for vertices that get no offset."""
    neighbours: tuple[Int[Tensor, " n"], Int[Tensor, " n"], Float[Tensor, "v 1"]]
    """Pairs of vertices along edges, and one over the number of each vertex's neighbours."""
    sequences: tuple[SequenceScene, ...]
    settings: PaperSettings

    def whitening(
        self, sequence: int, row: int, state: Float[Tensor, " p"], differences: float
    ) -> Float[Tensor, "p p"]:
        """Turns independent steps of one standard deviation, which landmarks and smoothness leave, into parameters.

        `differences` is the sum of squares of the timestep's factors in the second differences that count.
        """
        own = self.sequences[sequence]
        subject = Subject(self.identity.double(), self.bias)
        cameras = CameraBatch(own.cameras.K.double(), own.cameras.viewmat.double())
        with torch.no_grad():
            here = own.terms[row].equations(state.double()[None], subject, cameras)
            hessian = here.hessian[0] + torch.diag(differences * own.smoothness.precision.double())
            hessian += 1e-9 * torch.diag(hessian.diagonal())
            return torch.linalg.inv(torch.linalg.cholesky(hessian)).T.float().contiguous()

    def camera(self, sequence: int, camera: int, log_focals: Float[Tensor, " g"]) -> Camera:
        """Of a picture of the capture's size, with the present focal length."""
        own = self.sequences[sequence]
        cameras, capture = own.cameras_at(log_focals), own.pictures.capture
        return Camera(cameras.K[camera], cameras.viewmat[camera], capture.width, capture.height)


def paper_scene(
    model: LandmarkModel,
    shots: Sequence[Shot],
    lenses: Sequence[int | None],
    fit: Fit,
    settings: TrackingSettings,
    refined: PhotometricFit | None = None,
) -> PaperScene:
    """Constants of the fit, from what landmarks led to, or pixels as well."""
    face_model = model.face_model.to(torch.zeros(()))
    used = ~face_model.region_mask(*HIDING_REGIONS)
    weights = used.float() if refined is None else used * _trust(face_model, refined)
    mesh = LitMesh(
        face_model.faces.contiguous(), face_model.uv[face_model.uv_faces].contiguous(), weights,
        mesh_edges(face_model.faces, used),
    )  # fmt: skip
    sequences = [
        _sequence(model, shot, own, lens, settings)
        for shot, own, lens in zip(shots, fit.sequences, lenses, strict=True)
    ]
    return PaperScene(
        face_model, model.layout, model.layout.precision.float(), face_model.landmarks["mediapipe"],
        fit.subject.bias, mesh, weights,
        fit.subject.identity.float(), _offset_share(face_model), _neighbours(face_model), tuple(sequences),
        settings.paper,
    )  # fmt: skip


def _trust(face_model: FaceModel, refined: PhotometricFit) -> Float[Tensor, " f"]:
    """The mean trust in each triangle's texels: where pictures contradict each other, as at glasses, they say less."""
    trust, count = refined.appearance.trust, len(face_model.faces)
    face_index = texture_space(face_model, len(trust)).fragments.face_index.long().flatten()
    face_index = torch.where(face_index < 0, count, face_index)
    texels = torch.bincount(face_index, minlength=count + 1)
    sums = torch.bincount(face_index, weights=trust.flatten().double(), minlength=count + 1)
    return (sums / texels.clamp_min(1))[:count].float()


def first_state(
    scene: PaperScene, fit: Fit, lenses: Sequence[int | None], refined: PhotometricFit | None = None
) -> PaperState:
    """Where a fit led to; texture and light are even unless pixels were looked at."""
    lights = [even_light() for _ in scene.sequences] if refined is None else list(refined.lights)
    return PaperState(
        identity=scene.identity.clone(),
        offsets=torch.zeros_like(scene.face_model.template),
        texture=_first_texture(scene.settings.texture_size, refined),
        lights=torch.stack(lights),
        log_focals=torch.zeros(len({lens for lens in lenses if lens is not None})),
        frames=[own.state.float() for own in fit.sequences],
        sight=torch.zeros(len(scene.mesh.faces)),
    )


def _first_texture(size: int, refined: PhotometricFit | None) -> Float[Tensor, "th tw 3"]:
    """What is known of it, of the middle colour elsewhere."""
    texture = torch.full((size, size, 3), 0.5)
    if refined is None or not (refined.appearance.trust > 0).any():
        return texture
    albedo, known = refined.appearance.albedo, refined.appearance.trust > 0
    filled = torch.where(known[..., None], albedo, albedo[known].median(0).values)
    planes = interpolate(filled.movedim(2, 0)[None], (size, size), mode="bilinear", antialias=True)
    return planes[0].movedim(0, 2).contiguous()


def _sequence(
    model: LandmarkModel, shot: Shot, own: SequenceFit, lens: int | None, settings: TrackingSettings
) -> SequenceScene:
    cameras = own.cameras
    term = quiet_landmarks(all_landmarks(model, shot.views, own, settings), settings.paper.landmark_share)
    smoothness = smoothness_of(model.layout, shot.valid, shot.fps, settings.smoothness, cameras)
    return SequenceScene(
        shot.valid.nonzero()[:, 0], Pictures(shot.capture, settings.paper.shrink),
        CameraBatch(cameras.K.float(), cameras.viewmat.float()),
        Smoothness(smoothness.precision.float(), smoothness.linked), lens,
        tuple(term.at(torch.tensor([row])) for row in range(len(own.state))),
    )  # fmt: skip


def _offset_share(face_model: FaceModel) -> Float[Tensor, "v 1"]:
    share = torch.ones(len(face_model.template), 1)
    share[face_model.faces[face_model.region_mask(*_STIFF_REGIONS)].flatten()] = 0
    marks = face_model.landmarks["mediapipe"]
    share[face_model.faces[marks.faces[list(LEFT_IRIS + RIGHT_IRIS)]].flatten()] = 0
    return share


def _neighbours(face_model: FaceModel) -> tuple[Tensor, Tensor, Tensor]:
    edges = mesh_edges(face_model.faces).vertices.long().unique(dim=0)
    first, second = torch.cat([edges, edges.flip(1)]).unbind(1)
    count = torch.zeros(len(face_model.template), 1).index_add(0, first, torch.ones(len(first), 1))
    return first, second, 1 / count.clamp_min(1)
