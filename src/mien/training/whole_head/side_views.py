"""Training pictures that no camera took: the head from the side, and with raised expressions.

One camera in front shows half of a head at a few expressions. Between its pictures, Gaussians may do as they like: they
leave the surface, and show as shards and holes once the head turns. A side view is compared with the completed mesh:
from the side, the head is opaque exactly where the mesh with its hair is, above the cut at the neck, and colours are
pulled towards those of the mesh. In raised expressions, a difference that a real head could have is free.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from mien.avatar.avatar import Avatar, Posed
from mien.avatar.settings import Progress
from mien.camera import Camera
from mien.face.head_parts import head_parts
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.machine import exact
from mien.machine.devices import fetch, upload
from mien.render import rasterize
from mien.render.mesh import rasterize_mesh, vertex_normals
from mien.runtime.rotation import axis_angle_from_matrix, matrix_from_axis_angle
from mien.tracking.neck_cut import NeckParts, fit_neck_cut
from mien.tracking.scoring import head_mask
from mien.training.footage.sequence import composite
from mien.training.losses import alpha_loss, color_loss
from mien.training.whole_head.completion import vertex_means
from mien.training.whole_head.unseen import Unseen

_SIDE_VIEWS_EVERY = 8
"""Number of steps between two side views. Views of raised expressions take turns with those from the side. Measured: 16
with twice the weights has the same PSNR, but 2 to 9 % more ST-LPIPS from the side (log, 11-27)."""
_SIDE_VIEWS_SIZE = 256  # longer side of these pictures, in pixels: the completed colours are no finer
_SIDE_VIEWS_LEAST_ANGLE = 45.0  # smallest angle by which the head turns to the side, in degrees
_SIDE_VIEWS_MOST_ANGLE = 180.0  # largest such angle. Geometry: the back of the head
_RAISED_MOST_ANGLE = 45.0  # largest angle at which a raised expression is seen, in degrees
_RAISED_COEFFICIENTS = 6  # number of coefficients that are raised
_RAISED_FREE_DIFFERENCE = 0.06
"""Difference of colour (0..1) between an avatar and the completed mesh that costs nothing in raised expressions. The
mesh knows neither hair nor pores."""
_RAISED_CHANGE_WEIGHT = 8.0
"""Factor on the method's penalty of changes with the expression, in raised ones. Measured on d3: without it, skin is
blotched; 80 has 0.35 dB less in front (log, 11-26)."""
_SIDE_VIEWS_OUTLINE_WEIGHT = 3.0
"""Weight of the difference of alpha from the side against that of colours. Most errors from the side are at the
outline. Measured: 10 has 0.4 dB less at 30 degrees, 1 has 0.3 less at 90 (log, 11-24)."""


@dataclass(frozen=True, eq=False)
class SideView:
    """A side view and the pictures that it is compared with, which are on the CPU."""

    face: FaceParams
    """The turned head, or the raised expression. It has no gradient."""
    raised: bool
    """Whether the expression is raised."""
    camera: Camera
    background: Float[Tensor, " 3"]
    picture: UInt8[Tensor, "h w 3"]
    """The completed mesh over the background."""
    matte: UInt8[Tensor, "h w"]
    """Its opacity."""
    compared: Bool[Tensor, "h w"]
    """Pixels that show triangles of `SideViews.compared`."""

    def to(self, like: Tensor) -> "SideView":
        """This view on the device of `like`, with its float dtype, without waiting."""
        face = FaceParams(**{name: upload(own, like) for name, own in self.face.tensors().items()})
        camera = replace(self.camera, K=upload(self.camera.K, like), viewmat=upload(self.camera.viewmat, like))
        pictures = (upload(own, like) for own in (self.background, self.picture, self.matte, self.compared))
        return SideView(face, self.raised, camera, *pictures)


@dataclass(frozen=True, eq=False)
class SideViews:
    """The completed head that side views are compared with. All tensors are on the CPU."""

    face_model: FaceModel
    weight: float
    """Weight of the mean absolute differences of colour and of alpha."""
    colors: Float[Tensor, "f 3"]
    """Completed colours of the triangles, 0..1."""
    height: Float[Tensor, " v"]
    """Height of the surface above each vertex, in metres."""
    neck: NeckParts
    """The parts of the neck that tell where it is cut."""
    compared: Bool[Tensor, " f"]
    """Triangles whose colours are compared in raised expressions: skin, lips and the inside of the mouth."""
    head_faces: Int[Tensor, "n 3"]
    """The face model's triangles without those of the neck."""
    subject: FaceParams | None = None
    """The person, for faces that are on a GPU."""
    opacities: Float[Tensor, " f"] | None = None
    """Opacities of the triangles of a bust that is not cut. None: it is cut at the neck."""
    held: Bool[Tensor, " f"] | None = None
    """`compared` on the device of the avatar. None for the CPU."""

    def at_height(self, height: Float[Tensor, " f"]) -> "SideViews":
        """The same views of a head whose triangles have another height, in metres."""
        return replace(self, height=_at_vertices(self.face_model, height.to(self.colors)))

    def due(self, step: int) -> bool:
        """Whether a step has a side view."""
        return self.weight > 0 and step % (_SIDE_VIEWS_EVERY // 2) == 0

    @torch.no_grad()
    def drawn(self, face: FaceParams, camera: Camera, step: int, random: torch.Generator) -> Callable[[], SideView]:
        """A function that makes the side view of a step. It does not depend on the avatar, and any thread may call it.

        The joints and the place of a face are kept, and so is its expression in views from the side. The step says
        whether the head is turned or the expression raised.
        """
        raised = step % _SIDE_VIEWS_EVERY != 0
        angle = _drawn_angle(raised, random)
        face, up = turned_to_side(face, angle)
        if raised:
            face = replace(face, expression=self.raised(face.expression, random))
        scale = _SIDE_VIEWS_SIZE / max(camera.width, camera.height)
        small = camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
        background = torch.randint(256, (3,), generator=random).numpy().astype(np.uint8)
        # Threads share the core's pool, and a loop of one makes those of the other serial. So the mesh is posed here.
        posed = self.face_model(face.to(self.colors))[0]

        @torch.no_grad()
        def make() -> SideView:
            over = torch.from_numpy(background.astype(np.float32) / 255)
            return SideView(face, raised, small, over, *self._pictures(posed, up, small, background))

        return make

    def fetched(
        self, face: FaceParams, camera: Camera, step: int, random: torch.Generator, height: Float[Tensor, " f"]
    ) -> Callable[[], SideView]:
        """`drawn` for a face and heights of triangles on a GPU. The returned function waits for them."""
        parts = (face.expression, face.joints, face.head_rotation, face.head_translation, height)
        fetching = fetch(torch.cat([own.detach().flatten() for own in parts]))

        @torch.no_grad()
        def make() -> SideView:
            flat = fetching().split([own.numel() for own in parts])
            expression, joints, rotation, translation, raised = (
                own.view(part.shape) for own, part in zip(flat, parts, strict=True)
            )
            assert self.subject is not None
            own = replace(self.subject, expression=expression, joints=joints, head_rotation=rotation)
            own, views = replace(own, head_translation=translation), self.at_height(raised)
            view = views.drawn(own, camera, step, random)()
            # The same tensor of the identity says that the person's shape at rest need not be computed again.
            whole = replace(view.face, identity=face.identity, vertex_offsets=face.vertex_offsets)
            return replace(view, face=whole).to(face.expression)

        return make

    def loss(self, avatar: Avatar, view: SideView, progress: Progress) -> Float[Tensor, ""]:
        """The weighted difference between the avatar and the completed mesh in one side view."""
        like = avatar.face_model.template
        view = replace(view.to(like), face=view.face)
        posed = avatar.pose(view.face, progress)
        seen = rasterize(posed.gaussians.timestep(0), view.camera, view.background)
        if view.raised:
            own = color_loss(seen.image, view.picture, self.weight, _RAISED_FREE_DIFFERENCE, view.compared)
            return own + _held_back(avatar, posed, self.compared if self.held is None else self.held)
        outline = alpha_loss(seen.alpha, view.matte, self.weight * _SIDE_VIEWS_OUTLINE_WEIGHT)
        return color_loss(seen.image, view.picture, self.weight) + outline

    def _pictures(
        self,
        vertices: Float[Tensor, "v 3"],
        up: Float[Tensor, " 3"],
        camera: Camera,
        background: UInt8[np.ndarray, " 3"],
    ) -> tuple[UInt8[Tensor, "h w 3"], UInt8[Tensor, "h w"], Bool[Tensor, "h w"]]:
        """Picture, matte and compared pixels, given the posed mesh and the head's upright axis in the world."""
        camera, faces = camera.to(self.colors), self.face_model.faces
        raised = vertices + self.height[:, None] * vertex_normals(vertices, faces)
        index = rasterize_mesh(raised, faces, camera).face_index.numpy()
        drawn = np.where(index >= 0, 255, 0).astype(np.uint8)
        triangle = np.maximum(index, 0)
        if self.opacities is None:
            matte = head_mask(drawn, camera, vertices, self.head_faces, fit_neck_cut(self.neck, vertices, up))
        else:
            matte = np.rint(drawn * self.opacities.numpy()[triangle]).astype(np.uint8)
        picture = composite(self._bytes_of_colors[triangle], matte, background)
        compared = self.compared.numpy()[triangle] & (matte > 0)
        return torch.from_numpy(picture), torch.from_numpy(matte), torch.from_numpy(compared)

    @cached_property
    def _bytes_of_colors(self) -> UInt8[np.ndarray, "f 3"]:
        return np.rint(255 * self.colors.numpy()).astype(np.uint8)

    def raised(self, expression: Float[Tensor, "1 e"], random: torch.Generator) -> Float[Tensor, "1 e"]:
        """The expression with some coefficients anywhere between 0 and their largest value."""
        count = expression.shape[1]
        chosen = torch.randperm(count, generator=random)[:_RAISED_COEFFICIENTS]
        values = torch.rand(len(chosen), generator=random) * self.face_model.expression_bounds[chosen, 1].float().cpu()
        result = expression.clone()
        result[0, chosen.to(expression.device)] = values.to(expression)
        return result


def side_views(
    face_model: FaceModel, weight: float, colors: Float[Tensor, "f 3"], height: Float[Tensor, " f"]
) -> SideViews:
    """The side views of a head with completed colours, 0..1, and heights of the surface above triangles, in metres.

    All is on the CPU in float32.
    """
    parts, over = head_parts(face_model), _at_vertices(face_model, height)
    compared = parts.skin | parts.interior | torch.stack(parts.painted).any(0)
    head_faces = face_model.faces[~face_model.region_mask("neck")]
    return SideViews(face_model, weight, colors, over, NeckParts.of(face_model), compared, head_faces)


def _at_vertices(face_model: FaceModel, values: Float[Tensor, " f"]) -> Float[Tensor, " v"]:
    return vertex_means(face_model, values[:, None].expand(-1, 3))[:, 0]


def side_views_of(face_model: FaceModel, subject: FaceParams, unseen: Unseen | None, weight: float) -> SideViews | None:
    """The side views of a filled head, or None if nothing is filled or the weight is 0. All is on the CPU."""
    if unseen is None or unseen.prior.filled_in is None or weight == 0:
        return None
    model, prior = face_model, unseen.prior
    like = model.template.new_zeros((), device="cpu", dtype=torch.float32)
    assert prior.colors is not None
    views = side_views(model.to(like), weight, prior.colors.to(like), prior.fill_height.to(like))
    opacities = None if prior.opacities is None else prior.opacities.to(like)
    return replace(views, subject=subject.to(like), opacities=opacities)


def _held_back(avatar: Avatar, posed: Posed, compared: Bool[Tensor, " f"]) -> Float[Tensor, ""] | float:
    """Return the cost of changes that the mesh does not make, in an expression that nobody filmed.

    Only skin, lips and the inside of the mouth are held back. Hair moves with the head and the shoulders, which the
    activations of the face tell, too.

    The mesh is a better guess there. Filmed expressions come together, so without this cost, raising one of them alone
    also brings the shadows of the others.
    """
    surface = avatar.extras.surface
    penalty = None if surface is None else surface.change_penalty(posed.aux, compared)
    return 0.0 if penalty is None else _RAISED_CHANGE_WEIGHT * penalty


def turned_to_side(face: FaceParams, angle: float) -> tuple[FaceParams, Float[Tensor, " 3"]]:
    """The head turned about its own upright axis by an angle in radians, at the same place; and this axis in the world.

    A camera sees it as one that goes around the head by this angle. The face has no gradient. Its identity is the same
    tensor, which says that the person's shape at rest need not be computed again.
    """
    before = matrix_from_axis_angle(face.head_rotation.detach().cpu().numpy()[0])
    rotation = exact.product(before, matrix_from_axis_angle(np.array([0.0, angle, 0.0])))
    turned = torch.from_numpy(axis_angle_from_matrix(rotation)[None]).to(face.head_rotation)
    fields = {name: getattr(face, name).detach() for name in ("expression", "joints", "head_translation")}
    return replace(face, head_rotation=turned, **fields), torch.from_numpy(rotation[:, 1])


def _drawn_angle(raised: bool, random: torch.Generator) -> float:
    share, side = torch.rand(2, generator=random, dtype=torch.float64).tolist()
    aside = (_SIDE_VIEWS_LEAST_ANGLE, _SIDE_VIEWS_MOST_ANGLE)
    low, high = (0.0, _RAISED_MOST_ANGLE) if raised else aside
    degrees = low + share * (high - low)
    return math.radians(degrees if side < 0.5 else -degrees)
