"""What native/bind_*.cpp defines. Arrays are contiguous, on the CPU, float32 unless said otherwise."""

from torch import Tensor

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
