"""What native/bind_*.cpp defines. Arrays are contiguous, on the CPU, float32 unless said otherwise."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

Tensor = torch.Tensor | np.ndarray

# native/bind_mesh.cpp; faces, corners: int64; face_index: int32
def rasterize_mesh(
    vertices: Tensor,
    faces: Tensor,
    K: Tensor,
    viewmat: Tensor,
    cull_backfaces: bool,
    face_index: Tensor,
    barycentric: Tensor,
    depth: Tensor,
) -> None: ...
def interpolate_mesh(
    face_index: Tensor, barycentric: Tensor, attributes: Tensor, corners: Tensor, out: Tensor
) -> None: ...

# native/bind_mesh_gradients.cpp; gradients of points and light: float64; edges: int32. All are added to but those of
# barycentrics, uv and images, which are written.
def barycentric_backward(
    face_index: Tensor,
    barycentric: Tensor,
    depth: Tensor,
    points: Tensor,
    faces: Tensor,
    grad_barycentric: Tensor,
    grad_points: Tensor,
) -> None: ...
def interpolate_mesh_backward(
    face_index: Tensor,
    barycentric: Tensor,
    attributes: Tensor,
    corners: Tensor,
    grad_out: Tensor,
    grad_attributes: Tensor | None,
    grad_barycentric: Tensor | None,
) -> None: ...
def sample_texture(texture: Tensor, uv: Tensor, out: Tensor) -> None: ...
def sample_texture_backward(
    texture: Tensor, uv: Tensor, grad_out: Tensor, grad_texture: Tensor | None, grad_uv: Tensor | None
) -> None: ...
def antialias(
    face_index: Tensor,
    barycentric: Tensor,
    depth: Tensor,
    points: Tensor,
    faces: Tensor,
    edge_vertices: Tensor,
    edge_faces: Tensor,
    opposite: Tensor,
    image: Tensor,
    out: Tensor,
) -> None: ...
def antialias_backward(
    face_index: Tensor,
    barycentric: Tensor,
    depth: Tensor,
    points: Tensor,
    faces: Tensor,
    edge_vertices: Tensor,
    edge_faces: Tensor,
    opposite: Tensor,
    image: Tensor,
    grad_out: Tensor,
    grad_image: Tensor,
    grad_points: Tensor,
) -> None: ...
def mesh_loss(
    face_index: Tensor,
    barycentric: Tensor,
    depth: Tensor,
    points: Tensor,
    faces: Tensor,
    edge_vertices: Tensor,
    edge_faces: Tensor,
    opposite: Tensor,
    normals: Tensor,
    uv: Tensor,
    face_weights: Tensor,
    texture: Tensor,
    light: Tensor,
    target: Tensor,
    mask: Tensor,
    epsilon: float,
    picture: Tensor | None,
    grad_points: Tensor,
    grad_normals: Tensor,
    grad_texture: Tensor,
    grad_light: Tensor,
) -> tuple[float, float]: ...

# native/bind_photometric.cpp; box: left, top, width, height; pictures: image, target (float32 or uint8), what is drawn
# or None, gradient or None, loss (of no axes)
def photometric_loss(box: tuple[int, int, int, int], weights: tuple[float, float], *pictures: Any) -> None: ...

# native/bind_rasterize.cpp; radii: int32
class RasterizeFrame: ...

def rasterize_forward(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    background: Tensor,
    viewmat: Tensor,
    K: Tensor,
    image: Tensor,
    alpha: Tensor,
    radii: Tensor,
) -> RasterizeFrame | None: ...
def rasterize_views(views: list[tuple[Any, ...]], differentiable: bool) -> list[RasterizeFrame | None]: ...
def rasterize_views_backward(views: list[tuple[Any, ...]]) -> None: ...
def thread_count() -> int: ...
def set_thread_count(count: int) -> None: ...
def rasterize_isa() -> str: ...
def set_rasterize_isa(name: str) -> bool: ...

# native/bind_memory.cpp
def recycled(shape: Sequence[int]) -> torch.Tensor: ...

# native/bind_rig.cpp; faces, face_index: int64; b timesteps first in vertices, frames and what is in world space
TRIANGLE_FRAME_FLOATS: int

def rig_forward(
    vertices: Tensor,
    faces: Tensor,
    face_index: Tensor,
    local_means: Tensor,
    local_quats: Tensor,
    log_scales: Tensor,
    frames: Tensor,
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
) -> None: ...

class RigTopology: ...

def make_rig_topology(vertex_count: int, faces: Tensor, face_index: Tensor) -> RigTopology: ...
def rig_backward(
    topology: RigTopology,
    vertices: Tensor,
    local_means: Tensor,
    local_quats: Tensor,
    log_scales: Tensor,
    frames: Tensor,
    scales: Tensor,
    grad_means: Tensor,
    grad_quats: Tensor,
    grad_scales: Tensor,
    grad_local_means: Tensor,
    grad_local_quats: Tensor,
    grad_log_scales: Tensor,
    grad_vertices: Tensor | None,
) -> None: ...

# native/bind_ride.cpp; one timestep. What `ride_backward` takes is what `ride` took, and the gradients
class Ride: ...

def ride(model: FaceModelData, topology: RigTopology, *arrays: Any) -> Ride: ...
def ride_backward(ride: Ride, model: FaceModelData, topology: RigTopology, *arrays: Any) -> None: ...

# native/bind_training.cpp; radii, radius: int32; a task: values, gradient, first, second, steps (of no axes), rate; the
# penalties' arrays: means, log_scales, radii, grad_means, grad_log_scales, position, scale (the last two of no axes); a
# view's arrays: grad_means2d, radii, opacities, then the statistics pull, seen, radius, opacity
def adam_update(tasks: Sequence[tuple[Any, Any, Any, Any, Any, float]]) -> None: ...
def triangle_penalties(thresholds: tuple[float, float], weights: tuple[float, float], *arrays: Any) -> None: ...
def observe_view(scale: tuple[float, float], *arrays: Any) -> None: ...
def mean_squared_difference(image: Tensor, target: Tensor) -> float: ...
def box_of_nonzero(values: Tensor) -> tuple[int, int, int, int]: ...

# native/bind_face.cpp; b timesteps first in all but rest and joint_rest
class FaceModelData: ...

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
def pose_face(
    model: FaceModelData,
    rest: Tensor,
    joint_rest: Tensor,
    expression: Tensor,
    joints: Tensor,
    head_rotation: Tensor | None,
    head_translation: Tensor | None,
    shaped: Tensor,
    vertices: Tensor,
) -> None: ...
def pose_face_backward(
    model: FaceModelData,
    rest: Tensor,
    joint_rest: Tensor,
    expression: Tensor,
    joints: Tensor,
    head_rotation: Tensor | None,
    head_translation: Tensor | None,
    shaped: Tensor,
    grad_vertices: Tensor,
    grad_rest: Tensor,
    grad_joint_rest: Tensor,
    grad_expression: Tensor,
    grad_joints: Tensor,
    grad_head_rotation: Tensor,
    grad_head_translation: Tensor,
) -> None: ...

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

def align_mesh(
    surface: AlignSurface,
    vertices: Tensor,
    normals: Tensor,
    K: Tensor,
    viewmat: Tensor,
    image: Tensor,
    mask: Tensor,
    light: Tensor,
    high_pass: int,
    jacobian: Tensor | None,
    hessian: Tensor | None,
    gradient: Tensor | None,
    residual: Tensor | None,
    smooth: Tensor | None,
) -> tuple[float, float]: ...
def bake_texture(
    surface: AlignSurface,
    vertices: Tensor,
    normals: Tensor,
    K: Tensor,
    viewmat: Tensor,
    image: Tensor,
    mask: Tensor,
    light: Tensor,
    texel_face: Tensor,
    texel_barycentric: Tensor,
    weight: Tensor,
    squares: Tensor,
    mixed: Tensor,
    image_squares: Tensor,
) -> None: ...
def light_equations(
    surface: AlignSurface,
    vertices: Tensor,
    normals: Tensor,
    K: Tensor,
    viewmat: Tensor,
    image: Tensor,
    mask: Tensor,
    light: Tensor,
    hessian: Tensor,
    right: Tensor,
) -> None: ...

# native/bind_activation.cpp; any shape
def sigmoid(values: Tensor, out: Tensor) -> None: ...
def sigmoid_backward(outputs: Tensor, gradient: Tensor, out: Tensor) -> None: ...
