"""Spread values of a mesh's triangles over its surface, from where they are known."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mien.face.mirror import triangle_geometry

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
