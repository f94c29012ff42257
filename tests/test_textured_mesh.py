"""The textured mesh follows its formulas: surfels that cover triangles, light by normals, and offsets of vertices."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from known import known
from mien.avatar.avatar import move_avatar
from mien.avatar.settings import Progress
from mien.avatar.textured_mesh.avatar import OVERLAP, TexturedMesh
from mien.avatar.textured_mesh.settings import TexturedMeshConfig
from mien.avatar.textured_mesh.surfels import Neighbours, Surfels, place_surfels
from mien.face import FaceModel, FaceParams
from mien.face.mirror import triangle_geometry
from mien.render import rasterize
from mien.rotation import matrix_from_quaternion
from mono_avatars import pictured
from plain_settings import plain_textured_mesh
from toy_scene import rgb_from_sh, toy_camera, toy_face, toy_face_model

PLAIN = plain_textured_mesh()


def new_avatar(
    config: TexturedMeshConfig = PLAIN, model: FaceModel | None = None, disturbed: float = 0.0
) -> TexturedMesh:
    torch.manual_seed(0)
    avatar = TexturedMesh(config, model or toy_face_model(), toy_face(5))
    with torch.no_grad():
        for name, parameter in avatar.named_parameters():
            size = 0.01 if "means" in name else 0.3
            parameter.add_(disturbed * size * torch.randn(parameter.shape))
    return avatar


def at_rest(avatar: TexturedMesh) -> FaceParams:
    """The subject without expression, whose mesh is that of `rest_vertices`."""
    subject = avatar.subject
    zero = {name: torch.zeros_like(getattr(subject, name)) for name in ("expression", "joints", "head_rotation")}
    return replace(subject, **zero)


def colors(avatar: TexturedMesh, face: FaceParams) -> Tensor:
    return rgb_from_sh(avatar.pose(face).gaussians.sh)[..., 0, :]


def plane_model(cells: int = 5) -> FaceModel:
    """A flat sheet of 0.2 m in the head's xy plane, towards +z, whose triangles have many shapes and sizes."""
    torch.manual_seed(1)
    steps = torch.linspace(-0.1, 0.1, cells + 1)
    sheet = torch.stack([*torch.meshgrid(steps, steps, indexing="xy"), torch.zeros(cells + 1, cells + 1)], -1)
    shifts = 2 * torch.rand(2, cells + 1, cells + 1).movedim(0, -1) - 1
    sheet[1:-1, 1:-1, :2] += 0.35 * 0.2 / cells * shifts[1:-1, 1:-1]
    corner = (torch.arange(cells)[:, None] * (cells + 1) + torch.arange(cells)).flatten()
    right, up = corner + 1, corner + cells + 1
    faces = torch.cat([torch.stack([corner, right, up + 1], 1), torch.stack([corner, up + 1, up], 1)])
    template = sheet.flatten(0, 1)
    v = len(template)
    return replace(
        toy_face_model(), template=template, faces=faces, uv=torch.zeros(v, 2), uv_faces=faces,
        face_regions=torch.zeros(len(faces), dtype=torch.long), identity_basis=torch.zeros(2, v, 3),
        expression_basis=torch.zeros(2, v, 3), skinning_weights=torch.eye(3)[:1].repeat(v, 1),
    )  # fmt: skip


def test_surfels_cover_equal_areas_and_follow_offsets_exactly() -> None:
    model = plane_model()
    bound = place_surfels(model.template, model.faces, 3000)
    assert len(bound) == pytest.approx(3000, rel=0.05)
    own = triangle_geometry(model.template, model.faces)[1] / torch.bincount(bound)
    assert own.max() / own.min() < 1.4
    assert torch.bincount(place_surfels(model.template, model.faces, 1)).tolist() == [1] * len(model.faces)
    avatar = new_avatar(disturbed=1.0)
    model, face, bound = avatar.face_model, at_rest(avatar), avatar.store["face_index"]
    posed = avatar.pose(face)
    corners = (model.rest_vertices(face) + posed.aux["offsets"])[model.faces]
    surfels = Surfels(bound, len(model.faces), model.template)
    torch.testing.assert_close(posed.gaussians.means, surfels.at_corners(corners), atol=1e-6, rtol=0)
    # A surfel's covariance is that of its part of the triangle, twice and a half as wide along each axis.
    parts = (corners - corners.mean(1, keepdim=True))[bound] * surfels.shares()[:, None, None]
    expected = OVERLAP**2 * parts.transpose(1, 2) @ parts / 12
    turns, scales = matrix_from_quaternion(posed.gaussians.quats), posed.gaussians.scales
    found = turns @ torch.diag_embed((scales * torch.tensor([1, 0, 1])) ** 2) @ turns.transpose(1, 2)
    torch.testing.assert_close(found, expected, atol=1e-8, rtol=1e-3)


def picture(avatar: TexturedMesh) -> tuple[Tensor, Tensor]:
    """Alpha of the sheet from an oblique view, and which pixels are well inside it."""
    camera, turn = toy_camera(128), torch.tensor([[0.3, 0.5, 0.1]])
    face = replace(at_rest(avatar), head_rotation=turn, head_translation=torch.tensor([[0.0, 0.0, -0.4]]))
    alpha = rasterize(avatar.pose(face).gaussians.timestep(0), camera, torch.ones(3)).alpha.detach()
    local = camera.in_frame(face.T_world_head[0])
    y, x = torch.meshgrid(torch.arange(128) + 0.5, torch.arange(128) + 0.5, indexing="ij")
    pixels = torch.stack([x, y, torch.ones_like(x)], dim=-1)
    eye, rays = local.position, pixels @ torch.linalg.inv(camera.K).T @ local.viewmat[:3, :3]
    at = eye - rays * (eye[2] / rays[..., 2:])
    return alpha, (at[..., :2].abs() < 0.09).all(-1) & (rays[..., 2] * eye[2] < 0)


@pytest.mark.unchecked
@pytest.mark.parametrize(("surfels", "least"), [(1, 0.95), (400, 0.99)])
def test_surfels_cover_the_mesh(surfels: int, least: float) -> None:
    """Nothing shows through, also after vertices have moved far, but a little beside very uneven surfels."""
    avatar = new_avatar(replace(PLAIN, surfels=surfels, smoothing=0), plane_model())
    alpha, inside = picture(avatar)
    assert inside.float().mean() > 0.1
    assert alpha[inside].min() > least
    with torch.no_grad():
        avatar.vertex_means[:] = avatar.face_model.template * torch.tensor([0.5, 0.1, 0])
    stretched, _ = picture(avatar)
    assert stretched.sum() > 1.2 * alpha.sum()
    assert stretched[inside].min() > least - 0.01


def test_teeth_and_eyes_stay_and_offsets_and_colours_are_averaged_over_neighbours() -> None:
    model = toy_face_model()
    v = len(model.template)
    matrix = torch.zeros(v, v, dtype=torch.float64)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        matrix[model.faces[:, a], model.faces[:, b]] = matrix[model.faces[:, b], model.faces[:, a]] = 1
    matrix = matrix / matrix.sum(1, keepdim=True).clamp_min(1)
    avatar = new_avatar(replace(PLAIN, smoothing=3), disturbed=1.0)
    smooth = torch.linalg.matrix_power((torch.eye(v) + matrix.float()) / 2, 3)
    offsets = avatar.get_buffer("movable") * (smooth @ avatar.vertex_means)
    torch.testing.assert_close(avatar.averaged(), (offsets, smooth @ avatar.vertex_albedo))
    model = toy_face_model()
    regions = torch.zeros(len(model.faces), dtype=torch.long)
    regions[:20], regions[20:25], regions[-20:] = 1, 2, 3
    model = replace(model, region_names=("skin", "teeth", "mouth", "eyes"), face_regions=regions)
    offsets = new_avatar(model=model, disturbed=1.0).averaged()[0]
    outer = torch.zeros(len(offsets), dtype=torch.bool)
    outer[model.faces[regions == 0].flatten()] = True
    assert len(model.faces[regions != 0].unique()) > 20
    assert torch.equal((offsets != 0).any(1), outer)


def test_a_color_is_albedo_times_light_on_the_normal_in_the_frame_of_the_light() -> None:
    avatar = new_avatar(model=plane_model())
    torch.testing.assert_close(colors(avatar, at_rest(avatar)), torch.full((len(avatar.store), 3), 0.5))
    with torch.no_grad():
        avatar.store["albedo"][:] = torch.tensor([0.25, 0.5, 0.75]).logit()
        avatar.light[:] = 0
        # Light 1 + z of the first channel, 1 + x of the second, 3 z^2 - 1 of the third.
        avatar.light[0, :2] = math.sqrt(4 * math.pi)
        avatar.light[2, 0] = avatar.light[3, 1] = math.sqrt(4 * math.pi / 3)
        avatar.light[6, 2] = math.sqrt(16 * math.pi / 5)
    expected = torch.tensor([0.25 * 2, 0.5, 0.75 * 2]).expand(len(avatar.store), 3)
    torch.testing.assert_close(colors(avatar, at_rest(avatar)), expected)
    # A slope bends the normal along the triangle's first edge.
    with torch.no_grad():
        avatar.store["slopes"][:, 0] = 0.75
    edges = (avatar.face_model.template[avatar.face_model.faces[:, :2]].diff(dim=1)[:, 0])[avatar.store["face_index"]]
    x, z = 0.6 * edges[:, 0] / edges.norm(dim=1), 0.8
    expected = torch.stack([0.25 * (1 + z + 0 * x), 0.5 * (1 + x), 0.75 * (3 * z**2 - 1) + 0 * x], dim=-1)
    torch.testing.assert_close(colors(avatar, at_rest(avatar)), expected)
    # A head that turns keeps its colours: the light is that of the face at rest.
    turned = replace(at_rest(avatar), head_rotation=torch.tensor([[0.0, math.pi / 2, 0.0]]))
    torch.testing.assert_close(colors(avatar, turned), expected)


def test_gradients_are_those_of_finite_differences() -> None:
    avatar = new_avatar(disturbed=0.3)
    double = torch.zeros((), dtype=torch.float64)
    move_avatar(avatar, double)
    face, some_picture = toy_face(5)[1].to(double), pictured(len(avatar.store))

    def loss() -> Tensor:
        torch.manual_seed(2)
        posed = avatar.pose(face)
        values = [getattr(posed.gaussians, name) for name in ("means", "scales", "sh")]
        terms = [(torch.randn_like(one) * one).sum() for one in (*values, posed.gaussians.quats.square())]
        return torch.stack([*avatar.regularizers(posed, some_picture, Progress(1, 2)).values(), *terms]).sum()

    loss().backward()
    for group in avatar.parameter_groups():
        for name, tensor in group.tensors.items():
            direction, ends = torch.randn_like(tensor), []
            for move in (1e-7, -2e-7, 1e-7):
                with torch.no_grad():
                    tensor.add_(move * direction)
                    ends.append(loss())
            slope = (known(tensor.grad) * direction).sum()
            torch.testing.assert_close(slope, (ends[0] - ends[1]) / 2e-7, rtol=1e-4, atol=1e-6, msg=name)


def test_penalties_are_of_rough_offsets_and_albedo_and_of_bent_normals_and_of_light_that_is_not_white() -> None:
    avatar = new_avatar(disturbed=1.0)
    losses = avatar.regularizers(avatar.pose(toy_face(5)[1]), pictured(len(avatar.store)), Progress(1, 2))
    near, store = Neighbours(avatar.face_model.template, avatar.face_model.faces), avatar.store
    offsets, albedo = avatar.averaged()
    rough = [(x - near.means(x)).square().sum() / len(x) for x in (1000 * offsets, albedo)]
    detail, slopes = (store[name].square().sum() / len(store) for name in ("albedo", "slopes"))
    white = torch.tensor([math.sqrt(4 * math.pi), *[0.0] * 8])[:, None]
    expected = {
        "offsets": 0.02 * rough[0],
        "albedo": 0.003 * (rough[1] + detail),
        "normals": 0.01 * slopes,
        "light": 0.01 * (avatar.light - white).square().mean(),
    }
    torch.testing.assert_close(losses, expected)
