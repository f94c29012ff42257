"""The surface that an avatar's Gaussians are bound to: what is known of it, and what training may do with it.

Methods that bind Gaussians to triangles of the face model have a `BoundSurface` (`Avatar.surface`). Parts of a training
that close a head, move its hair or fill its mouth work on it alone, and never know the method.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor

FILL_OPACITY = 0.97  # opacity of a fill

_FILL_HEIGHT_SHARE = 0.9
"""Height of a fill as a share of the hair's. Hair is thinner at its outline, and a higher fill stands out beyond it.
Measured: 0.5 has 0.2 dB more at 30 degrees and 0.3 less at 90, and 1 has 0.2 dB less at 30 (log, 11-24)."""


@dataclass(frozen=True, eq=False)
class SurfacePrior:
    """Knowledge of each of the f triangles of a head without training: from the mesh, the mattes and symmetry."""

    hair: Float[Tensor, " f"]
    """Height of hair along the triangle's normal, in metres; 0 on skin that no hair hangs over."""
    hanging: Float[Tensor, " f"] | None = None
    """How far hair that hangs beside skin and neck stands out along the normal, in metres. None means 0."""
    colors: Float[Tensor, "f 3"] | None = None
    """Colours, 0..1, completed where no picture shows any. None if nothing was completed."""
    doubt: Float[Tensor, " f"] | None = None
    """0 for triangles that pictures show well, 1 for those that none shows. None if nothing was completed."""
    filled_in: Bool[Tensor, " f"] | None = None
    """Triangles that are filled rather than trained: no picture shows them, and they are above the cut at the neck."""
    closed: Bool[Tensor, " f"] | None = None
    """Triangles that are an opaque surface before the first step: the made-up ones, and the inside of the mouth, which
    is trained where pictures show it. None if these are the made-up ones."""
    strands: Bool[Tensor, " f"] | None = None
    """Made-up triangles that are covered with strands of hair. None means none."""
    widening: Float[Tensor, " f"] | None = None
    """Factors on the limits to the surface (`BoundSurface.keep_to`), for parts that the mesh fits less well. None
    means 1."""

    @property
    def fill_height(self) -> Float[Tensor, " f"]:
        """Height at which a fill lies above its triangle, in metres."""
        return _FILL_HEIGHT_SHARE * self.hair


class BoundSurface(ABC):
    """Operations of training on Gaussians that are bound to the f triangles of a face model, between two steps."""

    @abstractmethod
    def triangles(self) -> Int[Tensor, " n"]:
        """The triangle that each Gaussian is bound to."""

    @property
    @abstractmethod
    def wants_first_colors(self) -> bool:
        """Whether `set_first_colors` is to be called before the first step."""

    @abstractmethod
    def set_first_colors(self, colors: Float[Tensor, "v 3"]) -> None:
        """Take the face model's vertices' mean colours in the training pictures, 0..1, as first colours."""

    @property
    @abstractmethod
    def limited(self) -> bool:
        """Whether `keep_to` is to be called after each step, also if nothing is filled."""

    @abstractmethod
    def close(self, prior: SurfacePrior) -> None:
        """Start from what is known of the surface, before the first step: colours, and fills of what nothing shows."""

    @abstractmethod
    def keep_to(self, prior: SurfacePrior) -> None:
        """Bring Gaussians back that have left what is known of the surface, after each step."""

    @abstractmethod
    def restore(self, rows: Int[Tensor, " k"], prior: SurfacePrior, *, close: bool) -> None:
        """Give some Gaussians the completed colours of their triangles.

        With `close`, they also get place, shape and opacity of fills, as at the start.
        """

    @abstractmethod
    def height_gradient(self) -> Float[Tensor, " f"] | None:
        """Derivative of the loss by the height of each triangle's Gaussians above it, per metre, after a backward pass.

        It is the sum over the triangle's Gaussians. None if there is none.
        """

    @abstractmethod
    def raise_by(self, shift: Float[Tensor, " f"]) -> None:
        """Move Gaussians along the normals of their triangles, by metres."""

    @abstractmethod
    def change_penalty(self, changes: Mapping[str, Tensor], held: Bool[Tensor, " f"]) -> Float[Tensor, ""] | None:
        """The method's own penalty of changes with the expression that the mesh does not make (`Posed.aux`).

        It is the mean over all Gaussians, to which those on triangles that are not `held` add 0. None if there are no
        changes.

        Args:
            changes: The changes of one timestep.
            held: The triangles whose changes cost something.
        """

    @abstractmethod
    def fill_interior(self, chosen: Bool[Tensor, " f"], opacity: float, colors: Float[Tensor, "f 3"]) -> None:
        """Close the surface of those of the chosen triangles that are less than half opaque.

        The number of Gaussians does not change.

        Args:
            chosen: Triangles that may be closed.
            opacity: Opacity of closed triangles.
            colors: Their colours, 0..1.
        """
