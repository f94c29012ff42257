"""Colours for the triangles of a head that no training picture shows, spread over its surface.

Where the other side was seen, a triangle takes its mirror image's colour. Elsewhere colours spread over the surface
from what was seen: hair over the scalp, skin over face, ears and neck. The inside of the mouth has colours of its own.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mien.face.head_parts import HeadParts, head_parts, mouth_colors
from mien.face.mirror import mirror_triangles, triangle_geometry
from mien.face.model import FaceModel

_SPREAD_NEAREST = 24  # number of known triangles that a value spreads from before it is smoothed
_SPREAD_SOFTNESS = 0.004  # distance in metres within which known triangles count alike
_SPREAD_OWN = 0.7  # knowledge (0..1) from which smoothing begins with a triangle's own value
_SPREAD_ROUNDS = 80  # number of times that values are averaged over neighbours
_SPREAD_HOLD = 4.0  # weight of a known value against the mean of its neighbours while values spread

_CHUNK = 512


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles and how values spread over them."""

    middles: Float[Tensor, "f 3"]
    """Middles of the triangles, in metres."""
    faces: Int[Tensor, "f 3"]
    vertices: int
    """Number of vertices."""

    @staticmethod
    def of(vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]) -> "Surface":
        """Return the surface of a mesh. Both arguments are on the CPU."""
        return Surface(triangle_geometry(vertices, faces)[0], faces.long(), len(vertices))

    def around(self, values: Float[Tensor, "f c"], weights: Float[Tensor, " f"]) -> Float[Tensor, "f c"]:
        """Return weighted means over the triangles that share a corner with each triangle, itself included."""
        own = torch.cat([values * weights[:, None], weights[:, None]], dim=1)
        total = own.new_zeros(self.vertices, own.shape[1]).index_add(0, self.faces.T.flatten(), own.repeat(3, 1))
        total = total[self.faces].sum(1)
        return torch.where(total[:, -1:] > 0, total[:, :-1] / total[:, -1:].clamp_min(1e-12), values)

    def spread(
        self, values: Float[Tensor, "f c"], known: Float[Tensor, " f"], among: Bool[Tensor, " f"]
    ) -> Float[Tensor, "f c"]:
        """Return `values` continued smoothly from where they are known (0..1) over the triangles of one part."""
        sources = (among & (known > 0.05)).nonzero()[:, 0]
        if not len(sources):
            return values
        begun = values.clone()
        targets = (among & (known < _SPREAD_OWN)).nonzero()[:, 0]
        for part in targets.split(_CHUNK):
            distance, index = torch.cdist(self.middles[part], self.middles[sources]).topk(
                min(_SPREAD_NEAREST, len(sources)), largest=False
            )
            weight = known[sources[index]] / (distance**2 + _SPREAD_SOFTNESS**2)
            begun[part] = (weight[..., None] * values[sources[index]]).sum(1) / weight.sum(1, keepdim=True)
        held, inside = _SPREAD_HOLD * (known * among)[:, None], among.to(values)
        smooth = begun
        for _ in range(_SPREAD_ROUNDS):
            smooth = (held * values + self.around(smooth, inside)) / (held + 1)
        return torch.where(among[:, None], smooth, values)


_COLOR_SPREAD = 0.12  # distance between colours (0..1) over which a colour stops counting as skin or as hair
_TINT_SPREAD = 0.06  # the same for colours of equal brightness. Chosen with the rule (log, 11-22) alone
_LIGHT_SPREAD = 0.25  # the same for the logarithm of their brightness beyond half or twice. Chosen with the rule alone
_DIFFERENT_COLORS = 0.10  # distance between the medians of skin and hair from which their colours can be told apart
_LARGEST_OFFSET = 0.25
"""Largest difference of brightness between a triangle and its mirror image that counts as light."""


def complete_colors(
    face_model: FaceModel, vertices: Float[Tensor, "v 3"], seen: Float[Tensor, " f"], colors: Float[Tensor, "f 3"]
) -> Float[Tensor, "f 3"]:
    """Return a colour for every triangle, 0..1: its own as far as it was seen (0..1), else a completed one.

    A colour comes from the mirror image as far as that was seen. The difference between both sides, measured where
    both were seen, is spread over the head and added, so that no border shows. What neither side shows spreads from the
    nearest seen triangles of the same kind: scalp from scalp that looks like hair, face and ears from what looks like
    skin, neck from either (so that long hair goes on behind). Mouth, teeth and tongue get dark, light and red colours
    that fade with the depth behind the lips. The vertices are those of the neutral head in the head frame, in metres.
    What is not finite counts as not seen.
    """
    seen, colors = _cleaned(seen, colors)
    parts, mesh = head_parts(face_model), Surface.of(vertices.detach().to(colors), face_model.faces.cpu())
    known = seen * _trust(parts, mesh.middles, seen, colors)
    filled_in = _spread_by_part(parts, mesh, known, colors)
    mirrored, share = _mirrored(face_model, mesh, seen, known, colors)
    filled_in = torch.lerp(filled_in, mirrored, share[:, None])
    brightness = _brightness(parts, seen, colors)
    filled_in = torch.where(parts.interior[:, None], brightness * mouth_colors(parts, mesh.middles), filled_in)
    return torch.where(seen[:, None] >= 1, colors, torch.lerp(filled_in.clamp(0, 1), colors, seen[:, None]))


def vertex_means(face_model: FaceModel, colors: Float[Tensor, "f 3"]) -> Float[Tensor, "v 3"]:
    """Return the mean colour of the triangles around each vertex, for drawing a completed mesh (`render_mesh`).

    Vertices without a triangle are grey.
    """
    colors, corners = colors.detach().float().cpu(), face_model.faces.long().cpu().T.flatten()
    own = torch.cat([colors, torch.ones(len(colors), 1)], dim=1).repeat(3, 1)
    total = torch.zeros(len(face_model.template), 4).index_add(0, corners, own)
    return torch.where(total[:, 3:] > 0, total[:, :3] / total[:, 3:].clamp_min(1), 0.5)


def _cleaned(seen: Tensor, colors: Tensor) -> tuple[Float[Tensor, " f"], Float[Tensor, "f 3"]]:
    seen, colors = seen.detach().float().cpu(), colors.detach().float().cpu()
    whole = seen.isfinite() & colors.isfinite().all(1)
    colors = torch.where(whole[:, None], colors, 0.5).clamp(0, 1)
    return torch.where(whole, seen, 0.0).clamp(0, 1), colors


def _median(values: Float[Tensor, "f 3"], chosen: Bool[Tensor, " f"]) -> Float[Tensor, " 3"] | None:
    return values[chosen].median(0).values if bool(chosen.any()) else None


def _trust(
    parts: HeadParts, middles: Float[Tensor, "f 3"], seen: Float[Tensor, " f"], colors: Float[Tensor, "f 3"]
) -> Float[Tensor, " f"]:
    """Return how far each triangle's colour belongs to its part, 0..1: hair over the face, or a collar, does not."""
    sure = seen > 0.5
    skin = _median(colors, sure & parts.face)
    top = sure & parts.scalp
    if bool(top.any()):
        top &= middles[:, 1] >= middles[top, 1].median()
    hair = _median(colors, top)

    trust = torch.ones_like(seen)
    hair_like = trust if hair is None else _close(colors, hair)
    if skin is None:
        return trust
    skin_like = _close_but_for_light(colors, skin)
    trust = torch.where(parts.skin, skin_like, trust)
    trust = torch.where(parts.neck, skin_like if hair is None else torch.maximum(skin_like, hair_like), trust)
    if hair is not None and float((skin - hair).norm()) > _DIFFERENT_COLORS:
        trust = torch.where(parts.scalp, hair_like / (hair_like + _close(colors, skin) + 1e-3), trust)
    return trust


def _close(colors: Float[Tensor, "f 3"], color: Float[Tensor, " 3"]) -> Float[Tensor, " f"]:
    return torch.exp(-0.5 * ((colors - color) ** 2).sum(1) / _COLOR_SPREAD**2)


def _close_but_for_light(colors: Float[Tensor, "f 3"], color: Float[Tensor, " 3"]) -> Float[Tensor, " f"]:
    """Return how close colours are to one colour in half to twice the light, 0..1."""
    light = (colors @ color) / (color @ color).clamp_min(1e-6)
    tint = ((colors - light[:, None] * color) ** 2).sum(1) / _TINT_SPREAD**2
    beyond = (light.clamp_min(1e-3).log().abs() - math.log(2)).clamp_min(0)
    return torch.exp(-0.5 * (tint + (beyond / _LIGHT_SPREAD) ** 2))


def _spread_by_part(
    parts: HeadParts, mesh: Surface, known: Float[Tensor, " f"], albedo: Float[Tensor, "f 3"]
) -> Float[Tensor, "f 3"]:
    sure = known > 0.05
    anything = albedo[sure].mean(0) if bool(sure.any()) else albedo.new_full((3,), 0.5)
    filled = anything.expand_as(albedo).clone()
    for part, sources in parts.kinds():
        own = torch.where(sources, known, 0.0)
        if bool((own > 0.05).any()):
            whole = mesh.spread(albedo, own, part | sources)
            filled = torch.where(part[:, None], whole, filled)
    return filled


def _mirrored(
    face_model: FaceModel,
    mesh: Surface,
    seen: Float[Tensor, " f"],
    known: Float[Tensor, " f"],
    albedo: Float[Tensor, "f 3"],
) -> tuple[Float[Tensor, "f 3"], Float[Tensor, " f"]]:
    """Return the mirror images' colours, fitted to this side's light, and how far the mirror images were seen."""
    images = mirror_triangles(face_model)
    has, image = images >= 0, images.clamp_min(0)
    both = torch.where(has, known * known[image], 0.0)
    offset = (albedo - albedo[image]).clamp(-_LARGEST_OFFSET, _LARGEST_OFFSET)
    offset = torch.where((both > 0.05)[:, None], offset, 0.0)
    return albedo[image] + mesh.spread(offset, both, torch.ones_like(has)), torch.where(has, seen[image], 0.0)


def _brightness(parts: HeadParts, seen: Float[Tensor, " f"], colors: Float[Tensor, "f 3"]) -> float:
    """Return how bright the pictures are: the median luminance of seen skin over that of skin in daylight."""
    skin = _median(colors, (seen > 0.5) & parts.face)
    if skin is None:
        return 1.0
    return float((skin @ torch.tensor([0.2126, 0.7152, 0.0722]) / 0.6).clamp(0.4, 1.3))
