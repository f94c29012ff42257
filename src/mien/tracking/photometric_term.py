"""The cost of pixels and landmarks of one sequence, with its normal equations."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mien import _native
from mien.tracking.landmark_term import LandmarkTerm, Subject
from mien.tracking.parameters import ParameterLayout
from mien.tracking.photometric_pictures import Picture, Pictures
from mien.tracking.photometric_surface import SurfaceModel
from mien.tracking.photometric_texture import Sighting
from mien.tracking.photometric_threads import in_threads
from mien.tracking.solver import NormalEquations, SharedEquations
from mien.tracking.views import CameraBatch


@dataclass(frozen=True, eq=False)
class PhotometricTerm:
    """Costs of the v timesteps of one sequence: pixels, landmarks, and the prior."""

    model: SurfaceModel
    landmarks: LandmarkTerm
    pictures: Pictures
    timesteps: Int[Tensor, " v"]
    """Of the capture."""
    surface: "_native.AlignSurface"
    """Texture and robust scale."""
    light: Float[Tensor, "9 3"]
    offsets: Float[Tensor, "v 3"] | None
    high_pass: int
    """Radius in pixels of what counts as light."""
    weight: float
    """Independent pixels a picture."""

    @property
    def layout(self) -> ParameterLayout:
        return self.model.layout

    def equations(self, state: Float[Tensor, "v p"], subject: Subject, cameras: CameraBatch) -> NormalEquations:
        """Of each timestep on its own, the shared parameters fixed."""
        rows = torch.arange(len(state))
        found = self._photometric(state, rows, subject, cameras, shared=False)
        marks = self.landmarks.equations(state, subject, cameras)
        if True: print("   photo %.1f marks %.2f" % (found.cost.mean(), marks.cost.mean()))
        return NormalEquations(
            marks.cost + found.cost, marks.gradient + found.gradient, marks.hessian + found.hessian
        )

    def joint_equations(
        self, state: Float[Tensor, "v p"], rows: Int[Tensor, " k"], subject: Subject, cameras: CameraBatch
    ) -> tuple[NormalEquations, SharedEquations]:
        """Of some timesteps, and of what they share: identity, then the logarithm of the focal length."""
        p = state.shape[1]
        marks, shared = self.landmarks.at(rows).joint_equations(state[rows], subject, cameras)
        found = self._photometric(state, rows, subject, cameras, shared=True)
        print("   keyframes photo %.1f marks %.2f" % (found.cost.mean(), marks.cost.mean()))
        own = NormalEquations(
            marks.cost + found.cost, marks.gradient + found.gradient[:, :p], marks.hessian + found.hessian[:, :p, :p]
        )
        return own, SharedEquations(
            shared.across + found.hessian[:, :p, p:],
            shared.hessian + found.hessian[:, p:, p:].sum(0),
            shared.gradient + found.gradient[:, p:].sum(0),
        )

    def _photometric(
        self, state: Float[Tensor, "v p"], rows: Int[Tensor, " k"], subject: Subject, cameras: CameraBatch, shared: bool
    ) -> NormalEquations:
        pictures = self.landmarks.views

        def of_row(row: int) -> NormalEquations:
            posed = self.model.pose(state[row], subject.identity, self.offsets, derive_identity=shared)
            jacobian = posed.jacobian
            assert jacobian is not None
            seen_by = pictures.camera[pictures.row == row].tolist()
            if shared:
                jacobian = torch.cat([jacobian, _by_log_focal(posed.vertices, cameras, seen_by)], dim=2).contiguous()
            size = jacobian.shape[2]
            cost, gradient, hessian = 0.0, torch.zeros(size).double(), torch.zeros(size, size).double()
            for camera in seen_by:
                picture = self.pictures.picture(int(self.timesteps[row]), camera, cameras)
                by_picture, by_picture_twice = torch.empty(size), torch.empty(size, size)
                value, _ = _native.align_mesh(
                    self.surface, *Sighting(posed, picture, self.light).arguments(), self.high_pass, jacobian,
                    by_picture_twice, by_picture, None, None,
                )  # fmt: skip
                cost, gradient, hessian = cost + value, gradient + by_picture, hessian + by_picture_twice
            return NormalEquations(
                torch.tensor([cost * self.weight]).double(), gradient[None] * self.weight, hessian[None] * self.weight
            )

        parts = in_threads(of_row, rows.tolist())
        return NormalEquations(
            torch.cat([part.cost for part in parts]),
            torch.cat([part.gradient for part in parts]),
            torch.cat([part.hessian for part in parts]),
        )


def _by_log_focal(
    vertices: Float[Tensor, "v 3"], cameras: CameraBatch, seen_by: list[int]
) -> Float[Tensor, "v 3 1"]:
    """How vertices would have to move across the sight to be seen as through a longer lens."""
    if len(seen_by) != 1:
        return torch.zeros(len(vertices), 3, 1)  # several cameras are calibrated
    viewmat = cameras.viewmat[seen_by[0]].float()
    in_camera = vertices @ viewmat[:3, :3].T + viewmat[:3, 3]
    in_camera[:, 2] = 0
    return (in_camera @ viewmat[:3, :3])[..., None]
