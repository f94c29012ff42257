"""The differentiable mesh operations in plain PyTorch, for any dtype. The native ones are tested against them."""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from mien.render.mesh import MeshFragments, interpolate_reference, shade
from mien.render.mesh_gradients import LitMesh, MeshEdges


def barycentrics_reference(
    fragments: MeshFragments, points: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]
) -> Float[Tensor, "h w 3"]:
    """Barycentrics of the fragments' triangles, computed from image points and clamped at 0."""
    covered = fragments.face_index >= 0
    rows, columns = covered.nonzero().unbind(1)
    pixels = torch.stack([columns + 0.5, rows + 0.5, torch.ones(len(rows))], dim=-1).to(points)
    a, b, c = points[faces[fragments.face_index[covered].long()]].unbind(1)
    volumes = [(torch.linalg.cross(p, q) * pixels).sum(-1) for p, q in ((b, c), (c, a), (a, b))]
    weights = torch.stack(volumes, dim=-1)
    weights = weights * torch.sign(weights.detach().sum(-1, keepdim=True))
    weights = torch.where(fragments.barycentric[covered] > 0, weights, torch.zeros_like(weights)).clamp_min(0)
    out = points.new_zeros(*covered.shape, 3)
    return out.masked_scatter(covered[..., None], weights / weights.sum(-1, keepdim=True))


def sample_texture_reference(texture: Float[Tensor, "th tw c"], uv: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n c"]:
    """Reference of `mien.render.mesh.sample_texture`."""
    grid = torch.stack([2 * uv[..., 0] - 1, 1 - 2 * uv[..., 1]], dim=-1).reshape(1, 1, -1, 2)
    sampled = grid_sample(
        texture.permute(2, 0, 1)[None], grid, mode="bilinear", padding_mode="border", align_corners=False
    )
    return sampled[0, :, 0].T.reshape(*uv.shape[:-1], -1)


def antialias_reference(
    image: Float[Tensor, "h w c"],
    fragments: MeshFragments,
    points: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    edges: MeshEdges,
) -> Float[Tensor, "h w c"]:
    """Reference of `mien.render.mesh_gradients.antialias`."""
    inner, outer, position = _crossings(fragments, points, faces, edges)
    beyond = position - 0.5
    changed, other = torch.where(beyond > 0, outer, inner), torch.where(beyond > 0, inner, outer)
    flat = image.flatten(0, 1)
    return flat.index_add(0, changed, beyond.abs()[:, None] * (flat[other] - flat[changed])).view(image.shape)


def mesh_loss_reference(
    fragments: MeshFragments,
    points: Float[Tensor, "v 3"],
    normals: Float[Tensor, "v 3"],
    mesh: LitMesh,
    texture: Float[Tensor, "th tw 3"],
    light: Float[Tensor, "9 3"],
    target: tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"], float],
) -> tuple[Float[Tensor, ""], Float[Tensor, "h w 3"]]:
    """Reference of `mien.render.mesh_gradients.mesh_loss`; also returns the drawn picture."""
    image, mask, epsilon = target
    seen = MeshFragments(fragments.face_index, barycentrics_reference(fragments, points, mesh.faces), fragments.depth)
    corners = torch.arange(3 * len(mesh.faces)).view(-1, 3)
    uv = interpolate_reference(seen, mesh.uv.to(points).flatten(0, 1), corners)
    directions = normalize(interpolate_reference(seen, normals, mesh.faces), dim=-1)
    face_weight = torch.cat([mesh.face_weights, mesh.face_weights.new_zeros(1)])[fragments.face_index.long()]
    colors = torch.where(
        (face_weight > 0)[..., None], sample_texture_reference(texture, uv) * shade(directions, light), image
    )
    picture = antialias_reference(colors, seen, points, mesh.faces, mesh.edges)
    weight = mask * torch.where(face_weight > 0, face_weight, torch.ones_like(face_weight))
    lengths = ((picture - image).square().sum(-1) + epsilon**2).sqrt() - epsilon
    return (weight * lengths).sum() / (mask * face_weight).sum().clamp_min(1), picture


def _crossings(
    fragments: MeshFragments, points: Tensor, faces: Int[Tensor, "f 3"], edges: MeshEdges
) -> tuple[Int[Tensor, " n"], Int[Tensor, " n"], Float[Tensor, " n"]]:
    """Inner and outer pixel of every crossing of a silhouette, and its position between them (0..1, differentiable)."""
    a, b, c = points.detach()[faces].unbind(1)
    front = torch.sign((a * torch.linalg.cross(b, c)).sum(-1))
    first, second = edges.faces.long().unbind(1)
    silhouette = ((second < 0) | (front[first] != front[second])).nonzero()[:, 0]
    ends = points[edges.vertices[silhouette].long()]
    xy, inverse_depth = ends[..., :2] / ends[..., 2:], 1 / ends[..., 2]
    third = points.detach()[edges.opposite[silhouette].long()]
    inside = third[:, :2] / third[:, 2:] - xy[:, 0].detach()
    step = (xy[:, 1] - xy[:, 0]).detach()
    vertical = (step[:, 0].abs() > step[:, 1].abs()).long()  # 1 for pixels one above the other.
    side = step[:, 0] * inside[:, 1] - step[:, 1] * inside[:, 0]
    towards = torch.where(vertical == 1, side * step[:, 0], -side * step[:, 1]) < 0

    height, width = fragments.face_index.shape
    pick = vertical[:, None, None].expand(-1, 2, 1)
    along, across = xy.gather(2, 1 - pick)[..., 0], xy.gather(2, pick)[..., 0]
    lines = torch.arange(max(height, width)).to(points) + 0.5
    low, high = along.detach().amin(1), along.detach().amax(1)
    crossed = (lines >= low[:, None]) & (lines < high[:, None])
    crossed &= lines < torch.where(vertical == 1, width, height)[:, None]
    edge, line = crossed.nonzero().unbind(1)

    t = (lines[line] - along[edge, 0]) / (along[edge, 1] - along[edge, 0])
    at = across[edge, 0] + t * (across[edge, 1] - across[edge, 0])
    depth = 1 / (inverse_depth[edge, 0] + t * (inverse_depth[edge, 1] - inverse_depth[edge, 0]))
    before = (at.detach() - 0.5).floor()
    vertical, towards = vertical[edge], towards[edge]
    inner = (before + (~towards).to(before)).long()
    outer = (before + towards.to(before)).long()
    size = torch.where(vertical == 1, height, width)
    within = (torch.minimum(inner, outer) >= 0) & (torch.maximum(inner, outer) < size)
    kept = within.nonzero()[:, 0]
    inner, outer = (
        torch.where(vertical[kept] == 1, pixel[kept] * width + line[kept], line[kept] * width + pixel[kept])
        for pixel in (inner, outer)
    )
    beyond = (at - 0.5 - before)[kept]
    position = torch.where(towards[kept], beyond, 1 - beyond)
    seen = fragments.face_index.flatten()[inner] >= 0
    seen &= depth.detach()[kept] < fragments.depth.flatten()[outer]
    inner, outer, position = inner[seen], outer[seen], position[seen]
    outermost = _outermost(inner * height * width + outer, position.detach())
    return inner[outermost], outer[outermost], position[outermost]


def _outermost(pair: Int[Tensor, " n"], position: Float[Tensor, " n"]) -> Int[Tensor, " k"]:
    """Indices of the entries with the largest position of each pair (the first of equal ones)."""
    best: dict[int, int] = {}
    for index, (key, value) in enumerate(zip(pair.tolist(), position.tolist(), strict=True)):
        if key not in best or value > float(position[best[key]]):
            best[key] = index
    return torch.tensor(sorted(best.values()), dtype=torch.long)
