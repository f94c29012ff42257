"""Changes of Gaussians with the expression, of low rank: what a mesh cannot say, such as wrinkles and pressed lips.

A few activations describe the motion of each region of the face, and a few the head's pose (`ExpressionActivations`).
Each Gaussian has a basis, whose product with the activations of its triangle is added to one of its raw values
(`mien.avatar.ops.changed_gaussians`). Not part of any of the three papers.
"""

from itertools import zip_longest
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mien import _native
from mien.arrays import is_native, unpacked
from mien.avatar.ops.regions import region_shares, vertex_motions
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.kernels import on_gpu
from mien.rotation import matrix_from_axis_angle
from mien.runtime.baked import ExpressionChanges, HeadActivations
from mien.runtime.posing import face_activations

_EXPRESSIONS_BEYOND = 1.2
"""How far activations may go, relative to those of the training frames. 98 % of the held-out frames of wojtek go up to
1.14, of d3 up to 1.06, of other clips up to 1.21. With 1, wojtek's held-out frames lose 0.03 dB (11-27)."""
_EXPRESSIONS_LEAST_DEVIATION = 0.1  # smallest deviation that is scaled to 1, relative to that of the first direction

_POSE = 6  # most activations of the head's pose, which has no more directions
_SHIFT = 5.0
"""Weight of a shift of the head by a metre, relative to a turn with a sine of 1."""
MARGIN = 0.1
"""How far activations can get beyond what training saw along them, as a share of it."""
LEAST_SEEN = 1e-6
"""Smallest product with what training saw. Activations of which it saw nothing come to almost 0."""


class ExpressionActivations(nn.Module):
    """How far a face is from the person at rest: for each triangle, a few numbers about its region and the head's pose.

    The inputs are the expression coefficients, followed by the axis-angle vectors of the free joints, in radians. A
    region's activations go along the principal directions of what moves its own vertices, so that a brow does not
    change with the mouth. Around the face, they go along those of the whole face. Coefficients of a tracked clip also
    follow the turns of the head: without activations of its pose, Gaussians learn light and misfit by expressions. Both
    are scaled so that those of the given timesteps have a deviation of 1 or less. They are fixed: training changes only
    the bases of the Gaussians.
    """

    rest: Tensor
    directions: Tensor
    seen: Tensor
    head_rest: Tensor
    head_directions: Tensor
    head_seen: Tensor
    shares: Tensor

    def __init__(self, face_model: FaceModel, face: FaceParams, neutral: FaceParams, count: int):
        """Take `count` numbers for each triangle, a region's and at most `_POSE` of the pose in turn.

        The directions, and the range of the activations, are those of the timesteps of `face`. Directions that the
        timesteps do not have are 0.
        """
        super().__init__()
        shares, motions = region_shares(face_model, neutral), vertex_motions(face_model, neutral)
        rest = expression_inputs(neutral)[0]
        of_pose = min(count // 2, _POSE)
        offsets, own = expression_inputs(face) - rest, count - of_pose
        # What is around the face moves with none of it, and changes with all of it.
        own_motion = shares.unbind(1) if shares.shape[1] == 1 else shares.unbind(1)[:-1]
        roots = [_weighted_root(motions, share) for share in own_motion] + [None] * (shares.shape[1] - len(own_motion))
        parts = [principal_directions(offsets, own, root) for root in roots]
        seen = [_EXPRESSIONS_BEYOND * outermost(offsets @ part) for part in parts]
        moved = head_motion(neutral, face)
        pose = principal_directions(moved, of_pose, torch.diag(moved.new_tensor([1.0] * 3 + [_SHIFT] * 3)))
        values = {
            "rest": rest,
            "directions": torch.cat(parts, 1),
            "seen": torch.block_diag(*seen),
            "head_rest": torch.cat([neutral.head_rotation[0], neutral.head_translation[0]]),
            "head_directions": pose,
            "head_seen": _EXPRESSIONS_BEYOND * outermost(moved @ pose),
            "shares": shares[face_model.faces].mean(1),
        }
        for name, value in values.items():
            self.register_buffer(name, value.detach().clone().contiguous())
        self._compiled: tuple[list[tuple[int, int]], list[Tensor], _native.FaceActivations] | None = None

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *others: Any) -> None:
        # The number of rows comes from the frames, which are not there when an avatar is loaded.
        for name in ("seen", "head_seen"):
            seen = state_dict.get(prefix + name)
            if seen is not None and seen.shape[1:] == getattr(self, name).shape[1:]:
                setattr(self, name, getattr(self, name).new_empty(seen.shape))
        super()._load_from_state_dict(state_dict, prefix, *others)

    @torch.no_grad()
    def forward(self, face: FaceParams) -> Float[Tensor, "f a"]:
        """The activations of each triangle at one timestep. They have no gradient; native for float32 on a CPU."""
        parts = (face.expression, face.joints, face.head_rotation, face.head_translation)
        if on_gpu(self.rest, *parts):
            from mien.avatar.ops.expression_changes_gpu import activation_table

            return activation_table(self, face, MARGIN, LEAST_SEEN)
        if not is_native(self.rest, *parts):
            return self.reference(face)
        buffers = [*self.buffers()]
        versions = [(id(buffer), buffer._version) for buffer in buffers]
        if self._compiled is None or self._compiled[0] != versions:
            self._compiled = versions, buffers, face_activations(self.record())
        known = self._compiled[2]
        table = torch.empty(_native.activation_shape(known))
        _native.activation_table(known, *unpacked(*parts, table))
        return table

    def reference(self, face: FaceParams) -> Float[Tensor, "f a"]:
        """`forward` in plain PyTorch, any dtype and device."""
        regions = self.shares.shape[1]
        block = self.directions.shape[1] // regions
        found = ((expression_inputs(face)[0] - self.rest) @ self.directions).view(regions, block)
        own = within_seen(found, self.seen.view(-1, regions, block))
        at_rest = FaceParams(
            face.identity, face.expression, face.joints, self.head_rest[None, :3], self.head_rest[None, 3:]
        )
        pose = within_seen(head_motion(at_rest, face) @ self.head_directions, self.head_seen)
        table = torch.cat([own, pose.expand(regions, -1)], 1)
        own, of_pose = range(block), range(block, table.shape[1])
        order = [column for pair in zip_longest(own, of_pose) for column in pair if column is not None]
        return self.shares @ table[:, order]

    def record(self) -> ExpressionChanges:
        """The activations as a runtime takes them, without anything that they change."""
        arrays = {name: buffer.detach().cpu().numpy() for name, buffer in self.named_buffers()}
        head = HeadActivations(arrays["head_rest"], arrays["head_directions"], arrays["head_seen"])
        return ExpressionChanges(
            arrays["rest"], arrays["directions"], arrays["seen"], shares=arrays["shares"], head=head
        )


def head_motion(neutral: FaceParams, face: FaceParams) -> Float[Tensor, "b 6"]:
    """How the head moved from its pose at rest: sines of turns about its own axes there, then its shift, in metres."""
    at_rest = matrix_from_axis_angle(neutral.head_rotation[0])
    turn = at_rest.T @ matrix_from_axis_angle(face.head_rotation)
    sines = torch.stack(
        [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], 1
    )
    return torch.cat([sines / 2, (face.head_translation - neutral.head_translation[0]) @ at_rest], 1)


def expression_inputs(face: FaceParams) -> Float[Tensor, "b i"]:
    """The expression coefficients, followed by the axis-angle vectors of the free joints, in radians."""
    return torch.cat([face.expression, face.joints.flatten(1)], dim=-1)


def _weighted_root(motions: Float[Tensor, "i v 3"], share: Float[Tensor, " v"]) -> Float[Tensor, "i i"]:
    """The root of the products of the inputs' motions: the square of an input through it is that of what it moves."""
    moved = (motions.double().cpu() * share.double().cpu().sqrt()[:, None]).flatten(1)
    values, vectors = torch.linalg.eigh(moved @ moved.T)
    return vectors @ torch.diag(values.clamp_min(0).sqrt()) @ vectors.T


def principal_directions(
    offsets: Float[Tensor, "t i"], rank: int, root: Float[Tensor, "i i"] | None = None
) -> Float[Tensor, "i r"]:
    """Directions of the largest spread, strongest first. Along each, the timesteps have a deviation of 1 or less.

    With `root`, the spread is that of the offsets times it, which says what each of them does.
    """
    if rank == 0:
        return offsets.new_zeros(offsets.shape[1], 0)
    exact, scale = offsets.detach().double().cpu(), None if root is None else root.double().cpu()
    exact = exact if scale is None else exact @ scale
    centered = exact - exact.mean(0)
    strengths, vectors = torch.linalg.eigh(centered.T @ centered / len(centered))
    count = min(rank, len(strengths))
    deviations, vectors = strengths.flip(0)[:count].clamp_min(0).sqrt(), vectors.flip(1)[:, :count]
    largest = vectors.gather(0, vectors.abs().argmax(0, keepdim=True))
    usable = deviations > 1e-6
    scales = deviations.clamp_min(max(_EXPRESSIONS_LEAST_DEVIATION * float(deviations[0]), 1e-6))
    directions = exact.new_zeros(len(vectors), rank)
    directions[:, :count] = vectors * largest.sign() * usable / scales
    return (directions if scale is None else scale @ directions).to(offsets)


def outermost(activations: Float[Tensor, "t r"]) -> Float[Tensor, "s r"]:
    """Those of some activations that go furthest along at least one of them, in their order."""
    exact = activations.detach().double().cpu()
    return activations[(exact @ exact.T).argmax(0).unique().to(activations.device)]


def within_seen(values: Float[Tensor, "b r"], seen: Float[Tensor, "s ... r"]) -> Float[Tensor, "b r"]:
    """`values`, but where they are longer than any row of `seen` goes along them: there they get shorter.

    With l the furthest that a row of `seen` goes along them, the new length approaches (1 + `MARGIN`) l and never gets
    there. Its slope is continuous. The rows of `seen` are not shortened. If there are none, nothing is.

    A limit of the length alone does not hold one strong expression: in r directions of deviation 1, usual activations
    have the length sqrt(r), which is far beyond what was filmed along any single direction.
    """
    if not len(seen):
        return values
    products = torch.einsum("br,sbr->bs", values, seen) if seen.ndim == 3 else values @ seen.T
    furthest = products.amax(-1, keepdim=True).clamp_min(LEAST_SEEN)
    ratio = values.square().sum(-1, keepdim=True) / furthest
    over = (ratio - 1).clamp_min(0)
    shortened = (1 + MARGIN * over / (MARGIN + over)) / ratio.clamp_min(1)
    return values * torch.where(over > 0, shortened, 1.0)
