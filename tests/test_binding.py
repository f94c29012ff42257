"""Gaussians belong to the triangle that they lie on, and change to it without a change of the person at rest."""

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from mien.adam import Moments
from mien.avatar import GaussianAvatarsConfig
from mien.avatar.bound_surface import SurfacePrior
from mien.avatar.gaussian_avatars.avatar import GaussianAvatars
from mien.avatar.ops.binding import Binding, barycentric, squared_distances
from mien.avatar.ops.regions import vertex_motions
from mien.avatar.ops.triangle_frames import bind_to_world, triangle_frames
from mien.face import FaceModel
from mien.face.head_parts import head_parts
from mien.rotation import matrix_from_quaternion
from mien.training.whole_head.rigid_parts import carrier_of, rigid_gaussians
from toy_scene import rgb_from_sh, surface_of, toy_face, toy_face_model


def sheet() -> tuple[Tensor, Tensor]:
    """A flat sheet of 5 x 5 rectangles in a square of 5 cm, and one triangle on its back."""
    side, places = 5, torch.tensor([0.0, 0.007, 0.016, 0.028, 0.037, 0.05])
    grid = torch.cartesian_prod(places, places)
    vertices = torch.cat([grid, torch.zeros(len(grid), 1)], 1)
    corner = torch.cartesian_prod(torch.arange(side), torch.arange(side)) @ torch.tensor([side + 1, 1])
    up, right = corner + 1, corner + side + 1
    front = torch.cat([torch.stack([corner, up, right], 1), torch.stack([up, right + 1, right], 1)])
    return vertices, torch.cat([front, front[-1:].flip(1)])


def gaussians_on(vertices: Tensor, faces: Tensor, count: int) -> dict[str, Tensor]:
    """Gaussians around the middle of triangles in the sheet's middle."""
    random = torch.Generator().manual_seed(0)
    middles = vertices[faces].mean(1)
    inner = ((middles[:, :2] > 0.015) & (middles[:, :2] < 0.035)).all(1).nonzero()[:, 0]
    return {
        "face_index": inner[torch.randint(len(inner), (count,), generator=random)],
        "means": 1.1 * (2 * torch.rand(count, 3, generator=random) - 1),
        "quats": normalize(torch.randn(count, 4, generator=random), dim=1),
        "log_scales": torch.randn(count, 3, generator=random),
        "offset_basis": torch.randn(count, 3, 2, generator=random),
    }


def placed(store: dict[str, Tensor], vertices: Tensor, faces: Tensor) -> tuple[Tensor, ...]:
    """Centres, shapes and shifts of centres in the sheet's coordinates."""
    local = [store[name] for name in ("means", "quats", "log_scales")]
    index = store["face_index"]
    means, quats, scales = bind_to_world(vertices, faces, index, *local)
    moved = [local[0] + store["offset_basis"][..., column] for column in range(2)]
    shifts = [bind_to_world(vertices, faces, index, one, *local[1:])[0] - means for one in moved]
    axes = matrix_from_quaternion(quats) * scales[:, None]
    return means, axes @ axes.mT, *shifts


def toy_avatar() -> GaussianAvatars:
    torch.manual_seed(0)
    return GaussianAvatars(GaussianAvatarsConfig(), toy_face_model(), toy_face(5))


def test_gaussians_change_to_the_triangle_below_them_and_stay_where_they_are() -> None:
    vertices, faces = sheet()
    store = gaussians_on(vertices, faces, 400)
    before, one_kind = placed(store, vertices, faces), torch.zeros(len(faces), dtype=torch.long)
    binding = Binding(vertices, faces, one_kind)
    changed = []
    for _ in range(4):
        bound = store["face_index"].clone()
        binding.renew(store, None, ["offset_basis"])
        changed.append(int((store["face_index"] != bound).sum()))
    assert changed[0] > 200 > 0 == changed[-1]
    for own, expected in zip(placed(store, vertices, faces), before, strict=True):
        torch.testing.assert_close(own, expected, atol=1e-6, rtol=1e-4)
    inside = barycentric(before[0], vertices[faces[store["face_index"]]]).amin(1)
    assert inside.min() > -0.06
    assert int(store["face_index"].max()) < len(faces) - 1  # the back


def test_gaussians_keep_to_triangles_of_their_kind() -> None:
    vertices, faces = sheet()
    store = gaussians_on(vertices, faces, 400)
    middles = vertices[faces].mean(1)
    kinds = (middles[:, 0] > 0.025).long() - 2 * (middles[:, 1] > 0.03).long()
    bound = store["face_index"].clone()
    Binding(vertices, faces, kinds).renew(store)
    changed = store["face_index"] != bound
    assert int(changed.sum()) > 100
    torch.testing.assert_close(kinds[store["face_index"]], kinds[bound])
    assert kinds[bound[changed]].min() == 0, "none below 0"


@pytest.mark.parametrize("limit", [None, 0, 1, 2, 3])
def test_gaussians_stay_where_the_new_triangle_forbids_them(limit: int | None) -> None:
    """The limits are the lowest and the highest place, and the largest thickness and width."""
    vertices, faces = sheet()
    store = gaussians_on(vertices, faces, 400)
    bound, limits = store["face_index"].clone(), torch.tensor([[-2.0, 2.0, 9.0, 9.0, 1.0]]).repeat(len(faces), 1)
    if limit is not None:
        limits[:, limit] = 0
    local = torch.cat([store["means"][:, 1:2], store["log_scales"]], 1)
    Binding(vertices, faces, torch.zeros(len(faces), dtype=torch.long)).renew(store, limits)
    changed = store["face_index"] != bound
    low, thick, wide = local[:, 0], local[:, 2], local[:, [1, 3]].amax(1)
    forbidden = {None: low > 9, 0: low < -0.3, 1: low > 0.3, 2: thick > 0.9, 3: wide > 0.9}[limit]
    assert not bool((changed & forbidden).any())
    assert int(changed.sum()) > 60


def test_distances_from_triangles_are_those_of_a_dense_cover() -> None:
    random = torch.Generator().manual_seed(0)
    corners, points = torch.randn(50, 3, 3, generator=random), 2 * torch.randn(50, 3, generator=random)
    weights = torch.distributions.Dirichlet(torch.ones(3)).sample((20_000,))
    covered = torch.einsum("kc,ncx->nkx", torch.cat([weights, torch.eye(3)]), corners)
    least = (covered - points[:, None]).square().sum(-1).amin(1)
    found = squared_distances(points, corners)
    assert bool((found <= least + 1e-5).all())
    torch.testing.assert_close(found, least, atol=0.02, rtol=0.02)


def test_an_avatar_binds_anew_where_it_is_kept_to_the_surface() -> None:
    for limited, filled in ((False, False), (True, False), (False, True)):
        torch.manual_seed(0)
        avatar = GaussianAvatars(GaussianAvatarsConfig(surface_limits=limited), toy_face_model(), toy_face(5))
        store = avatar.store
        with torch.no_grad():
            store["means"].normal_()[:, 1] *= 0.1
            store["log_scales"].fill_(-4.0)
        before, index = avatar.pose(avatar.subject).gaussians.means, store["face_index"].clone()
        none = torch.zeros(len(avatar.face_model.faces), dtype=torch.bool)
        surface_of(avatar).renew_binding(SurfacePrior(torch.zeros(len(none)), filled_in=none if filled else None))
        assert bool((store["face_index"] != index).any()) == (limited or filled)
        torch.testing.assert_close(avatar.pose(avatar.subject).gaussians.means, before, atol=1e-5, rtol=1e-4)


def test_the_optimiser_knows_gradients_in_the_new_frames() -> None:
    """The gradients of one loss before and after are each other's, by the first moments, and so are their squares."""
    vertices, faces = sheet()
    store = gaussians_on(vertices, faces, 400)

    def gradients() -> dict[str, Tensor]:
        own = {name: value.clone().requires_grad_() for name, value in store.items() if name != "face_index"}
        moved = own["means"] + own["offset_basis"].sum(2)
        index = store["face_index"]
        means, quats, _ = bind_to_world(vertices, faces, index, moved, own["quats"], own["log_scales"])
        loss = (means @ torch.tensor([1.0, 2.0, 3.0])).sum() + matrix_from_quaternion(quats)[:, 0, 1].sum()
        loss.backward()
        return {name: value.grad for name, value in own.items() if value.grad is not None}

    moments = {name: Moments(grad, grad.square(), torch.zeros(())) for name, grad in gradients().items()}
    Binding(vertices, faces, torch.zeros(len(faces), dtype=torch.long)).renew(store, None, ["offset_basis"], moments)
    for name, grad in gradients().items():
        torch.testing.assert_close(moments[name].first, grad, atol=1e-5, rtol=1e-3)
        assert moments[name].second.min() >= 0
        squares = moments[name].second.flatten(1).sum(1), grad.square().flatten(1).sum(1)
        torch.testing.assert_close(*squares, atol=1e-5, rtol=1e-3)


def test_shifts_that_undo_the_motion_of_the_mesh_are_seen() -> None:
    avatar = toy_avatar()
    surface, model = surface_of(avatar), avatar.face_model
    vertices = [model.head_vertices(toy_face(5)[timestep])[0] for timestep in range(5)]
    share, own = torch.linspace(0, 1, len(avatar.store)), surface.triangles()
    posed = []
    for corners in vertices:
        frames = triangle_frames(corners, model.faces)
        undone = -share[:, None] * (frames.T - triangle_frames(vertices[0], model.faces).T)[own]
        local = (frames.R.mT[own] @ undone[..., None])[..., 0] / frames.k[own, None]
        posed.append((corners, {"offset_basis": local}))
    found, motion = surface.counter_motion(posed)
    moving = motion > 1e-3
    assert 20 < int(moving.sum()) < len(share)
    torch.testing.assert_close(found[moving], share[moving], atol=1e-4, rtol=0)


def test_what_is_carried_stays_where_it_is_in_every_face() -> None:
    """A triangle that would be left without Gaussians gets a fill."""
    avatar = toy_avatar()
    store, surface, model = avatar.store, surface_of(avatar), avatar.face_model
    vertices, count = model.head_vertices(avatar.subject)[0], len(model.faces)
    middles = vertices[model.faces].mean(1)
    top, low = (
        int((middles[:, 1] - middles[:, 2]).argmax()),
        (-middles[:, 1] - middles[:, 2]).argsort(descending=True)[:6].flip(0),
    )
    store.append(low[:3], {})  # these triangles have two each
    with torch.no_grad():
        store["means"].normal_(std=0.2)
    none = torch.zeros(count, dtype=torch.bool)
    prior = SurfacePrior(torch.zeros(count), colors=torch.full((count, 3), 0.7), filled_in=none, carrier=top)
    before = avatar.pose(avatar.subject).gaussians.means[low]
    with torch.no_grad():
        store["offset_basis"].normal_()
    lost = surface.carry(low, prior)
    assert lost.nonzero()[:, 0].tolist() == sorted(low[:3].tolist())
    fills = low[3:]
    torch.testing.assert_close(rgb_from_sh(store["sh_constant"][fills, 0]), torch.full((3, 3), 0.7))
    store.select(~lost)
    surface.renew_binding(prior)
    surface.keep_to(prior)
    assert surface.triangles()[-6:].tolist() == [top] * 6
    for face in (avatar.subject, *(toy_face(5)[timestep] for timestep in range(5))):
        # The toy's jaw moves its crown by micrometres, and the way to the chin is long.
        torch.testing.assert_close(avatar.pose(face).gaussians.means[-6:], before, atol=2e-4, rtol=0)


def test_a_rigid_part_is_many_gaussians_beside_each_other(anny: FaceModel, monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    face = anny.neutral()
    avatar = GaussianAvatars(GaussianAvatarsConfig(), anny, face)
    surface, n = surface_of(avatar), len(avatar.store)
    middles = anny.head_vertices(face)[0][anny.faces].mean(1)
    parts = head_parts(anny)
    nose = int((middles[:, 2] - 100 * (~parts.face).float()).argmax())
    near = (middles - middles[nose]).norm(dim=1).argsort()[:150]
    scattered = torch.randperm(n)[: n // 10]
    none = torch.zeros(n, dtype=torch.bool)
    for chosen, least, most in ((near, 100, 200), (near[:40], 0, 0), (scattered, 0, 0)):
        undone = torch.zeros(n).index_fill(0, chosen, 0.5)
        monkeypatch.setattr(surface, "counter_motion", lambda posed, undone=undone: (undone, torch.ones(n)))
        rigid = rigid_gaussians(avatar, surface, [face], none)
        assert least <= len(rigid) <= most  # those beside the border of a group count, too
        assert len(rigid) < 2 or float((middles[rigid] - middles[nose]).norm(dim=1).max()) < 0.03
    carrier = carrier_of(anny, face, anny.head_vertices(face)[0], ~none)
    assert carrier is not None
    assert bool(parts.scalp[carrier])
    still = vertex_motions(anny, face)[:, anny.faces[carrier].long()]
    assert float(still.abs().max()) < 1e-6
