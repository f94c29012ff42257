"""The cost of the pixels and landmarks of one sequence, with its normal equations."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mien import _native
from mien.machine.parallel import map_in_threads
from mien.tracking.fitting.fit import Subject
from mien.tracking.fitting.parameters import ParameterLayout
from mien.tracking.fitting.solver import NormalEquations, SharedEquations
from mien.tracking.fitting.views import CameraBatch
from mien.tracking.landmarks.term import LandmarkTerm
from mien.tracking.pixels.outcome import LEAST_PIXELS
from mien.tracking.pixels.pictures import Pictures
from mien.tracking.pixels.surface import PosedSurface, SurfaceModel, equations_of_pictures
from mien.tracking.pixels.texture import SurfaceView


@dataclass(frozen=True, eq=False)
class PhotometricTerm:
    """Costs of the v timesteps of one sequence: pixels, landmarks, and the prior.

    The cost of a picture is a robust mean over its pixels (native/mesh_align.h), so it does not depend on their number.
    """

    model: SurfaceModel
    landmarks: LandmarkTerm
    pictures: Pictures
    timesteps: Int[Tensor, " v"]
    """Timesteps of the capture."""
    surface: "_native.AlignSurface"
    """The texture and its trust."""
    light: Float[Tensor, "9 3"]
    light_radius: int
    """Radius in pixels over which a smooth difference counts as light."""
    weight: float
    """Weight of the pixels of a picture."""
    sigma: float
    """Expected difference between a colour of the picture and of the texture."""

    @property
    def layout(self) -> ParameterLayout:
        """Layout of the timesteps' parameters."""
        return self.model.layout

    def equations(
        self, state: Float[Tensor, "v p"], rows: Int[Tensor, " k"], subject: Subject, cameras: CameraBatch
    ) -> NormalEquations:
        """The normal equations of some timesteps, each on its own, with the shared parameters fixed."""
        pixels = self._pixel_equations(state, rows, subject, cameras, shared=False)
        marks = self.landmarks.at(rows).equations(state[rows], subject, cameras)
        return marks.plus(pixels)

    def costs(self, state: Float[Tensor, "v p"], subject: Subject, cameras: CameraBatch) -> Float[Tensor, " v"]:
        """The cost of each timestep."""

        def of_row(row: int) -> float:
            posed = self.model.pose(state[row], subject.identity, derive=False)
            return sum(self._align(posed, row, camera, cameras)[0] for camera in self.landmarks.views.seen_by(row))

        pixels = torch.tensor(map_in_threads(of_row, list(range(len(state)))), dtype=torch.float64)
        return self.landmarks.cost(state, subject, cameras) + self.weight * pixels

    def residuals(self, state: Float[Tensor, "v p"], subject: Subject, cameras: CameraBatch) -> Float[Tensor, "v c"]:
        """Robust root mean square of the colour differences; NaN where too few pixels of a camera were compared."""
        residuals = torch.full((len(state), len(cameras)), torch.nan)

        def of_row(row: int) -> None:
            posed = self.model.pose(state[row], subject.identity, derive=False)
            for camera in self.landmarks.views.seen_by(row):
                picture = self.pictures.picture(int(self.timesteps[row]), camera, cameras)
                seen = SurfaceView(posed, picture, self.light).arrays()
                cost, weight = _native.align_mesh(self.surface, seen, self.light_radius, None, None, None)
                if weight >= LEAST_PIXELS:
                    residuals[row, camera] = self.sigma * cost**0.5

        map_in_threads(of_row, list(range(len(state))))
        return residuals

    def joint_equations(
        self, state: Float[Tensor, "v p"], rows: Int[Tensor, " k"], subject: Subject, cameras: CameraBatch
    ) -> tuple[NormalEquations, SharedEquations]:
        """The equations of timesteps and of the shared parameters: `Subject.shared`, logarithm of the focal length."""
        marks, shared = self.landmarks.at(rows).joint_equations(state[rows], subject, cameras)
        pixels = self._pixel_equations(state, rows, subject, cameras, shared=True)
        own, of_pixels = pixels.split(state.shape[1], subject.columns_of_pixels, len(subject.shared) + 1)
        return marks.plus(own), shared.plus(of_pixels)

    def _pixel_equations(
        self, state: Float[Tensor, "v p"], rows: Int[Tensor, " k"], subject: Subject, cameras: CameraBatch, shared: bool
    ) -> NormalEquations:
        views = self.landmarks.views
        return equations_of_pictures(
            self.model, views, state, rows, subject, cameras, self.weight, self._align, shared=shared
        )

    def _align(
        self, posed: PosedSurface, row: int, camera: int, cameras: CameraBatch
    ) -> tuple[float, Float[Tensor, " s"], Float[Tensor, "s s"]]:
        """Cost of one picture, half its gradient and half its Hessian. Both are empty without a Jacobian."""
        size = 0 if posed.jacobian is None else posed.jacobian.shape[2]
        gradient, hessian = torch.empty(size), torch.empty(size, size)
        jacobian = posed.jacobian
        derivatives = None if jacobian is None else _native.AlignDerivatives(jacobian, hessian, gradient)
        picture = self.pictures.picture(int(self.timesteps[row]), camera, cameras)
        seen = SurfaceView(posed, picture, self.light).arrays()
        cost, _ = _native.align_mesh(self.surface, seen, self.light_radius, derivatives, None, None)
        return cost, gradient.double(), hessian.double()
