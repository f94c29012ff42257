"""What native/bind_*.cpp defines. Arrays are contiguous, on the CPU, and float32 unless a comment says otherwise.

Arguments that belong together are passed as one named tuple. Errors name its field: `FaceArrays.rest has the wrong type
or shape`. The same tuple can hold values, or gradients of them; a function's comment says which of its tuples it fills.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

Tensor = torch.Tensor | np.ndarray

# native/bind_mesh.cpp; faces, corners: int64

class Fragments(NamedTuple):
    face_index: Tensor
    """int32, -1 where there is no triangle."""
    barycentric: Tensor
    depth: Tensor

class MeshEdges(NamedTuple):
    """The edges of a mesh, int32: two vertices, one or two triangles, and the vertex opposite in the first of these."""

    vertices: Tensor
    faces: Tensor
    """The second is -1 if there is none."""
    opposite: Tensor

def rasterize_mesh(
    vertices: Tensor, faces: Tensor, K: Tensor, viewmat: Tensor, cull_backfaces: bool, fragments: Fragments
) -> None:
    """Fills `fragments`."""

def interpolate_mesh(
    face_index: Tensor, barycentric: Tensor, attributes: Tensor, corners: Tensor, out: Tensor
) -> None: ...
def sample_texture(texture: Tensor, uv: Tensor, out: Tensor) -> None: ...

class LitSurface(NamedTuple):
    normals: Tensor
    uv: Tensor
    face_weights: Tensor
    texture: Tensor
    light: Tensor

class LossTarget(NamedTuple):
    image: Tensor
    mask: Tensor
    epsilon: float

class LossGradients(NamedTuple):
    points: Tensor
    normals: Tensor
    texture: Tensor
    light: Tensor

def mesh_loss(
    fragments: Fragments,
    points: Tensor,
    faces: Tensor,
    edges: MeshEdges,
    surface: LitSurface,
    target: LossTarget,
    picture: Tensor | None,
    gradients: LossGradients,
) -> tuple[float, float]:
    """Fills `picture`, adds to `gradients`, and returns the sum of the loss and of the weights."""

# native/bind_photometric.cpp; box: left, top, width, height
def photometric_loss(
    box: tuple[int, int, int, int],
    weights: tuple[float, float],
    image: Tensor,
    target: Tensor,
    drawn: Tensor | None,
    gradient: Tensor | None,
    loss: Tensor,
) -> None:
    """Fills `gradient` and `loss` (of no axes). `target` is float32 or uint8."""

# native/bind_rasterize.cpp
class RasterizeFrame: ...

class GaussianArrays(NamedTuple):
    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor

class RasterizeView(NamedTuple):
    gaussians: GaussianArrays
    background: Tensor
    viewmat: Tensor
    K: Tensor
    image: Tensor
    """This and the next two are filled."""
    alpha: Tensor
    radii: Tensor
    """int32."""

class RasterizeGradients(NamedTuple):
    frame: RasterizeFrame
    gaussians: GaussianArrays
    image: Tensor
    alpha: Tensor
    grad_image: Tensor
    grad_alpha: Tensor | None
    grad_gaussians: GaussianArrays
    """This and the next three are filled."""
    grad_means2d: Tensor
    grad_viewmat: Tensor
    grad_K: Tensor

def rasterize_views(views: Sequence[RasterizeView], differentiable: bool) -> list[RasterizeFrame | None]: ...
def rasterize_views_backward(views: Sequence[RasterizeGradients]) -> None: ...
def thread_count() -> int: ...
def set_thread_count(count: int) -> None: ...
def keep_loops_serial(serial: bool) -> None: ...
def rasterize_isa() -> str: ...
def set_rasterize_isa(name: str) -> bool: ...

# native/bind_memory.cpp
def recycled(shape: Sequence[int]) -> torch.Tensor: ...
def recycled_twice(shape: Sequence[int]) -> tuple[torch.Tensor, torch.Tensor]: ...
def release_memory() -> None: ...

# native/bind_rig.cpp; faces, face_index: int64; b timesteps first in vertices, frames and what is in world space
TRIANGLE_FRAME_FLOATS: int

class LocalShapes(NamedTuple):
    means: Tensor
    quats: Tensor
    log_scales: Tensor

class WorldShapes(NamedTuple):
    means: Tensor
    quats: Tensor
    scales: Tensor

def rig_forward(
    vertices: Tensor, faces: Tensor, face_index: Tensor, local: LocalShapes, frames: Tensor, world: WorldShapes
) -> None:
    """Fills `frames` and `world`."""

class RigTopology: ...

def make_rig_topology(vertex_count: int, faces: Tensor, face_index: Tensor) -> RigTopology: ...
def rig_backward(
    topology: RigTopology,
    vertices: Tensor,
    local: LocalShapes,
    frames: Tensor,
    scales: Tensor,
    by_world: WorldShapes,
    gradients: LocalShapes,
    grad_vertices: Tensor | None,
) -> None:
    """Fills `gradients` and `grad_vertices` from `by_world`, the gradients of the Gaussians in world space."""

# native/bind_ride.cpp; one timestep
class Ride: ...

class LocalGaussians(NamedTuple):
    means: Tensor
    quats: Tensor
    log_scales: Tensor
    opacity_logits: Tensor

class PosedGaussians(NamedTuple):
    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    head_pose: Tensor | None

class FaceParameterGradients(NamedTuple):
    expression: Tensor
    joints: Tensor
    head_rotation: Tensor
    head_translation: Tensor

class ChangeArrays(NamedTuple):
    """What changes n Gaussians: activations [f, a] of triangles, bases with r columns, features with two layers."""

    sh: Tensor
    activations: Tensor
    offset_basis: Tensor | None
    color_basis: Tensor | None
    opacity_basis: Tensor | None
    neutral: Tensor | None
    feature_bases: Tensor | None
    weight1: Tensor | None
    weight2: Tensor | None

class ChangedArrays(NamedTuple):
    """Changed coefficients, the changes, and the weighted mean squares of linear changes and of the features'."""

    sh: Tensor
    offset: Tensor | None
    color: Tensor | None
    opacity: Tensor | None
    feature_color: Tensor | None
    feature_opacity: Tensor | None
    linear: Tensor
    features: Tensor

class ByChangedArrays(NamedTuple):
    """The gradients of what `ChangedArrays` holds. Those that are None are 0."""

    sh: Tensor | None
    offset: Tensor | None
    color: Tensor | None
    opacity: Tensor | None
    feature_color: Tensor | None
    feature_opacity: Tensor | None
    linear: Tensor | None
    features: Tensor | None

class ChangeGradients(NamedTuple):
    """`features` is the gradient of `ChangeArrays.neutral`, and the rows of that of `feature_bases`."""

    offset_basis: Tensor | None
    color_basis: Tensor | None
    opacity_basis: Tensor | None
    features: Tensor | None
    weight1: Tensor | None
    weight2: Tensor | None

def ride(
    model: FaceModelData,
    topology: RigTopology,
    in_head: bool,
    face: FaceArrays,
    local: LocalGaussians,
    posed: PosedGaussians,
    changes: ChangeArrays | None = None,
    changed: ChangedArrays | None = None,
    weights: tuple[float, float] = (0, 0),
) -> Ride:
    """Fills `posed` and, with `changes`, `changed`."""

def ride_backward(
    ride: Ride,
    model: FaceModelData,
    topology: RigTopology,
    face: FaceArrays,
    local: LocalGaussians,
    scales: Tensor,
    opacities: Tensor,
    by_posed: PosedGaussians,
    by_local: LocalGaussians,
    by_face: FaceParameterGradients | None,
) -> None:
    """Fills the gradients `by_local` and `by_face` from `by_posed`, the gradients of the posed Gaussians."""

def ride_changes_backward(
    ride: Ride,
    topology: RigTopology,
    changes: ChangeArrays,
    changed: ChangedArrays,
    weights: tuple[float, float],
    by_means: Tensor,
    by_opacity_logits: Tensor,
    by_changed: ByChangedArrays,
    gradients: ChangeGradients,
) -> None:
    """Fills `gradients` from those that `ride_backward` filled, and from `by_changed`."""

# native/bind_training.cpp
class AdamTask(NamedTuple):
    """One tensor. All of its arrays except the gradient are updated."""

    values: Tensor
    gradient: Tensor
    first: Tensor
    second: Tensor
    steps: Tensor
    """Of no axes."""
    rate: float
    frames: int
    """Number of frames that the gradient averages."""

def factored_adam_update(
    values: Tensor,
    rows: list[Tensor],
    columns: list[Tensor],
    places: list[Tensor | None],
    first: Tensor,
    second: Tensor,
    steps: Tensor,
    rate: float,
) -> None:
    """Updates `values`, `first` and `second` [n, k, f], and counts the step.

    The gradient is the sum over all terms of rows [n, f] times columns: the first of [g, k], or those at places [n].
    """

def adam_update(tasks: Sequence[AdamTask | tuple[Any, Any, Any, Any, Any, float]]) -> None: ...
def add_arrays(first: Sequence[Tensor], second: Sequence[Tensor], sums: Sequence[Tensor]) -> None: ...
def triangle_penalties(
    thresholds: tuple[float, float],
    weights: tuple[float, float],
    means: Tensor,
    log_scales: Tensor,
    radii: Tensor,
    grad_means: Tensor,
    grad_log_scales: Tensor,
    position: Tensor,
    scale: Tensor,
) -> None:
    """Fills the last four. `radii` is int32; `position` and `scale` have no axes."""

def observe_view(
    scale: tuple[float, float],
    grad_means2d: Tensor,
    radii: Tensor,
    opacities: Tensor,
    pull: Tensor,
    seen: Tensor,
    radius: Tensor,
    opacity: Tensor,
) -> None:
    """Updates the last four. `radii` and `radius` are int32."""

def keep_on_surface(
    triangle: Tensor,
    limits: Tensor,
    ratio: float,
    means: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    pulls: Tensor | None,
    colors: Tensor,
) -> None:
    """Updates `means`, `quats`, `log_scales` and, with `pulls` [f, 4], `colors` [n, 3].

    `triangle` is int64, and `limits` [f, 5].
    """

def clear_rows(chosen: Tensor, arrays: list[Tensor]) -> None:
    """Updates all arrays [n, ...]. `chosen` [n] is uint8."""

def mean_squared_difference(image: Tensor, target: Tensor) -> float: ...
def absolute_difference(values: Tensor, target: Tensor, weight: float, gradient: Tensor, loss: Tensor) -> None:
    """Fills `gradient` and `loss`. `target` is uint8."""

def color_difference(
    image: Tensor, target: Tensor, counted: Tensor | None, weight: float, free: float, gradient: Tensor, loss: Tensor
) -> None:
    """Fills `gradient` and `loss`. `target` and `counted` are uint8."""

def box_of_nonzero(values: Tensor) -> tuple[int, int, int, int]: ...

# native/bind_composite.cpp; arrays are uint8
def composite(
    image: np.ndarray, matte: np.ndarray, background: Sequence[int], box: Sequence[int], picture: np.ndarray
) -> None:
    """Fills the last one. The box is left, top, width and height."""

# native/bind_face.cpp; b timesteps first
class FaceModelData: ...

class FaceArrays(NamedTuple):
    """The first two have no timesteps, unless they are gradients. Without a head, vertices are in the head frame."""

    rest: Tensor
    joint_rest: Tensor
    expression: Tensor
    joints: Tensor
    head_rotation: Tensor | None
    head_translation: Tensor | None

def make_face_model(
    expression_basis: Tensor,
    pose_basis: Tensor | None,
    rotation_basis: Tensor,
    translation_basis: Tensor,
    skinning_weights: Tensor,
    parents: Sequence[int],
    is_free: Sequence[bool],
) -> FaceModelData: ...
def head_poses(rotation: Tensor, translation: Tensor, transforms: Tensor) -> None: ...
def head_poses_backward(rotation: Tensor, grad_transforms: Tensor, grad_rotation: Tensor) -> None: ...
def compose_rigid(first: Tensor, second: Tensor, out: Tensor) -> None: ...
def compose_rigid_backward(
    first: Tensor, second: Tensor, gradient: Tensor, grad_first: Tensor, grad_second: Tensor
) -> None: ...
def pose_face(model: FaceModelData, face: FaceArrays, shaped: Tensor, vertices: Tensor) -> None:
    """Fills `vertices`, and `shaped`, the vertices before the joints."""

def pose_face_backward(
    model: FaceModelData, face: FaceArrays, shaped: Tensor, grad_vertices: Tensor, gradients: FaceArrays
) -> None:
    """Fills all of `gradients`, one of each per timestep."""

# native/bind_mesh_align.cpp; faces: int64; used: uint8; texel_face: int32; light_equations' sums: float64
class AlignSurface:
    def __init__(
        self,
        faces: Tensor,
        uv: Tensor,
        used: Tensor,
        albedo: Tensor,
        trust: Tensor,
        sigma: float,
        outlier: float,
        least_cosine: float,
    ) -> None: ...

class SightingArrays(NamedTuple):
    vertices: Tensor
    normals: Tensor
    K: Tensor
    viewmat: Tensor
    image: Tensor
    mask: Tensor
    light: Tensor

class AlignDerivatives(NamedTuple):
    jacobian: Tensor
    """Of the vertices in the parameters."""
    hessian: Tensor
    """This and the next are filled."""
    gradient: Tensor

class TextureSums(NamedTuple):
    weight: Tensor
    squares: Tensor
    mixed: Tensor
    image_squares: Tensor

def align_mesh(
    surface: AlignSurface,
    sighting: SightingArrays,
    high_pass: int,
    derivatives: AlignDerivatives | None,
    residual: Tensor | None,
    smooth: Tensor | None,
) -> tuple[float, float]:
    """Returns cost and weight, and fills what is given of the last two."""

def bake_texture(
    surface: AlignSurface, sighting: SightingArrays, texel_face: Tensor, texel_barycentric: Tensor, sums: TextureSums
) -> None:
    """Adds to `sums`."""

def light_equations(surface: AlignSurface, sighting: SightingArrays, hessian: Tensor, right: Tensor) -> None: ...

# native/bind_expression_change.cpp
class FaceActivations: ...

def activation_shape(face: FaceActivations) -> tuple[int, int]:
    """Returns the shape of a table: triangles, or 1 if the face is one region, and activations."""

def make_face_activations(
    rest: Tensor,
    directions: Tensor,
    seen: Tensor,
    shares: Tensor | None,
    head_rest: Tensor | None,
    head_directions: Tensor | None,
    head_seen: Tensor | None,
) -> FaceActivations:
    """Copies the arrays of `mien.runtime.baked.ExpressionChanges`."""

def activation_table(
    face: FaceActivations, expression: Tensor, joints: Tensor, rotation: Tensor, translation: Tensor, out: Tensor
) -> None:
    """Fills `out` with the activations of one face."""

def expression_change(basis: Tensor, activations: Tensor, rows: Tensor | None, out: Tensor) -> None:
    """Fills `out` [n, ..], of a basis [n, .., r] and rows [n] of activations [g, a], the first if there are none."""

# native/bind_activation.cpp; any shape
def sigmoid(values: Tensor, out: Tensor) -> None: ...
def sigmoid_backward(outputs: Tensor, gradient: Tensor, out: Tensor) -> None: ...

# native/bind_feature_network.cpp; n Gaussians, k inputs, f features, x own numbers, h hidden values, o outputs
class FeatureNetwork(NamedTuple):
    neutral: Tensor
    own: Tensor
    weight1: Tensor
    bias1: Tensor
    weight2: Tensor
    bias2: Tensor

class FeatureBases(NamedTuple):
    values: Tensor
    """[n, k, f]"""
    inputs: Tensor
    """[g, k]"""
    rows: Tensor | None
    """[n], the inputs' row of each Gaussian. None stands for the first."""

class FeatureKept(NamedTuple):
    features: Tensor
    """[n, f]"""
    hidden: Tensor
    """[n, h], with h rounded up to a multiple of 16."""

class FeatureGradients(NamedTuple):
    """The gradients of the two outputs, and those that are filled. `features` is also the gradient of `neutral`."""

    outputs: Tensor
    last: Tensor
    features: Tensor
    weight1: Tensor
    bias1: Tensor
    weight2: Tensor
    bias2: Tensor
    inputs: Tensor
    """Of the inputs of all bases, in their order. Empty if it is not wanted."""
    owns: Tensor
    """[n, x], of the Gaussians' own numbers. Without rows if it is not wanted."""

def feature_network(
    network: FeatureNetwork, bases: FeatureBases, kept: FeatureKept | None, outputs: Tensor, last: Tensor
) -> None:
    """Fills `kept`, `outputs` [n, o - 1] and `last` [n]."""

def feature_network_backward(
    network: FeatureNetwork, bases: FeatureBases, kept: FeatureKept, gradients: FeatureGradients
) -> None: ...
def factored_update(
    values: Tensor,
    rows: list[Tensor],
    columns: list[Tensor],
    places: list[Tensor | None],
    second: Tensor,
    weights: Tensor,
    rate: float,
) -> None:
    """Updates `values` [n, k, f], `second` [n, f] and `weights` [n], by a gradient as in `factored_adam_update`."""

# native/bind_point_network.cpp; n points, l layers
class PointLayer(NamedTuple):
    weight: Tensor
    """[o, i]; i counts the outputs of the previous layer, then those of `extra`."""
    bias: Tensor
    activation: int
    """0 none (the last layer), 1 relu, 2 softplus with a sharpness of 100."""
    extra: int
    """0 for the inputs, 1 for the first layer, ..; -1 for none."""

class PointLayerGradients(NamedTuple):
    weight: Tensor
    bias: Tensor

def point_network(layers: Sequence[PointLayer], inputs: Tensor, kept: Tensor | None, outputs: Tensor) -> None:
    """Fills `outputs` [n, o] and `kept`, which has the outputs of each layer but the last, rounded up to 16 numbers."""

def point_network_backward(
    layers: Sequence[PointLayer],
    inputs: Tensor,
    kept: Tensor,
    by_outputs: Tensor,
    gradients: Sequence[PointLayerGradients],
    by_inputs: Tensor | None,
) -> None:
    """Fills `gradients` and `by_inputs`. Points whose row of `by_outputs` is 0 have no gradient."""

# native/bind_skin_points.cpp; n points, b poses, k bones
class SkinPoints(NamedTuple):
    points: Tensor
    moved: Tensor
    weights: Tensor
    from_bones: Tensor
    to_bones: Tensor

class SkinPointsGradients(NamedTuple):
    """The gradient of the posed points, and those that are filled."""

    posed: Tensor
    points: Tensor
    moved: Tensor
    weights: Tensor
    to_bones: Tensor

def skin_points(points: SkinPoints, posed: Tensor) -> None:
    """Fills `posed` [b, n, 3]."""

def skin_points_backward(points: SkinPoints, gradients: SkinPointsGradients) -> None: ...

# native/bind_baked_points.cpp; n points

class RawPoints(NamedTuple):
    changes: Tensor
    """[n, 11]: log scales, quaternion, opacity logit, colour."""
    log_scales: Tensor
    quats: Tensor
    opacity_logits: Tensor
    colors: Tensor

class ActivatedPoints(NamedTuple):
    """Filled."""

    scales: Tensor
    quats: Tensor
    opacities: Tensor
    sh: Tensor

def add_bone(shaped: Tensor, weights: Tensor, transform: Tensor, posed: Tensor) -> None:
    """Adds to `posed` [n, 3] what a bone that is no joint of the face contributes; `transform` is [3, 4]."""

def activate_points(raw: RawPoints, gain: float, offset: float, out: ActivatedPoints) -> None: ...
