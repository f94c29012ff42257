"""The surface that Gaussians are bound to: one or more on each triangle of a face model, in the triangle's frame.

A method that binds its Gaussians hands a `BoundSurface` to `Extras`. Training then closes heads, moves hair and fills
mouths on it (`mien.training.whole_head`).
"""

from collections.abc import Callable, Mapping
from collections.abc import Sequence as Items
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mien.avatar.ops.binding import Binding
from mien.avatar.ops.hair_strands import shell_growth, strand_gaussians
from mien.avatar.ops.surface_limits import keep_on_surface, limits_of_triangles, pull_colors
from mien.avatar.ops.triangle_frames import triangle_ellipses, triangle_frames
from mien.avatar.store import GaussianStore
from mien.gaussians import sh_from_rgb

FILL_OPACITY = 0.97  # opacity of a fill
LEAST_OPACITY = 1e-4  # the least that a limit leaves of a Gaussian's opacity
_FILL_HEIGHT_SHARE = 0.9
"""Height of a fill as a share of the hair's. Hair is thinner at its outline, and a higher fill stands out beyond it.
Measured: 0.5 has 0.2 dB more at 30 degrees and 0.3 less at 90, and 1 has 0.2 dB less at 30 (log, 11-24)."""
_OPEN_OPACITY = 0.5  # sum of the opacities of a triangle's Gaussians below which its surface is open
_SHIFTS = ("offset_basis",)  # tensors [n, 3, r] of a store that are added to centres
_UNLIMITED = (-1e4, 1e4, 10.0, 10.0, 1.0)
"""Limits of what is rigid, in the order of `limits_of_triangles`."""
LEAST_MOTION = 3e-4  # motion of a triangle, in metres, below which nothing says what undoes it
_COLOR_PULL = 0.05
"""Share of the difference to the completed colour that a step takes away where no picture shows a triangle. Measured: a
tenth of it has 0.5 dB less in front (log, 11-23)."""


@dataclass(frozen=True, eq=False)
class SurfacePrior:
    """Knowledge of each of the f triangles of a head without training: from the mesh, the mattes and symmetry."""

    hair: Float[Tensor, " f"]
    """Height of hair along the triangle's normal, in metres; 0 on skin that no hair hangs over."""
    hanging: Float[Tensor, " f"] | None = None
    """How far hair beside skin and neck stands out along the normal, in metres. None means 0."""
    colors: Float[Tensor, "f 3"] | None = None
    """Colours, 0..1, completed where no picture shows any. None if nothing was completed."""
    doubt: Float[Tensor, " f"] | None = None
    """0 for triangles that pictures show well, 1 for those that none shows. None if nothing was completed."""
    filled_in: Bool[Tensor, " f"] | None = None
    """Triangles that are filled rather than trained: no picture shows them, and they are above the cut at the neck."""
    closed: Bool[Tensor, " f"] | None = None
    """Triangles that are opaque before the first step: `filled_in` and the inside of the mouth. None: `filled_in`."""
    strands: Bool[Tensor, " f"] | None = None
    """Filled triangles that are covered with strands of hair. None means none."""
    widening: Float[Tensor, " f"] | None = None
    """Factors on the limits to the surface, for parts that the mesh fits less well. None means 1."""
    parts: Int[Tensor, " f"] | None = None
    """A number for each triangle's part, or -1 on the scalp. Gaussians that are bound anew stay on it, and on the scalp
    none is: it does not bend, and hair is far from it. None means one part."""
    opacities: Float[Tensor, " f"] | None = None
    """Largest opacity of a Gaussian on each triangle. None means 1."""
    carrier: int | None = None
    """Triangle that no expression moves. What is rigid is bound to it, without limits. None: nothing is looked for."""

    @property
    def fill_height(self) -> Float[Tensor, " f"]:
        """Height at which a fill lies above its triangle, in metres."""
        return _FILL_HEIGHT_SHARE * self.hair

    def to(self, like: Tensor) -> "SurfacePrior":
        """The same on the device of `like`, with its float dtype."""
        own = {field.name: getattr(self, field.name) for field in fields(self)}
        given = {name: tensor for name, tensor in own.items() if isinstance(tensor, Tensor)}
        return replace(
            self, **{name: one.to(like if one.is_floating_point() else like.device) for name, one in given.items()}
        )


class BoundSurface:
    """Gaussians that are bound to triangles, as a surface. All of its state is the avatar's.

    Args:
        store: Returns the store, with `face_index` and the tensors `means, quats, log_scales, opacity_logits,
            sh_constant` in the frames of triangles. Others are 0 on fills.
        mesh: Returns vertices and faces of the person's neutral head in the head frame.
        limited: Whether Gaussians are kept flat on the surface, also if nothing is filled.
        first_colors: Whether the first colours are those of the training pictures.
        bases: Names of tensors that the activations of a Gaussian's triangle multiply.
        penalties: The method's weighted penalties of changes with the expression (`Posed.aux`), by name.
    """

    def __init__(
        self,
        store: Callable[[], GaussianStore],
        mesh: Callable[[], tuple[Float[Tensor, "v 3"], Int[Tensor, "f 3"]]],
        *,
        limited: bool,
        first_colors: bool,
        bases: Items[str],
        penalties: Callable[[Mapping[str, Tensor]], dict[str, Float[Tensor, ""]]],
    ):
        self.limited, self.wants_first_colors = limited, first_colors
        self._get_store, self._mesh, self._bases, self._penalties = store, mesh, bases, penalties
        self._known: Tensor | None = None
        self._tables: tuple[SurfacePrior, Tensor | None, Tensor | None] | None = None
        self._binding: Binding | None = None

    @property
    def _store(self) -> GaussianStore:
        return self._get_store()

    def triangles(self) -> Int[Tensor, " n"]:
        """The triangle that each Gaussian is bound to."""
        return self._store["face_index"]

    @property
    def sizes(self) -> Float[Tensor, " f"]:
        """Sizes of the triangles of the neutral head, in metres per triangle unit."""
        if self._known is None:
            self._known = triangle_frames(*self._mesh()).k.detach()
        self._known = self._known.to(self._store["means"])  # the avatar may have moved since
        return self._known

    @torch.no_grad()
    def set_first_colors(self, colors: Float[Tensor, "v 3"]) -> None:
        """Give every Gaussian the mean of its triangle's three vertices' colours, 0..1."""
        corners = self._mesh()[1][self.triangles()].long()
        own = colors.to(self._store["sh_constant"])[corners].mean(1)
        self._store.assign("sh_constant", sh_from_rgb(own)[:, None])

    @torch.no_grad()
    def close(self, prior: SurfacePrior) -> None:
        """Start from completed colours everywhere, and an opaque flat Gaussian on what no picture shows.

        It lies at the height of hair. Strands of hair are added where the prior says so.
        """
        closed = prior.filled_in if prior.closed is None else prior.closed
        if prior.colors is None or closed is None:
            return
        store, bound = self._store, self.triangles()
        filled, fills = closed[bound], {name: values[bound] for name, values in self._fills(prior).items()}
        store.assign("sh_constant", sh_from_rgb(prior.colors.to(store["means"])[bound])[:, None])
        store.assign("means", fills["means"])
        for name in ("quats", "log_scales", "opacity_logits"):
            chosen = filled.view(-1, *[1] * (store[name].ndim - 1))
            store.assign(name, torch.where(chosen, fills[name], store[name]))
        if prior.strands is not None and bool(prior.strands.any()):
            own = strand_gaussians(*self._mesh(), prior.strands, prior.fill_height, prior.colors)
            rest = {name: store[name].new_zeros(len(own["means"]), *store[name].shape[1:]) for name in store.trained}
            store.append(torch.zeros(len(own["means"]), dtype=torch.long), rest | own)

    @torch.no_grad()
    def keep_to(self, prior: SurfacePrior) -> None:
        """Bring Gaussians that left the surface back, and pull colours of what is rarely seen to the completed ones.

        Opacities stay within their limits.
        """
        limits, pulls = self._limits_and_pulls(prior)
        if prior.opacities is not None:
            most = torch.logit(prior.opacities, LEAST_OPACITY).index_select(0, self.triangles())
            logits = self._store["opacity_logits"].detach()
            torch.minimum(logits, most.to(logits), out=logits)
        if limits is not None:
            keep_on_surface(self._store, limits, pulls)
        elif pulls is not None:
            pull_colors(self._store, pulls)

    @torch.no_grad()
    def renew_binding(self, prior: SurfacePrior) -> None:
        """Bind each Gaussian to the triangle that it lies on, if the prior or the method keeps them to the surface.

        Trained ones stay off triangles that are filled, and all stay on their part of the head: hair that hangs over a
        cheek does not move with it.
        """
        if not self.limited and prior.filled_in is None:
            return
        store = self._store
        shifts = [name for name in _SHIFTS if name in store.trained]
        self._binding_of(prior).renew(store, self._limits_and_pulls(prior)[0], shifts, store.moments)

    @torch.no_grad()
    def counter_motion(
        self, posed: Items[tuple[Float[Tensor, "v 3"], Mapping[str, Tensor]]]
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """How much of their triangles' motion Gaussians have learned to undo (1: all), and that motion, in metres.

        Args:
            posed: Vertices of the head in its own frame, and the method's changes (`Posed.aux`), of several faces.
        """
        store, faces, own = self._store, self._mesh()[1], self.triangles().long()
        motion, undone = [], []
        for vertices, changes in posed:
            frames = triangle_frames(vertices, faces)
            turned = frames.k[own, None, None] * frames.R[own]
            motion.append((turned @ store["means"].detach()[..., None])[..., 0] + frames.T[own])
            shifts = sum(changes[name].detach() for name in _SHIFTS if name in changes)
            undone.append((turned @ shifts[..., None])[..., 0] if isinstance(shifts, Tensor) else 0 * motion[-1])
        by_mesh, by_shifts = (torch.stack(own) - torch.stack(own).mean(0) for own in (motion, undone))
        squares = by_mesh.square().sum(2).mean(0)
        products = (by_mesh * by_shifts).sum(2).mean(0)
        return -products / squares.clamp_min(LEAST_MOTION**2), squares.sqrt()

    @torch.no_grad()
    def carry(self, rows: Int[Tensor, " k"], prior: SurfacePrior) -> Bool[Tensor, " n"]:
        """Append copies of Gaussians that the prior's carrier holds, and return which of all are to be removed.

        These are the originals, except for one on each triangle that would have none: it becomes a fill.
        """
        assert prior.carrier is not None
        store, count = self._store, len(self._store)
        lost = torch.zeros(count + len(rows), dtype=torch.bool, device=rows.device)
        lost[rows] = True
        zeros = {name: torch.zeros_like(store[name][rows]) for name in self._bases if name in store.trained}
        store.append(rows, zeros)
        copies = torch.arange(count, len(store), device=rows.device)
        self._binding_of(prior).bind(store, copies, torch.full_like(copies, prior.carrier))
        triangles = self.triangles().long()
        held = torch.zeros(len(self.sizes), dtype=torch.bool, device=rows.device)
        held[triangles[~lost]] = True
        bare = rows[~held[triangles[rows]]]
        first = torch.full((len(held),), len(store), device=rows.device)
        first = first.scatter_reduce(0, triangles[bare], bare, "amin")
        kept = bare[first[triangles[bare]] == bare]
        self.restore(kept, prior, close=True)
        lost[kept] = False
        return lost

    def _binding_of(self, prior: SurfacePrior) -> Binding:
        """Find which triangles are beside each other and filled, closed or trained alike. The carrier is alone."""
        if self._binding is None:
            vertices, faces = self._mesh()
            kinds = torch.zeros(len(faces), dtype=torch.long, device=faces.device)
            for own in (prior.filled_in, prior.closed):
                kinds = 2 * kinds + (0 if own is None else own.long())
            if prior.parts is not None:
                kinds = torch.where(prior.parts < 0, -1, 4 * prior.parts + kinds)
            if prior.carrier is not None:
                kinds[prior.carrier] = -1
            self._binding = Binding(vertices.detach(), faces, kinds)
        return self._binding

    @torch.no_grad()
    def restore(self, rows: Int[Tensor, " k"], prior: SurfacePrior, *, close: bool) -> None:
        """Give some Gaussians completed colours. With `close`, they also get place, shape and opacity of fills."""
        if prior.colors is None or not len(rows):
            return
        store, bound = self._store, self.triangles()[rows]
        values = {"sh_constant": sh_from_rgb(prior.colors.to(store["means"])[bound])[:, None]}
        if close:
            values |= {name: own[bound] for name, own in self._fills(prior).items()}
            rest = [name for name in store.trained if name not in values]
            values |= {name: torch.zeros_like(store[name][rows]) for name in rest}
        for name, own in values.items():
            store.assign_rows(name, rows, own)

    @torch.no_grad()
    def height_gradient(self) -> Float[Tensor, " f"] | None:
        """Derivative of the loss by the height of each triangle's Gaussians above it, per metre; None without any.

        The second axis of a triangle's frame is its normal.
        """
        gradient, bound = self._store["means"].grad, self.triangles()
        if gradient is None:
            return None
        sizes = self.sizes
        return torch.zeros_like(sizes).index_add_(0, bound, gradient[:, 1] / sizes.index_select(0, bound))

    @torch.no_grad()
    def raise_by(self, shift: Float[Tensor, " f"]) -> None:
        """Move Gaussians along the normals of their triangles, by metres."""
        self._store["means"].detach()[:, 1] += (shift / self.sizes)[self.triangles()]

    def change_penalty(self, changes: Mapping[str, Tensor], held: Bool[Tensor, " f"]) -> Float[Tensor, ""] | None:
        """The method's penalty of changes that the mesh does not make, as a mean over all Gaussians.

        Those on triangles that are not `held` add 0. None if there are no changes.
        """
        counts = held.index_select(0, self.triangles())
        own = {name: own * counts.view(-1, *[1] * (own.ndim - 1)) for name, own in changes.items() if own.ndim > 0}
        penalties = self._penalties(own)
        return torch.stack(list(penalties.values())).sum() if penalties else None

    @torch.no_grad()
    def fill_interior(self, chosen: Bool[Tensor, " f"], colors: Float[Tensor, "f 3"]) -> None:
        """Replace the first Gaussian of each chosen triangle that is open by a flat one in the triangle's shape.

        A triangle is open if its Gaussians are less than half opaque together.
        """
        store, like, bound = self._store, self._store["means"], self.triangles().long()
        opacities = store["opacity_logits"].sigmoid()
        total = opacities.new_zeros(len(chosen)).index_add(0, bound, opacities)
        order = torch.arange(len(store), device=bound.device)
        first = torch.full_like(chosen, len(store), dtype=torch.long).scatter_reduce(0, bound, order, "amin")
        opened = (chosen & (total < _OPEN_OPACITY) & (first < len(store))).nonzero()[:, 0]
        quats, log_scales = triangle_ellipses(*self._mesh())
        flat = {
            **{name: like.new_zeros(len(opened), *store[name].shape[1:]) for name in store.trained},
            "face_index": opened,
            "quats": quats[opened],
            "log_scales": log_scales[opened],
            "opacity_logits": torch.logit(like.new_full((len(opened),), FILL_OPACITY)),
            "sh_constant": sh_from_rgb(colors.to(like)[opened])[:, None],
        }
        for name, values in flat.items():
            store.assign_rows(name, first[opened], values)

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

    def _limits_and_pulls(self, prior: SurfacePrior) -> tuple[Float[Tensor, "f 5"] | None, Float[Tensor, "f 4"] | None]:
        if self._tables is None or self._tables[0] is not prior:
            self._tables = (prior, *self._tables_of(prior))
        return self._tables[1:]

    def _tables_of(self, prior: SurfacePrior) -> tuple[Float[Tensor, "f 5"] | None, Float[Tensor, "f 4"] | None]:
        """The limits and the pulls of colours of all triangles."""
        limits = pulls = None
        if self.limited or prior.filled_in is not None:
            hair = prior.hair if prior.hanging is None else torch.maximum(prior.hair, prior.hanging)
            limits = limits_of_triangles(self.sizes, hair, prior.widening)
            if prior.carrier is not None:
                limits[prior.carrier] = limits.new_tensor(_UNLIMITED)
        if prior.colors is not None and prior.doubt is not None:
            # What is made up has the colours that it was given, strand by strand.
            doubt = prior.doubt if prior.filled_in is None else prior.doubt.masked_fill(prior.filled_in, 0)
            colors = torch.cat([sh_from_rgb(prior.colors), _COLOR_PULL * doubt[:, None]], dim=1)
            if prior.carrier is not None:
                colors[prior.carrier, 3] = 0
            pulls = colors.to(self._store["means"])
        return limits, pulls
