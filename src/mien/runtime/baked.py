"""Baked avatars: the records that `mien.avatar.Avatar.bake` returns and that .mien files hold, as numpy arrays.

They are a small closed family, so that exporters, the web and game engines read them without knowing the method. The
Gaussians' centres move with a mesh (`MeshBound`), move by their own blend directions and skinning weights
(`BlendSkinned`), or do not move at all (`Static`). Their attributes are constant, or depend on the expression linearly
(`LinearBases`), through a few activations (`ExpressionChanges`) or through a small network (`AttributeNetwork`).
`mien.runtime.posing` is the reference implementation of posing. Files hold the names of these classes and of their
fields, so neither can change.

Letters in shapes mean the same in the whole file: n Gaussians, m points of the rig, f triangles, e expressions, k
joints, j free joints, p pose correctives (9 per free joint), s SH coefficients per channel, r activations or directions
of the face, q of the head's pose, g regions of the face, a activations of one Gaussian, c of these that bases take, w
features, i inputs (e expression coefficients, then 3 j angles).
`mien.runtime.checks` compares arrays with these letters.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float32, Int32


@dataclass(frozen=True, eq=False)
class Rig:
    """m points of one person that move like a face model's vertices (`FaceModel.head_vertices`), identity applied."""

    template: Float32[np.ndarray, "m 3"]
    """Rest positions in the head frame, in metres."""
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
class FeatureDirections:
    """Few directions of the face, along which features change. The face's inputs are many more.

    The inputs are the expression coefficients, followed by the axis-angle vectors of the free joints, in radians. Each
    row of `basis` is weighted by one entry of (inputs - rest) directions.
    """

    rest: Float32[np.ndarray, " i"]
    """Inputs at which features do not change: the person at rest."""
    directions: Float32[np.ndarray, "i r"]
    basis: Float32[np.ndarray, "n r w"]
    """Change of the features of each Gaussian per unit along each direction."""


@dataclass(frozen=True, eq=False)
class AttributeNetwork:
    """A small network, the same for all Gaussians. Its outputs are added to the raw values.

    Its input is a row of `base` with an addition. With `features`, the changes of `along` are added to the first w
    columns. With `displacement`, the centre's motion from the rig's template is appended, in metres.
    """

    input: Literal["features", "displacement"]
    base: Float32[np.ndarray, "n _"]
    weights: tuple[Float32[np.ndarray, "_ _"], ...]
    """Weights of each layer, [out, in]."""
    biases: tuple[Float32[np.ndarray, " _"], ...]
    activation: Literal["relu", "leaky_relu", "softplus"]
    """Activation between layers. The slope of leaky_relu is 0.01."""
    outputs: tuple[str, ...]
    """Names out of quats, log_scales, opacity_logits and sh, in the order of the last layer's columns."""
    along: FeatureDirections | None = None
    """Changes of the features along directions of the face. None with `displacement`."""


@dataclass(frozen=True, eq=False)
class FeatureChanges:
    """Changes of the first SH coefficient and of the raw opacity, from blended features through two layers.

    The features are `neutral`, plus `basis` weighted by the activations. They and `own` are the input of the network,
    whose hidden layer has leaky ReLU with the slope 0.01. Its outputs are three changes of colour, then one of opacity.
    """

    neutral: Float32[np.ndarray, "n w"]
    """Features of each Gaussian."""
    basis: Float32[np.ndarray, "n a w"]
    """Change of the features per unit of each activation."""
    own: Float32[np.ndarray, "n _"]
    """Numbers of each Gaussian that go into the network after its features."""
    weights: tuple[Float32[np.ndarray, "_ _"], ...]
    """Weights of both layers, [out, in]."""
    biases: tuple[Float32[np.ndarray, " _"], ...]


@dataclass(frozen=True, eq=False)
class HeadActivations:
    """Activations of the head's pose, by how far the head moved from its pose at rest: six numbers.

    They are the sines of its turns about its own axes there, (R - R^T) / 2 of its rotation R, and its shift along these
    axes, in metres. `_native.activation_table` computes them. `directions` and `seen` are as in `ExpressionChanges`.
    """

    rest: Float32[np.ndarray, " 6"]
    """Axis-angle vector of the head at rest, in radians, and its place, in metres."""
    directions: Float32[np.ndarray, "6 q"]
    seen: Float32[np.ndarray, "_ q"]


@dataclass(frozen=True, eq=False)
class ExpressionChanges:
    """Changes of the raw values with the expression, of low rank. A part that is None does not change.

    The activations of the face are (inputs - rest) directions: r/g for each of g regions, one region after the other.
    Let x be those of a region, and d their length. The furthest that a row of `seen` goes along them is
    l = max (seen x) / d. If d is beyond l, they are shortened to the length l + m o / (m + o), with o = d - l and
    m = l / 10. `_native.activation_table` computes this.

    A triangle has the sum of the regions' activations weighted by `shares`, and those of the head's pose. A Gaussian
    has the activations of its triangle: one of the face and one of the head in turn, as long as there are both.
    """

    rest: Float32[np.ndarray, " i"]
    """Inputs of the person at rest: expression coefficients, then axis-angle vectors of the free joints, in radians."""
    directions: Float32[np.ndarray, "i r"]
    seen: Float32[np.ndarray, "_ r"]
    """Activations that are allowed: those of training frames that go furthest along one of these, and a fifth
    more. They are 0 outside of one region. No rows shorten nothing."""
    color: Float32[np.ndarray, "n 3 c"] | None = None
    """Changes of the first SH coefficient per unit of each activation."""
    opacity_logits: Float32[np.ndarray, "n c"] | None = None
    means: Float32[np.ndarray, "n 3 c"] | None = None
    """Changes of the centres, in the triangle's frame and units."""
    features: FeatureChanges | None = None
    """Further changes of colours and opacities."""
    basis_columns: int | None = None
    """Number of columns c of colour, opacity_logits and means, which a Gaussian's first c activations weight. None if
    they have all a."""
    shares: Float32[np.ndarray, "f g"] | None = None
    """Share of each region in each triangle; the sum is 1. None if the whole face is one region."""
    head: HeadActivations | None = None


@dataclass(frozen=True, eq=False)
class MeshBound:
    """Gaussians in the frames of a mesh's triangles."""

    rig: Rig
    """The mesh's vertices."""
    faces: Int32[np.ndarray, "f 3"]
    face_index: Int32[np.ndarray, " n"]
    """Index into `faces` for each Gaussian."""
    means: Float32[np.ndarray, "n 3"]
    """Centres in the triangle's frame and units, like the scales and rotations in `attributes`."""
    attributes: Attributes
    sh_frame: Literal["world", "head"]
    """Frame of the view direction for spherical harmonics."""
    changes: ExpressionChanges | None = None
    """Changes with the expression, beside those that the mesh makes."""


@dataclass(frozen=True, eq=False)
class BlendSkinned:
    """Gaussians that each have their own blend directions and skinning weights."""

    rig: Rig
    """The Gaussians' own centres."""
    attributes: Attributes
    scale_activation: Literal["exp", "sigmoid"] = "exp"
    scale_gain: float = 1.0
    """With `sigmoid`: scale = gain * sigmoid(raw) + offset, in metres."""
    scale_offset: float = 0.0
    color_activation: Literal["sh", "sigmoid"] = "sh"
    """With `sigmoid`: the only SH coefficient is the logit of the colour."""
    bases: LinearBases | None = None
    network: AttributeNetwork | None = None
    still_weights: Float32[np.ndarray, " n"] | None = None
    """Skinning weights of one more bone, which stands still in the world while the head moves. It comes with
    `still_pose`."""
    still_pose: Float32[np.ndarray, "4 4"] | None = None
    """Head pose (T_world_head) at which this bone moves no points."""


@dataclass(frozen=True, eq=False)
class Static:
    """Gaussians that do not move in the head frame."""

    means: Float32[np.ndarray, "n 3"]
    """Centres in the head frame, in metres."""
    attributes: Attributes
    expression_names: tuple[str, ...]
    joint_names: tuple[str, ...] = ()
    """Free joints, in the order of the inputs of the network's `along`."""
    bases: LinearBases | None = None
    network: AttributeNetwork | None = None


BakedAvatar = MeshBound | BlendSkinned | Static


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

    def square(self, side: int) -> "Camera":
        """The same view in a square picture, which holds the whole picture of this camera in its middle."""
        scale = side / max(self.width, self.height)
        K = self.K * np.array([[scale], [scale], [1.0]], np.float32)
        K[:2, 2] += (side - scale * np.array([self.width, self.height], np.float32)) / 2
        return Camera(K, self.viewmat, side, side)


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
class Filmed:
    """The part of all expressions and head poses that training saw. Driving stays softly inside (`runtime/filmed.py`).

    The inputs are the expression coefficients, followed by the axis-angle vectors of the free joints, in radians.
    """

    lowest: Float32[np.ndarray, " i"]
    """Smallest value of each input in the training frames."""
    highest: Float32[np.ndarray, " i"]
    head_angles: Float32[np.ndarray, "2 2"]
    """Yaw and pitch of the camera as the head sees it, each from the lowest to the highest, in radians. Yaw is positive
    to the subject's left, pitch upwards."""


@dataclass(frozen=True, eq=False)
class PortableAvatar:
    """Everything that a program needs to pose and show an avatar."""

    baked: BakedAvatar
    expression_names: tuple[str, ...]
    expression_bounds: Float32[np.ndarray, "e 2"]
    """Range of each expression that the face model can show. Equal bounds mean that the expression does nothing."""
    joint_names: tuple[str, ...]
    """Names of the free joints."""
    neutral: Neutral
    camera: Camera
    """The camera that the avatar was trained with: a good first view."""
    about: About
    filmed: Filmed | None = None
    """What training saw of the face. None if it is not known."""
    confidence: Float32[np.ndarray, " f"] | None = None
    """How often and how squarely the training pictures show each triangle of the face model, from 0 (never, so it is
    completed) to 1. With w the sum, over the frames, of c^2 s(5 c - 0.5) v m, it is s(w), and 0 if w is at most 0.001.

    c is the cosine between the triangle's normal and the direction to the camera, at least 0; v the share that the
    mesh's own depth leaves visible, m the share in the scoring mask, and s(x) = x^2 (3 - 2 x) with x limited to 0..1
    (`coverage` in `mien.training.footage`). None if it is not known. `MeshBound` avatars have the same triangles in
    `faces`."""
