"""The content of a .mien file as numpy arrays. `mien.avatar.baked` has the same classes and fields with tensors.

Letters in shapes mean the same in the whole file: n Gaussians, m points of the rig, f triangles, e expressions, k
joints, j free joints, p pose correctives (9 per free joint), s SH coefficients per channel.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float32, Int32


@dataclass(frozen=True, eq=False)
class Rig:
    """m points of one person, in the head frame, that move with expression and joints. Identity is applied."""

    template: Float32[np.ndarray, "m 3"]
    """Rest positions in metres."""
    expression_names: tuple[str, ...]
    expression_basis: Float32[np.ndarray, "e m 3"]
    joint_names: tuple[str, ...]
    joint_parents: tuple[int, ...]
    """Index of each joint's parent, -1 for the head. Parents come before children."""
    joint_free: tuple[bool, ...]
    joint_template: Float32[np.ndarray, "k 3"]
    joint_rotation_basis: Float32[np.ndarray, "e k 3"]
    joint_translation_basis: Float32[np.ndarray, "e k 3"]
    skinning_weights: Float32[np.ndarray, "m k"]
    pose_basis: Float32[np.ndarray, "p m 3"] | None = None


@dataclass(frozen=True, eq=False)
class Attributes:
    """Raw values of n Gaussians, independent of how the Gaussians are bound."""

    quats: Float32[np.ndarray, "n 4"]
    log_scales: Float32[np.ndarray, "n 3"]
    opacity_logits: Float32[np.ndarray, " n"]
    sh: Float32[np.ndarray, "n s 3"]


@dataclass(frozen=True, eq=False)
class LinearBases:
    """Changes of the raw values per unit of each expression coefficient. None means no change."""

    means: Float32[np.ndarray, "e n 3"] | None = None
    log_scales: Float32[np.ndarray, "e n 3"] | None = None
    opacity_logits: Float32[np.ndarray, "e n"] | None = None
    sh: Float32[np.ndarray, "e n s 3"] | None = None


@dataclass(frozen=True, eq=False)
class AttributeNetwork:
    """A small network, the same for all Gaussians. Its outputs are added to the raw values."""

    input: Literal["features", "displacement"]
    base: Float32[np.ndarray, "n _"]
    basis: Float32[np.ndarray, "_ n _"]
    weights: tuple[Float32[np.ndarray, "_ _"], ...]
    biases: tuple[Float32[np.ndarray, " _"], ...]
    activation: Literal["relu", "leaky_relu", "softplus"]
    outputs: tuple[str, ...]
    joint_basis: Float32[np.ndarray, "_ n _"] | None = None


@dataclass(frozen=True, eq=False)
class MeshBound:
    """Gaussians in the frames of a mesh's triangles (method: gaussian_avatars)."""

    rig: Rig
    faces: Int32[np.ndarray, "f 3"]
    face_index: Int32[np.ndarray, " n"]
    means: Float32[np.ndarray, "n 3"]
    attributes: Attributes
    sh_frame: Literal["world", "head"]


@dataclass(frozen=True, eq=False)
class BlendSkinned:
    """Gaussians that each have their own blend directions and skinning weights (method: mono_gaussian_avatar)."""

    rig: Rig
    attributes: Attributes
    scale_activation: Literal["exp", "sigmoid"] = "exp"
    scale_gain: float = 1.0
    scale_offset: float = 0.0
    colour_activation: Literal["sh", "sigmoid"] = "sh"
    bases: LinearBases | None = None
    network: AttributeNetwork | None = None


@dataclass(frozen=True, eq=False)
class Static:
    """Gaussians that do not move in the head frame (method: headgas)."""

    means: Float32[np.ndarray, "n 3"]
    attributes: Attributes
    expression_names: tuple[str, ...]
    joint_names: tuple[str, ...] = ()
    bases: LinearBases | None = None
    network: AttributeNetwork | None = None


Baked = MeshBound | BlendSkinned | Static


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with OpenCV axes (+x right, +y down, +z forward). Pixel centres are at +.5."""

    K: Float32[np.ndarray, "3 3"]
    """Intrinsics in pixels."""
    viewmat: Float32[np.ndarray, "4 4"]
    """T_camera_world, in metres."""
    width: int
    """Width in pixels."""
    height: int
    """Height in pixels."""

    def resized(self, width: int, height: int) -> "Camera":
        """The same view with another resolution."""
        scale = np.array([[width / self.width], [height / self.height], [1.0]], np.float32)
        return Camera(self.K * scale, self.viewmat, width, height)


@dataclass(frozen=True, eq=False)
class Neutral:
    """The person at rest, as training estimated it. Expressions start from here."""

    expression: Float32[np.ndarray, " e"]
    joints: Float32[np.ndarray, "j 3"]
    """Axis-angle vectors of the free joints, in radians."""
    head_rotation: Float32[np.ndarray, " 3"]
    """Axis-angle vector of the head frame in world space, in radians."""
    head_translation: Float32[np.ndarray, " 3"]
    """Origin of the head frame in world space, in metres."""


@dataclass(frozen=True)
class About:
    """The origin of an avatar."""

    name: str
    """Name of the subject."""
    method: str
    face_model: str
    face_model_hash: str
    licence: str
    """Licence of the face model's data. A part of these data is in the file."""
    mien: str
    """Version of mien that wrote the file."""


@dataclass(frozen=True, eq=False)
class PortableAvatar:
    """Everything that a program needs to pose and show an avatar."""

    baked: Baked
    expression_names: tuple[str, ...]
    expression_bounds: Float32[np.ndarray, "e 2"]
    """Range of each expression that the face model can show. Equal bounds mean that the expression does nothing."""
    joint_names: tuple[str, ...]
    """Names of the free joints."""
    neutral: Neutral
    camera: Camera
    """The camera that the avatar was trained with: a good first view."""
    about: About
