"""The surface of GaussianAvatars: one or more Gaussians on each triangle, in the frame of the triangle."""

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mien.avatar.avatar import Avatar
from mien.avatar.bound_surface import FILL_OPACITY, BoundSurface, SurfacePrior
from mien.avatar.gaussian_avatars.changes import change_penalties
from mien.avatar.gaussian_avatars.hair_strands import shell_growth, strand_gaussians
from mien.avatar.gaussian_avatars.settings import GaussianAvatarsConfig
from mien.avatar.gaussian_avatars.surface_limits import keep_on_surface, limits_of_triangles, pull_colors
from mien.avatar.ops.triangle_frames import triangle_ellipses, triangle_frames
from mien.avatar.store import GaussianStore
from mien.gaussians import sh_from_rgb

_OPEN_OPACITY = 0.5  # sum of the opacities of a triangle's Gaussians below which its surface is open
_COLOR_PULL = 0.05
"""Share of the difference to the completed colour that a step takes away where no picture shows a triangle. Measured: a
tenth of it has 0.5 dB less in front (log, 11-23)."""


class GaussianSurface(BoundSurface):
    """The Gaussians of an avatar as a surface. All of its state is the avatar's.

    Args:
        avatar: The avatar. Its store has `face_index` and the raw tensors of GaussianAvatars.
        config: Its settings.
    """

    def __init__(self, avatar: Avatar, config: GaussianAvatarsConfig):
        self._avatar = avatar
        self._config = config
        self._known: Tensor | None = None
        self._tables: tuple[SurfacePrior, Tensor | None, Tensor | None] | None = None

    @property
    def _store(self) -> GaussianStore:
        return self._avatar.gaussian_store()

    def _mesh(self) -> tuple[Float[Tensor, "v 3"], Int[Tensor, "f 3"]]:
        """The neutral head in the head frame: vertices and faces."""
        return self._avatar.face_model.head_vertices(self._avatar.subject)[0], self._avatar.face_model.faces

    @property
    def wants_first_colors(self) -> bool:
        """Whether the settings ask for colours from the pictures."""
        return self._config.first_colors == "pictures"

    @torch.no_grad()
    def set_first_colors(self, colors: Float[Tensor, "v 3"]) -> None:
        """Give every Gaussian the mean colour of its triangle's three vertices."""
        corners = self._avatar.face_model.faces[self._store["face_index"]].long()
        own = colors.to(self._store["sh_constant"])[corners].mean(1)
        self._store.assign("sh_constant", sh_from_rgb(own)[:, None])

    def triangles(self) -> Int[Tensor, " n"]:
        """The triangle that each Gaussian is bound to."""
        return self._store["face_index"]

    @property
    def limited(self) -> bool:
        """Whether the settings limit how far Gaussians may leave the surface."""
        return self._config.surface.enabled

    @torch.no_grad()
    def close(self, prior: SurfacePrior) -> None:
        """Completed colours everywhere, and an opaque flat Gaussian at the height of hair on what no picture shows.

        Strands of hair are added where the prior says so.
        """
        closed = prior.filled_in if prior.closed is None else prior.closed
        if prior.colors is None or closed is None:
            return
        store, bound = self._store, self._store["face_index"]
        filled, fills = closed[bound], {name: values[bound] for name, values in self._fills(prior).items()}
        store.assign("sh_constant", sh_from_rgb(prior.colors.to(store["means"])[bound])[:, None])
        store.assign("means", fills["means"])
        for name in ("quats", "log_scales", "opacity_logits"):
            chosen = filled.view(-1, *[1] * (store[name].ndim - 1))
            store.assign(name, torch.where(chosen, fills[name], store[name]))
        if prior.strands is not None and bool(prior.strands.any()):
            vertices, faces = self._mesh()
            own = strand_gaussians(vertices, faces, prior.strands, prior.fill_height, prior.colors)
            rest = {name: store[name].new_zeros(len(own["means"]), *store[name].shape[1:]) for name in store.trained}
            store.append(torch.zeros(len(own["means"]), dtype=torch.long), rest | own)

    def _fills(self, prior: SurfacePrior) -> dict[str, Tensor]:
        """Place, shape and opacity of each triangle's fill: opaque, flat, at the height of hair."""
        vertices, faces = self._mesh()
        quats, log_scales = triangle_ellipses(vertices, faces)
        height = prior.fill_height
        wider = shell_growth(vertices, faces, height).log()[:, None] * log_scales.new_tensor([1.0, 0.0, 1.0])
        return {
            "means": torch.stack([0 * height, height / self.sizes, 0 * height], 1),
            "quats": quats,
            "log_scales": log_scales + wider,
            "opacity_logits": torch.logit(torch.full_like(height, FILL_OPACITY)),
        }

    @torch.no_grad()
    def keep_to(self, prior: SurfacePrior) -> None:
        """Apply `SurfaceLimits`, and pull the colours of what is rarely seen towards the completed ones."""
        limits, pulls = self._tables_of(prior)
        if limits is not None:
            keep_on_surface(self._store, limits, self._config.surface.ratio, pulls)
        elif pulls is not None:
            pull_colors(self._store, pulls)

    def _tables_of(self, prior: SurfacePrior) -> tuple[Float[Tensor, "f 5"] | None, Float[Tensor, "f 4"] | None]:
        """Return the limits and the pulls of colours of all triangles. They are kept until the prior changes."""
        if self._tables is None or self._tables[0] is not prior:
            limits = pulls = None
            if self._config.surface.enabled or prior.filled_in is not None:
                hair = prior.hair if prior.hanging is None else torch.maximum(prior.hair, prior.hanging)
                limits = limits_of_triangles(self._config.surface, self.sizes, hair, prior.widening)
            if prior.colors is not None and prior.doubt is not None:
                # What is made up has the colours that it was given, strand by strand.
                doubt = prior.doubt if prior.filled_in is None else prior.doubt.masked_fill(prior.filled_in, 0)
                share = _COLOR_PULL * doubt[:, None]
                pulls = torch.cat([sh_from_rgb(prior.colors), share], dim=1).to(self._store["means"])
            self._tables = (prior, limits, pulls)
        return self._tables[1:]

    @torch.no_grad()
    def restore(self, rows: Int[Tensor, " k"], prior: SurfacePrior, *, close: bool) -> None:
        """Completed colours and, with `close`, what `close` gives to fills."""
        if prior.colors is None or not len(rows):
            return
        store, bound = self._store, self._store["face_index"][rows]
        values = {"sh_constant": sh_from_rgb(prior.colors.to(store["means"])[bound])[:, None]}
        if close:
            values |= {name: own[bound] for name, own in self._fills(prior).items()}
            rest = [name for name in store.trained if name not in values]
            values |= {name: torch.zeros_like(store[name][rows]) for name in rest}
        for name, own in values.items():
            store.assign_rows(name, rows, own)

    @torch.no_grad()
    def height_gradient(self) -> Float[Tensor, " f"] | None:
        """Derivative of the loss by the height of each triangle's Gaussians: that of their second local coordinate."""
        gradient, bound = self._store["means"].grad, self._store["face_index"]
        if gradient is None:
            return None
        sizes = self.sizes
        return torch.zeros_like(sizes).index_add_(0, bound, gradient[:, 1] / sizes.index_select(0, bound))

    @torch.no_grad()
    def raise_by(self, shift: Float[Tensor, " f"]) -> None:
        """Move Gaussians along the second axis of their triangles' frames, which is the normal."""
        bound = self._store["face_index"]
        self._store["means"].detach()[:, 1] += (shift / self.sizes)[bound]

    def change_penalty(self, changes: Mapping[str, Tensor], held: Bool[Tensor, " f"]) -> Float[Tensor, ""] | None:
        """The sum of `change_penalties`."""
        counts = held.index_select(0, self.triangles())
        own = {name: values * counts.view(-1, *[1] * (values.ndim - 1)) for name, values in changes.items()}
        penalties = change_penalties(self._config, own)
        return torch.stack(list(penalties.values())).sum() if penalties else None

    @property
    def sizes(self) -> Float[Tensor, " f"]:
        """Sizes of the triangles of the neutral head, in metres per triangle unit."""
        if self._known is None:
            self._known = triangle_frames(*self._mesh()).k.detach()
        return self._known.to(self._store["means"])  # the avatar may have moved since

    @torch.no_grad()
    def fill_interior(self, chosen: Bool[Tensor, " f"], opacity: float, colors: Float[Tensor, "f 3"]) -> None:
        """Replace the first Gaussian of each chosen triangle that is open by a flat one of the triangle's shape."""
        store, bound = self._store, self._store["face_index"].long()
        opacities = store["opacity_logits"].sigmoid()
        total = opacities.new_zeros(len(chosen)).index_add(0, bound, opacities)
        order = torch.arange(len(store), device=bound.device)
        first = torch.full_like(chosen, len(store), dtype=torch.long).scatter_reduce(0, bound, order, "amin")
        opened = (chosen & (total < _OPEN_OPACITY) & (first < len(store))).nonzero()[:, 0]
        for name, values in self._flat(opened, total.new_full((len(chosen),), opacity), colors).items():
            store.assign_rows(name, first[opened], values)

    def _flat(
        self, triangles: Int[Tensor, " k"], opacity: Float[Tensor, " f"], colors: Float[Tensor, "f 3"]
    ) -> dict[str, Tensor]:
        """The tensors of flat Gaussians, one for each of the given triangles, which have the triangles' shapes."""
        store, like = self._store, self._store["means"]
        quats, log_scales = triangle_ellipses(*self._mesh())
        return {
            **{name: like.new_zeros(len(triangles), *store[name].shape[1:]) for name in store.trained},
            "face_index": triangles,
            "quats": quats[triangles],
            "log_scales": log_scales[triangles],
            "opacity_logits": torch.logit(opacity.to(like)[triangles].clamp(1e-6, 1 - 1e-6)),
            "sh_constant": sh_from_rgb(colors.to(like)[triangles])[:, None],
        }
