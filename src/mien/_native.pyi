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

# native/bind_photometric.cpp; target: float32 or uint8; box: left, top, width, height
def photometric_loss(
    image: Tensor,
    target: Tensor,
    box: tuple[int, int, int, int],
    l1_weight: float,
    ssim_weight: float,
    gradient: Tensor | None,
) -> float: ...
