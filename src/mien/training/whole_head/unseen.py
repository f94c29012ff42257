"""Sides of the head that no training picture shows: a closed surface in completed colours from the first step on.

What no picture shows must not help to explain pictures. Gaussians on such triangles are completed: opaque and flat, at
the height of hair, in completed colours. Training changes only their height along the normal, where pictures clearly
contradict it, as where they stand out beyond the outline. Triangles in a band beside those that are seen are trained,
because the hair above them is on the outline.
"""

from collections.abc import Sequence as Items
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import softshrink

from mien.arrays import clear_rows
from mien.avatar.avatar import Avatar
from mien.avatar.bound_surface import BoundSurface, SurfacePrior
from mien.avatar.density import DensityControl, GradientDensity
from mien.avatar.settings import Photometric
from mien.face.head_parts import head_parts
from mien.face.model import FaceModel
from mien.gaussians import Rendering
from mien.machine.parallel import stream_in_threads
from mien.render.mesh import rasterize_mesh, vertex_normals
from mien.training.footage.coverage import Coverage, drawn_share, measure_coverage, smoothstep
from mien.training.footage.frames import Footage, Frame, spread_frames
from mien.training.footage.hidden import hidden_triangles
from mien.training.settings import TrainSettings
from mien.training.whole_head.completion import Surface, complete_colors, vertex_means
from mien.training.whole_head.hair_height import back_hair, hair_height, hanging_hair
from mien.training.whole_head.rigid_parts import carrier_of

UNSEEN_CONFIDENCE = 0.02
"""Confidence below which a triangle is completed. Measured: 0.01 and 0.1 differ by 0.1 dB at most, from the front to 90
degrees; 0.02 was chosen between them (11-23)."""
OUTLINE_BAND = 0.025
"""Distance in metres from what pictures show up to which unseen triangles are trained. Hair above them is on the
outline. Measured (1,600 steps): without a band, the heads of d3, d9 and wojtek have 0.7, 0.3 and 0.1 dB less; with 50
mm, or with no completed Gaussians, d3 has 0.1 dB more (log, 11-26)."""
_HEIGHT_FRAMES = 48
"""Largest number of frames in which the mesh is drawn as high as its hair, to find what they show of hair."""
_MOUTH_FRAMES = 240  # number of frames in which the inside of the mouth is looked for
_MOUTH_SHOWN_SHARE = 0.02  # share of these frames that have to show a triangle of it
_DOUBT_INSIDE, _DOUBT_OF_TEETH = 0.1, 0.02
"""Doubt about colours of the mouth's inside and of teeth. They are learned where they are often seen, and completed
elsewhere. Without it, teeth that were filmed between lips are also painted on the tongue behind (log, 11-30)."""
_MOVING_WIDENING = 3.0
"""Factor on the limits to the surface at regions that move most, and inside the mouth. The tracked mesh is millimetres
off there, and its folds are not those of the skin. Measured on wojtek (256 px, 11-23): 2.5 and 3 have the same mouth, 4
has 0.15 dB more there, and 0.1 dB less in all."""
_MOVING_NEAR = (0.008, 0.024)
"""Distances in metres from these regions between which the factor falls to 1. Measured on wojtek (256 px, 11-23): the
mouth has 0.25 dB more than with a factor in the regions alone."""
_STRANDS_LEAST_HEIGHT = 0.003  # height of hair in metres from which made-up hair has strands
_FILL_CONTRADICTION = 1e-6
"""Gradient of a centre, in triangle units, from which pictures contradict the height of a fill. A little light shines
through every avatar, so smaller gradients reach what is hidden. Chosen instead of 3e-6 together with other changes
(11-23) alone."""
_FILL_ALPHA_WEIGHT = 1.0
"""Least weight of the loss of alpha. Without it, white Gaussians hide completed Gaussians beyond the outline, and
white shines through hair. Measured on wojtek's head, 12,000 steps over white: 0.2, 0.5 and 1 have 30.3 to 30.4 dB over
white, and 26.4, 27.9 and 28.7 over dark blue. Growth at half the gradient, used with 1 alone, is 0.3 of it at most
(log, 11-28)."""

END = 0.04  # height over which the lower end of a bust fades, in metres
_END_POWER = 1.5  # power of the fading share. Gaussians lie over each other, and together hide more than each alone
_CLOTHES = 0.03  # how far clothes may stand off a bust, in metres. Set by eye

_MOVING = ("lips", "eyelids", "eyes", "irises")
"""Regions that move most."""


@dataclass(frozen=True, eq=False)
class Unseen:
    """What the training pictures show of a head, and what is known of the rest."""

    coverage: Coverage | None
    """None if only limits to the surface were asked for."""
    prior: SurfacePrior

    @property
    def fills(self) -> bool:
        """Whether some sides are filled rather than trained."""
        return self.prior.filled_in is not None

    def to(self, like: Tensor) -> "Unseen":
        """The same on the device of `like`."""
        return replace(self, prior=self.prior.to(like))

    def weights(self, weights: Photometric) -> Photometric:
        """The weights of the losses, with a loss of alpha if anything is filled."""
        if not self.fills:
            return weights
        return replace(weights, alpha_weight=max(weights.alpha_weight, _FILL_ALPHA_WEIGHT))

    def filled_in(self, surface: BoundSurface) -> Bool[Tensor, " n"] | None:
        """The Gaussians that are filled rather than trained."""
        filled_in = self.prior.filled_in
        return None if filled_in is None else filled_in.index_select(0, surface.triangles())

    def mask_gradients(self, avatar: Avatar, surface: BoundSurface, *renderings: Rendering) -> None:
        """Take the gradients from what is filled, after the backward pass, but for strong ones of its height."""
        filled_in = self.filled_in(surface)
        if filled_in is None:
            return
        store = avatar.store
        gradients = [own for own in (store[name].grad for name in store.trained) if own is not None]
        gradients += [own for own in (rendering.means2d_offset.grad for rendering in renderings) if own is not None]
        factored = [own for group in avatar.parameter_groups() for own in group.factored.values()]
        gradients += [term.rows for own in factored for term in own.terms]
        # The second axis of a triangle's frame is its normal.
        places = store["means"].grad
        strong = None if places is None else softshrink(places[:, 1], _FILL_CONTRADICTION)
        clear_rows(filled_in, gradients)
        if places is not None and strong is not None:
            places[:, 1] = torch.where(filled_in, strong, places[:, 1])


def fills_sides(frames: Items[Frame], settings: TrainSettings, *, bound: bool) -> bool:
    """Whether sides that no picture shows are filled.

    If the settings leave it open, they are if one camera took all frames and Gaussians are `bound` to triangles.
    """
    if settings.unseen == "auto":
        return bound and len({frame.camera for frame in frames}) == 1
    return settings.unseen == "filled"


def spare_fills(surface: BoundSurface, density: DensityControl, unseen: Unseen, filled: int) -> DensityControl:
    """A density control whose resets spare closed surfaces, and whose limit does not count the `filled` Gaussians."""
    closed = unseen.prior.closed
    if closed is None or not isinstance(density, GradientDensity):
        return density
    settings = replace(density.settings, max_gaussians=density.settings.max_gaussians + filled)
    return replace(density, settings=settings, may_reset=lambda store: ~closed[surface.triangles()])


@torch.no_grad()
def unseen_of(avatar: Avatar, footage: Footage, *, filled: bool) -> Unseen:
    """What the frames show of an avatar's head. The avatar is on the CPU, in float32."""
    model, hair, hanging = avatar.face_model, hair_height(footage), hanging_hair(footage)
    if not filled:
        return Unseen(None, SurfacePrior(hair, hanging))
    found, parts = measure_coverage(footage), head_parts(model)
    neutral = model.head_vertices(avatar.subject)[0].detach()
    opacities = None
    if any(sequence.cut == "none" for sequence in footage.sequences) and bool(parts.bust.any()):
        opacities = fading_end(model, neutral, parts.bust, found)
        found = replace(found, above=(opacities > 0).to(opacities))
        hanging = torch.where(parts.bust, hanging.clamp_min(_CLOTHES), hanging)
    # The mesh cannot say exactly which part of a mouth a picture shows, so no colour from there is believed.
    seen = torch.where(parts.interior, 0.0, found.seen)
    colors = complete_colors(model, neutral, seen, found.colors)
    shown = drawn_share(model, found)
    doubt: Float[Tensor, " f"] = (1 - shown) * found.above
    doubt = torch.where(parts.interior, torch.where(parts.teeth, _DOUBT_OF_TEETH, _DOUBT_INSIDE), doubt)
    filled_in = (shown < UNSEEN_CONFIDENCE) & (found.above > 0.5)
    outside = (found.above > 0.5) & ~parts.interior
    behind_head = back_hair(model, neutral, hair, hanging)
    drawn = drawn_at_height(footage, torch.maximum(hair, behind_head))
    filled_in &= ~(outside & beside_shown(model, neutral, outside & (drawn | ~filled_in)))
    filled_in |= hidden_inside(footage, parts.interior)
    widening = wider_where_faces_move(model, neutral, parts.interior)
    behind = filled_in & (behind_head > hair)
    # The colours of the scalp go on over triangles behind hanging hair.
    of_hair = Surface.of(neutral, model.faces).spread(colors, parts.scalp.to(colors), parts.scalp | behind)
    colors = torch.where(behind[:, None], of_hair, colors)
    hair, hanging = torch.where(behind, behind_head, hair), torch.maximum(hanging, behind_head)
    strands = filled_in & (parts.scalp | behind) & (hair > _STRANDS_LEAST_HEIGHT)
    carrier = carrier_of(model, avatar.subject, neutral, (shown > 0.5) & (found.above > 0.5) & ~filled_in)
    closed = filled_in | parts.interior
    kinds = torch.stack([parts.neck, *parts.eyes, parts.teeth, parts.tongue, parts.mouth, parts.bust]).long()
    kinds = (kinds * torch.arange(1, len(kinds) + 1)[:, None]).sum(0) - parts.scalp.long()
    prior = SurfacePrior(hair, hanging, colors, doubt, filled_in, closed, strands, widening, kinds, opacities, carrier)
    return Unseen(found, prior)


def fading_end(
    face_model: FaceModel, vertices: Float[Tensor, "v 3"], bust: Bool[Tensor, " f"], coverage: Coverage
) -> Float[Tensor, " f"]:
    """Return the largest opacity of each triangle, which fades towards the lower end of a bust, and is 1 elsewhere.

    The end is below what pictures show, or the mesh's own, if that is higher. The vertices are those of the neutral
    head, in metres.
    """
    heights = vertices[face_model.faces.long(), 1]
    shown = bust & (coverage.above > 0.5) & (coverage.seen > 0.5)
    lowest = heights[shown if bool(shown.any()) else ~bust].amin() - END
    share = smoothstep((heights.mean(1) - torch.maximum(lowest, heights.amin())) / END)
    return torch.where(bust, share**_END_POWER, 1.0)


def drawn_at_height(footage: Footage, height: Float[Tensor, " f"]) -> Bool[Tensor, " f"]:
    """Which triangles are in front somewhere in the head of some picture if the mesh is as high as the hair.

    Heights are in metres. Some of the frames are used, evenly spread.
    """
    faces, over = footage.face_model.faces, vertex_means(footage.face_model, height[:, None].expand(-1, 3))[:, 0]

    def drawn_in(frame: Frame) -> Bool[Tensor, " f"]:
        vertices = footage.vertices(frame)
        raised = vertices + over[:, None] * vertex_normals(vertices, faces)
        index = rasterize_mesh(raised, faces, footage.camera(frame)).face_index
        head = torch.from_numpy(footage.scoring(frame)) > 127
        drawn = torch.zeros(len(faces), dtype=torch.bool)
        drawn[index[head & (index >= 0)].long()] = True
        return drawn

    result = torch.zeros(len(faces), dtype=torch.bool)
    for drawn in stream_in_threads(drawn_in, spread_frames(footage.frames, _HEIGHT_FRAMES)):
        result |= drawn
    return result


def beside_shown(
    face_model: FaceModel, vertices: Float[Tensor, "v 3"], shown: Bool[Tensor, " f"]
) -> Bool[Tensor, " f"]:
    """Which triangles are so near to those that pictures show that hair above them is on the outline of some picture.

    The vertices are those of the neutral head, in metres.
    """
    if not bool(shown.any()):
        return torch.zeros_like(shown)
    middles = vertices[face_model.faces.long()].mean(1)
    apart = torch.cdist(middles, middles[shown], compute_mode="donot_use_mm_for_euclid_dist").amin(1)
    return apart < OUTLINE_BAND


def wider_where_faces_move(
    face_model: FaceModel, vertices: Float[Tensor, "v 3"], interior: Bool[Tensor, " f"]
) -> Float[Tensor, " f"]:
    """Factors on the limits to the surface: above 1 at and around lips and lids, and inside the mouth.

    The vertices are those of the neutral head, in metres.
    """
    middles, moving = vertices[face_model.faces.long()].mean(1), face_model.region_mask(*_MOVING)
    if not bool(moving.any()):
        return torch.where(interior, _MOVING_WIDENING, 1.0)
    distances = torch.cdist(middles, middles[moving], compute_mode="donot_use_mm_for_euclid_dist").amin(1)
    close, far = _MOVING_NEAR
    near = smoothstep((far - distances) / (far - close))
    return 1 + (_MOVING_WIDENING - 1) * torch.where(interior, 1.0, near)


def hidden_inside(footage: Footage, interior: Bool[Tensor, " f"]) -> Bool[Tensor, " f"]:
    """Which triangles inside a mouth hardly any picture shows, because lips, cheeks or tongue are in front of them."""

    def shown_in(frame: Frame) -> Bool[Tensor, " f"]:
        hidden = hidden_triangles(footage.vertices(frame), footage.face_model, interior, footage.camera(frame))
        return interior & ~hidden

    looked = spread_frames(footage.frames, _MOUTH_FRAMES)
    sights = torch.zeros(len(interior))
    for shown in stream_in_threads(shown_in, looked):
        sights += shown
    return interior & (sights < _MOUTH_SHOWN_SHARE * len(looked))
