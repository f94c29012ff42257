"""Tracking: the face model fitted to a capture."""

from dataclasses import dataclass, field

from jaxtyping import Bool, Float
from torch import Tensor

from mien.camera import Camera
from mien.face import FaceParams


@dataclass(frozen=True, eq=False)
class Looks:
    """What a fit to pixels found out about the subject's skin, and about the light of one sequence."""

    texture: Float[Tensor, "th tw 3"]
    """Albedo, by the face model's texture coordinates: a colour (0..1, sRGB) is albedo times light."""
    trust: Float[Tensor, "th tw"]
    """0 where a texel is not known; less than 1 where pictures contradict each other."""
    light: Float[Tensor, "9 3"]
    """SH coefficients over world-space normals (`mien.render.mesh.shade`)."""
    sigma: float
    """Expected difference between the colours of a picture and of the model."""
    light_extent: float
    """Metres on the face over which a smooth difference counts as light that the model does not explain."""


@dataclass(frozen=True, eq=False)
class Tracking:
    """Face parameters and cameras of one sequence of t timesteps and c cameras.

    With one camera of unknown place the world frame is the camera's with y up and z backward (viewmat =
    diag(1, -1, -1, 1)): a face that looks into the camera has a head rotation of about zero. Calibrated cameras stay in
    the world that they were given in.
    """

    face_model: str
    """Name, for `mien.face.load_face_model`."""
    face_model_hash: str
    """`FaceModel.content_hash` it was fitted with."""
    face: FaceParams
    """All t timesteps; where `valid` is False, interpolated from the neighbours."""
    valid: Bool[Tensor, " t"]
    """Some camera found a face."""
    cameras: tuple[Camera, ...]
    """One a camera_id, for pictures of the capture's size."""
    neck_lines: Float[Tensor, "t c 3"]
    """(a, b, d) with a^2 + b^2 = 1: pixels with a x + b y + d >= 0 are above the neck line, and kept."""
    residuals: Float[Tensor, "t c"]
    """Median distance of landmarks from their fit, pixels; NaN where the camera found no face."""
    pixel_residuals: Float[Tensor, "t c"] | None = None
    """Root mean square by which colours differ from the texture that all pictures share, 0..1, outliers faded; NaN
    where pixels were no help and landmarks alone decided. None: pixels were not looked at."""
    looks: Looks | None = None
    """How the model looks; None: pixels were not looked at, or gave nothing."""
    settings: dict = field(default_factory=dict)
    """How it was made, for the report."""
