"""The parameters that the `paper` schedule fits, and the constants of the fit."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import interpolate

from mien.camera import Camera
from mien.face.model import FaceModel
from mien.render.mesh_gradients import LitMesh, mesh_edges
from mien.tracking.fitting.fit import HIDING_REGIONS, Fit, Subject
from mien.tracking.fitting.parameters import ParameterLayout
from mien.tracking.fitting.solver import Smoothness
from mien.tracking.fitting.views import CameraBatch
from mien.tracking.landmarks.groups import LEFT_IRIS, RIGHT_IRIS
from mien.tracking.landmarks.problem import Problem
from mien.tracking.landmarks.term import LandmarkTerm, quiet_landmarks
from mien.tracking.pixels.pictures import Pictures
from mien.tracking.pixels.texture import PhotometricFit, even_light, texture_space
from mien.tracking.settings import PaperSettings

_STIFF_REGIONS = ("eyes", "irises", "eyelids", "teeth", "tongue", "mouth", "eye_sockets", "scalp", "neck", "ears")
"""Regions without vertex offsets, but in the supplement's fit. They close on each other, or pictures do not show where
they are."""


@dataclass(eq=False)
class PaperState:
    """All parameters that are fitted, float32. Mutable: Adam writes into it."""

    identity: Float[Tensor, " i"]
    offsets: Float[Tensor, "v 3"]
    texture: Float[Tensor, "th tw 3"]
    lights: Float[Tensor, "s 9 3"]
    log_focals: Float[Tensor, " g"]
    frames: list[Float[Tensor, "_ p"]]
    """Parameters of each sequence: one row for each timestep with a face, so lengths differ."""
    visibility: Float[Tensor, " f"]
    """Cosine between each triangle's normal and the direction to the camera in the frame that its texels are from."""

    def tensors(self) -> dict[str, Tensor]:
        """The parameters by name, for a file."""
        frames = {f"frames_{index}": rows for index, rows in enumerate(self.frames)}
        names = ("identity", "offsets", "texture", "lights", "log_focals")
        return {name: getattr(self, name) for name in names} | {"sight": self.visibility} | frames


@dataclass(frozen=True, eq=False)
class SequenceScene:
    """Constants of one sequence."""

    timesteps: Int[Tensor, " t"]
    pictures: Pictures
    cameras: CameraBatch
    """Cameras in float32, with the focal length of the initial fit."""
    smoothness: Smoothness
    lens: int | None
    terms: tuple[LandmarkTerm, ...]
    """The landmark term of each row alone, float64."""

    def seen_by(self, row: int) -> list[int]:
        """The cameras that found a face at this row."""
        return self.terms[row].views.camera.tolist()

    def cameras_at(self, log_focals: Float[Tensor, " g"]) -> CameraBatch:
        """The cameras with the given focal lengths. This is differentiable."""
        if self.lens is None:
            return self.cameras
        factor, one = log_focals[self.lens].exp(), log_focals.new_ones(())
        scale = torch.stack([torch.stack([factor, one, one]), torch.stack([one, factor, one]), torch.ones(3)])
        return CameraBatch(self.cameras.K * scale, self.cameras.viewmat)


@dataclass(frozen=True, eq=False)
class PaperScene:
    """All constants of the fit."""

    face_model: FaceModel
    layout: ParameterLayout
    bias: Float[Tensor, "l 3"]
    """Bias of the landmarks (`Subject.bias`), float64."""
    mesh: LitMesh
    used: Float[Tensor, " f"]
    identity: Float[Tensor, " i"]
    """Identity of the initial fit."""
    offset_share: Float[Tensor, "v 1"]
    """1 for vertices that get an offset, 0 for the others."""
    neighbors: tuple[Int[Tensor, " n"], Int[Tensor, " n"], Float[Tensor, "v 1"]]
    """First and second vertices of the pairs along edges, and 1 / number of neighbours of each vertex."""
    sequences: tuple[SequenceScene, ...]
    settings: PaperSettings

    def whitening(
        self, sequence: int, row: int, state: Float[Tensor, " p"], differences: float
    ) -> Float[Tensor, "p p"]:
        """Matrix that turns independent steps into steps of a timestep's parameters.

        A step of 1 is one standard deviation, as far as landmarks and smoothness determine the parameters.
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
        """A camera for pictures of the capture's size, with the given focal lengths."""
        own = self.sequences[sequence]
        cameras, capture = own.cameras_at(log_focals), own.pictures.capture
        return Camera(cameras.K[camera], cameras.viewmat[camera], capture.width, capture.height)


def paper_scene(problem: Problem, fit: Fit, refined: PhotometricFit | None = None) -> PaperScene:
    """The constants of the fit, from a fit to landmarks and, if there is one, a fit to pixels (`refined`)."""
    face_model, layout = problem.model.face_model.to(torch.zeros(())), problem.model.layout
    used = ~face_model.region_mask(*HIDING_REGIONS)
    weights = used.float() if refined is None else used * _trust(face_model, refined)
    mesh = LitMesh(
        face_model.faces.contiguous(), face_model.uv[face_model.uv_faces].contiguous(), weights,
        mesh_edges(face_model.faces, used),
    )  # fmt: skip
    return PaperScene(
        face_model, layout, fit.subject.bias, mesh, weights, fit.subject.identity.float(),
        _offset_share(face_model, everywhere=problem.settings.published), _neighbors(face_model),
        _sequences(problem, fit), problem.settings.paper,
    )  # fmt: skip


def _sequences(problem: Problem, fit: Fit) -> tuple[SequenceScene, ...]:
    scenes = []
    costs = zip(problem.landmark_terms(fit), problem.smoothness(fit), strict=True)
    for (data, sequence), lens, (term, smoothness) in zip(problem.pairs(fit), problem.lenses, costs, strict=True):
        cameras, term = sequence.cameras, quiet_landmarks(term)
        scenes.append(SequenceScene(
            data.timesteps, Pictures(data.capture, 1),
            CameraBatch(cameras.K.float(), cameras.viewmat.float()),
            Smoothness(smoothness.precision.float(), smoothness.linked), lens,
            tuple(term.at(torch.tensor([row])) for row in range(len(sequence.state))),
        ))  # fmt: skip
    return tuple(scenes)


def _trust(face_model: FaceModel, refined: PhotometricFit) -> Float[Tensor, " f"]:
    """Mean trust of each triangle's texels. It is small if pictures contradict each other, as at glasses."""
    trust, count = refined.texture.trust, len(face_model.faces)
    face_index = texture_space(face_model, len(trust)).fragments.face_index.long().flatten()
    face_index = torch.where(face_index < 0, count, face_index)
    texels = torch.bincount(face_index, minlength=count + 1)
    sums = torch.bincount(face_index, weights=trust.flatten().double(), minlength=count + 1)
    return (sums / texels.clamp_min(1))[:count].float()


def first_state(scene: PaperScene, fit: Fit, refined: PhotometricFit | None = None) -> PaperState:
    """The state at the start, from the given fit. Texture and light are even unless there is a fit to pixels."""
    lights = [even_light() for _ in scene.sequences] if refined is None else list(refined.lights)
    lenses = {sequence.lens for sequence in scene.sequences if sequence.lens is not None}
    return PaperState(
        identity=scene.identity.clone(),
        offsets=torch.zeros_like(scene.face_model.template),
        texture=_first_texture(scene.settings.texture_size, refined),
        lights=torch.stack(lights),
        log_focals=torch.zeros(len(lenses)),
        frames=[sequence.state.float() for sequence in fit.sequences],
        visibility=torch.zeros(len(scene.mesh.faces)),
    )


def _first_texture(size: int, refined: PhotometricFit | None) -> Float[Tensor, "th tw 3"]:
    """The texture of the fit to pixels, with the median colour in unknown texels; grey if there is none."""
    texture = torch.full((size, size, 3), 0.5)
    if refined is None or not (refined.texture.trust > 0).any():
        return texture
    albedo, known = refined.texture.albedo, refined.texture.trust > 0
    filled = torch.where(known[..., None], albedo, albedo[known].median(0).values)
    planes = interpolate(filled.movedim(2, 0)[None], (size, size), mode="bilinear", antialias=True)
    return planes[0].movedim(0, 2).contiguous()


def _offset_share(face_model: FaceModel, everywhere: bool) -> Float[Tensor, "v 1"]:
    share = torch.ones(len(face_model.template), 1)
    if everywhere:
        return share
    share[face_model.faces[face_model.region_mask(*_STIFF_REGIONS)].flatten()] = 0
    marks = face_model.landmarks["mediapipe"]
    share[face_model.faces[marks.faces[list(LEFT_IRIS + RIGHT_IRIS)]].flatten()] = 0
    return share


def _neighbors(face_model: FaceModel) -> tuple[Tensor, Tensor, Tensor]:
    edges = mesh_edges(face_model.faces).vertices.long().unique(dim=0)
    first, second = torch.cat([edges, edges.flip(1)]).unbind(1)
    count = torch.zeros(len(face_model.template), 1).index_add(0, first, torch.ones(len(first), 1))
    return first, second, 1 / count.clamp_min(1)
