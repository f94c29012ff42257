"""Fit a torso to the shoulders that MediaPipe's pose network finds: one rigid pose a frame, and one build a person.

Two points do not tell a rigid pose, so the rest comes from the body: the torso hangs on a head whose pose is known,
moves smoothly in the room, and has the shoulders of a person with this head.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from mien.camera import Camera
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.face.torso import TorsoPose, build_directions, motion_of, torso_origin, with_torso
from mien.rotation import matrix_from_axis_angle
from mien.tracking.landmarks.clothes import Clothes

SHOULDERS = (11, 12)
"""Points of the pose network: the left and the right shoulder of the person."""
_ITERATIONS = 300
_START_TURN = 0.3  # share of the head's turn that the torso is expected to have


@dataclass(frozen=True)
class TorsoPriors:
    """Standard deviations of what is known before a picture is seen. Set by what bodies do, not tuned."""

    pixels: float = 0.02
    """Of a shoulder's place in the picture, in shoulder widths."""
    shift: float = 0.015
    """Of the torso's shift against the head, in metres: a neck is neither longer nor shorter than itself."""
    turn: float = 0.5
    """Of its turn against the head, about each axis, in radians."""
    still: float = 0.1
    """Of its turn in the room against the pose that it has most, in radians."""
    facing: tuple[float, float, float] = (0.15, 0.15, 0.07)
    """Of that pose against a share of the mean of the head's, in radians: who turns aside turns the head most, and
    shoulders are about level."""
    acceleration: float = 1.0
    """In metres per second squared."""
    angular_acceleration: float = 3.0
    """In radians per second squared."""
    sights: float = 0.01
    """Of a point on clothes in the picture, in shoulder widths. Clothes slide and fold."""
    clothes: float = 0.02
    """Of such a point's distance from where the mesh has it, in metres."""
    response: float = 0.015
    """Of the distance between the network's shoulders and the model's, the same in all frames and for both sides, in
    metres."""
    uneven: tuple[float, float] = (0.02, 0.01)
    """Of both together to one side, and of one upwards and the other downwards, in metres."""

    @property
    def responses(self) -> tuple[float, ...]:
        """Those of all parts of the response: `response` of each axis, then `uneven`."""
        return (*[self.response] * 3, *self.uneven)


def fit_torso(
    model: FaceModel,
    face: FaceParams,
    camera: Camera,
    points: Float[Tensor, "b 33 4"],
    timestamps: Float[Tensor, " b"],
    known_build: Float[Tensor, " n"] | None = None,
    clothes: Clothes | None = None,
    priors: TorsoPriors = TorsoPriors(),
) -> FaceParams:
    """Return the same faces with a torso and a build that fit the points (x and y in pixels, z, visibility).

    The world is one in which a head that faces the camera has a rotation of about zero. Frames without points have NaN.
    z is not used: the network guesses turns of 40 degrees that are not there. The build is what the identity has beyond
    the directions of the head, which stay as they are. A known build stays, too. Points on clothes tell turns that
    shoulders do not.
    """
    like = torch.zeros((), dtype=torch.float64)
    model, face, camera = model.to(like), face.to(like), camera.to(like)
    seen, times = points[:, SHOULDERS].to(like), timestamps.to(like)
    build = build_directions(model)
    upright = matrix_from_axis_angle(face.head_rotation)
    at_rest = face.head_translation + (upright @ torso_origin(model, face)[:, None])[:, :, 0]
    # Every unknown counts in its prior's unit, so that the descent sees a round valley.
    starts = (
        _START_TURN * face.head_rotation,
        at_rest,
        face.identity[build] if known_build is None else known_build.to(like),
        like.new_zeros(5),
        _START_TURN * face.head_rotation.mean(0),
        like.new_zeros(0, 3) if clothes is None else clothes.places.to(like),
    )
    free_build = 1.0 if known_build is None else 0.0
    responses, facing = (like.new_tensor(own) for own in (priors.responses, priors.facing))
    scales = priors.still, priors.shift, free_build, responses, facing, priors.clothes
    unknown = [torch.zeros_like(value).requires_grad_() for value in starts]
    optimizer = torch.optim.LBFGS(unknown, max_iter=_ITERATIONS, history_size=30, line_search_fn="strong_wolfe")
    cost = _cost_of(model, face, camera, (seen, times), priors)
    cloth_cost = None if clothes is None else _cost_of_clothes(clothes, camera, _width(seen), priors)

    def values() -> list[Tensor]:
        return [value + scale * step for value, scale, step in zip(starts, scales, unknown, strict=True)]

    def closure() -> Tensor:
        optimizer.zero_grad()
        *first, points_on_clothes = values()
        value = cost(*first)
        if cloth_cost is not None:
            value = value + cloth_cost(first[0], first[1], points_on_clothes)
        value.backward()
        return value

    with torch.enable_grad():
        optimizer.step(closure)  # pyright: ignore[reportArgumentType]
    turn, place, own, *_ = (value.detach() for value in values())
    face = replace(face, identity=torch.cat([face.identity[: build.start], own]))
    return with_torso(model, face, TorsoPose(turn, place)).to(torch.zeros(()))


def _cost_of(
    model: FaceModel, face: FaceParams, camera: Camera, given: tuple[Tensor, Tensor], priors: TorsoPriors
) -> Callable[..., Tensor]:
    """Return the sum of squares of a turn, a place, a build, a response and a mean turn in terms of the priors."""
    seen, times = given
    visible = seen[..., 3].clamp(0, 1).nan_to_num(0.0)
    there = seen[..., :2].nan_to_num(0.0)
    width = _width(seen)
    steps = 0.5 * (times[2:] - times[:-2])
    mirror = torch.tensor([[1.0, 1.0, 1.0], [-1.0, 1.0, 1.0]]).to(times)
    shoulders, build = model.landmarks["shoulders"], build_directions(model)
    origin = torso_origin(model, face)  # No build moves it.
    responses, facing = (times.new_tensor(own) for own in (priors.responses, priors.facing))
    ahead = _START_TURN * face.head_rotation.mean(0)

    def pairs_of(vertices: Tensor) -> Tensor:
        """Return the shoulders, each the mean of two points."""
        found = shoulders.positions(vertices, model.faces)
        return found.reshape(*found.shape[:-2], 2, 2, 3).mean(-2)

    known = face.identity.clone()
    known[build] = 0
    rest = pairs_of(model.rest_vertices(replace(face, identity=known)))
    directions = pairs_of(model.identity_basis[build])

    def cost(turn: Tensor, place: Tensor, own: Tensor, response: Tensor, most: Tensor) -> Tensor:
        local = rest + torch.einsum("i,ikc->kc", own, directions) - origin + mirror * response[:3]
        local = local + torch.stack([response[3].expand(2), mirror[:, 0] * response[4], 0 * mirror[:, 0]], 1)
        world = local @ matrix_from_axis_angle(turn).mT + place[:, None]
        off = (camera.project(world)[0] - there) / (priors.pixels * width)
        # Cauchy: a shoulder that is far off is a wrong one.
        total = (visible * torch.log1p((off * off).sum(-1))).sum()
        relative, shift = motion_of(TorsoPose(turn, place), face, origin)
        # Twice the sine of half the angle: it is smooth where an angle is not.
        turned = 0.5 * (relative - torch.eye(3).to(relative)).square().sum()
        total = total + (shift / priors.shift).square().sum() + turned / priors.turn**2
        total = total + ((turn - most) / priors.still).square().sum() + ((most - ahead) / facing).square().sum()
        for path, sigma in ((place, priors.acceleration), (turn, priors.angular_acceleration)):
            bend = (path[2:] - 2 * path[1:-1] + path[:-2]) / steps[:, None] ** 2
            total = total + (bend / sigma).square().sum()
        return total + own.square().sum() + (response / responses).square().sum()

    return cost


def _width(seen: Float[Tensor, "b 2 4"]) -> Tensor:
    """Return the distance between the shoulders in pixels, as the median over the frames that show both."""
    there, visible = seen[..., :2].nan_to_num(0.0), seen[..., 3].nan_to_num(0.0)
    return (there[:, 0] - there[:, 1]).norm(dim=1)[visible.amin(1) > 0.5].median()


def _cost_of_clothes(clothes: Clothes, camera: Camera, width: Tensor, priors: TorsoPriors) -> Callable[..., Tensor]:
    """Return the cost of points on clothes in terms of the priors, of the torso's turns and places and the points."""
    known, pixels = clothes.places.to(camera.K), clothes.pixels.to(camera.K)

    def cost(turn: Tensor, place: Tensor, points: Tensor) -> Tensor:
        rotations = matrix_from_axis_angle(turn)[clothes.frame]
        world = (rotations @ points[clothes.point][:, :, None])[:, :, 0] + place[clothes.frame]
        off = (camera.project(world)[0] - pixels) / (priors.sights * width)
        return torch.log1p((off * off).sum(-1)).sum() + ((points - known) / priors.clothes).square().sum()

    return cost
