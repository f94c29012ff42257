"""The motion of free points: from the canonical face to others, by a network, and losses that keep it near a mesh.

Points deform by blend directions and skinning weights that the network says about their positions. Beside the face
model's joints there is one more bone, which stands still in the world while the head moves.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from torch import Tensor

from mien.arrays import is_native
from mien.avatar.baked_pose import Kept
from mien.avatar.baking import as_array
from mien.avatar.mono_gaussian_avatar.networks import DeformationNet
from mien.avatar.mono_gaussian_avatar.settings import LENGTH_UNIT
from mien.avatar.ops.skin_points import blend_transforms, skin_points, unskin
from mien.avatar.surface_places import at_places, random_places
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.rotation import matrix_from_axis_angle, rigid_transform
from mien.runtime.baked import Rig

CANONICAL_JAW = 0.4  # angle by which the jaw is open in the canonical face, in radians. As published (log, 11-23)
_PRETRAINING_POINTS = 1024  # points of a step of pre-training on the face model's motion
_PRETRAINING_FRAMES = 4  # frames of such a step
_PRETRAINING_RATE = 3e-3  # learning rate of its first step. It falls to a tenth
_PRETRAINING_WEIGHT = 100.0
"""Weight of the distance between points and their places on the moved mesh, beside the losses that keep the networks
near the face model."""

POINTS_AT_ONCE = 4096
"""Number of points whose distances to all vertices are in memory at once: 74 MB for a face model of 4,535 vertices."""


class AtRest(NamedTuple):
    """The canonical face."""

    vertices: Float[Tensor, "v 3"]
    transforms: Float[Tensor, "k 3 4"]
    coefficients: Float[Tensor, "1 c"]


class BakedMotion(NamedTuple):
    """The points in the form that `mien.runtime` moves."""

    rig: Rig
    to_rest: Float[Tensor, "n 3"]
    """From each point's canonical position to its place in the rig."""
    still_weights: Float32[np.ndarray, " n"]
    still_pose: Float32[np.ndarray, "4 4"]


class FaceWeights(NamedTuple):
    """Weights of the losses near the face model."""

    skinning: float
    expression: float
    correctives: float
    variance: Float[Tensor, " e"]
    """Variance of each expression coefficient over the training frames."""
    by_variance: bool
    """Whether a coefficient's term is divided by its variance, relative to the mean of all, and by their number."""


@dataclass(frozen=True, eq=False)
class PointMotion:
    """The motion of one avatar's points."""

    face_model: FaceModel
    subject: FaceParams
    network: DeformationNet
    expression: Float[Tensor, " e"]
    """Expression of the canonical face."""
    joints: Float[Tensor, "j 3"]
    """Joints of the canonical face."""
    kept: Kept[AtRest]
    """Keeps what depends on the canonical face alone."""

    def canonical_face(self) -> FaceParams:
        """The canonical expression and joints, at the subject's usual head pose."""
        return replace(self.subject, expression=self.expression[None], joints=self.joints[None])

    def transforms(self, face: FaceParams) -> Float[Tensor, "b k 3 4"]:
        """The joints' transforms in the head frame, then that of the bone which stands still in the world."""
        still = _inverse(face.T_world_head) @ self.canonical_face().T_world_head
        return torch.cat([self.face_model.joint_transforms(face), still[:, None]], dim=1)[:, :, :3]

    def at_rest(self) -> AtRest:
        """What depends on the canonical face alone."""

        @torch.no_grad()
        def make() -> AtRest:
            face = self.canonical_face()
            vertices, transforms = self.face_model.head_vertices(face)[0], self.transforms(face)[0]
            return AtRest(vertices, transforms, self.coefficients(face, absolute=True))

        return self.kept.of((self.expression, self.joints, *self.subject.tensors().values()), make)

    def coefficients(self, face: FaceParams, absolute: bool = False) -> Float[Tensor, "b c"]:
        """Weights of the blend directions: less those of the canonical face, or as they are (`absolute`)."""
        own = torch.cat([face.expression, _pose_features(face)], dim=1)
        return own if absolute else own - self.at_rest().coefficients

    def deformed(
        self, means: Float[Tensor, "n 3"], face: FaceParams
    ) -> tuple[Float[Tensor, "b n 3"], Float[Tensor, "b n 3"]]:
        """Points in the head frame, and their motion from the canonical positions, both in metres."""
        offset, moved, weights = self.network(means / LENGTH_UNIT, self.coefficients(face))
        canonical = means + LENGTH_UNIT * offset
        at_rest = self.at_rest().transforms
        posed = skin_points(canonical, LENGTH_UNIT * moved, weights, at_rest, self.transforms(face))
        return posed, posed - canonical

    def face_losses(self, means: Float[Tensor, "p 3"], known: FaceWeights) -> dict[str, Float[Tensor, ""]]:
        """Distances of some points' skinning weights and directions from those of the nearest canonical vertex.

        The squared difference of an expression direction is multiplied by the mean variance of all coefficients over
        the training frames. Nearest vertices are found in each step, because points move: of points that have moved by
        a millimetre, 12 % have another one. For the paper's 100,000 points they take 4 % of the time of these losses.
        """
        model = self.face_model
        found = self.network.whole(means / LENGTH_UNIT)
        canonical = means + LENGTH_UNIT * found.offset.detach()
        nearest = nearest_vertices(canonical, self.at_rest().vertices)
        # The bone that stands still belongs to no vertex.
        weights = torch.nn.functional.pad(model.skinning_weights[nearest], (0, 1))
        losses = {"skinning": known.skinning * _mean_square(found.weights - weights)}
        difference = found.expression - model.expression_basis[:, nearest].permute(1, 2, 0) / LENGTH_UNIT
        unit = known.variance.mean().clamp_min(1e-8)
        if known.by_variance:
            # Coefficients that never moved would otherwise have an infinite weight.
            unit = unit / ((known.variance / unit).clamp_min(0.01) * len(known.variance))
        losses["expression_directions"] = known.expression * _mean_square(difference * unit.sqrt())
        if found.pose.shape[-1] > 0:
            basis = model.pose_basis
            correctives = 0 if basis is None else basis[:, nearest].permute(1, 2, 0) / LENGTH_UNIT
            losses["pose_correctives"] = known.correctives * _mean_square(found.pose - correctives)
        return losses

    def baked(self, means: Float[Tensor, "n 3"], rig: Rig) -> BakedMotion:
        """The points as those of a rig with blend directions and skinning weights."""
        found = self.network.whole(means / LENGTH_UNIT)
        expression, pose = LENGTH_UNIT * found.expression, LENGTH_UNIT * found.pose
        face = self.canonical_face()
        canonical = means + LENGTH_UNIT * found.offset
        skinning = blend_transforms(found.weights, self.transforms(face))[0]
        coefficients = self.coefficients(face, absolute=True)
        rest = unskin(canonical, skinning) - torch.cat([expression, pose], dim=-1) @ coefficients[0]
        moved = replace(
            rig,
            template=as_array(rest),
            expression_basis=as_array(expression.permute(2, 0, 1)),
            skinning_weights=as_array(found.weights[:, :-1]),
            pose_basis=as_array(pose.permute(2, 0, 1)),
        )
        still = (as_array(found.weights[:, -1]), as_array(face.T_world_head[0]))
        return BakedMotion(moved, rest - canonical, *still)

    def learn(self, face: FaceParams, steps: int, known: FaceWeights) -> Iterator[None]:
        """Teach the network the face model's motion in training frames, before the first picture."""
        optimizer = torch.optim.Adam(self.network.parameters(), lr=_PRETRAINING_RATE)
        canonical, faces = self.at_rest().vertices, self.face_model.faces
        for step in range(steps):
            optimizer.param_groups[0]["lr"] = _PRETRAINING_RATE * 0.1 ** (step / steps)
            frames = face[torch.randint(len(face), (_PRETRAINING_FRAMES,))].detach()
            corners, weights = random_places(canonical, faces, _PRETRAINING_POINTS)
            means = at_places(canonical, corners, weights)
            target = at_places(self.face_model.head_vertices(frames), corners, weights)
            found, _ = self.deformed(means, frames)
            distance = (found - target).norm(dim=-1).mean() / LENGTH_UNIT
            optimizer.zero_grad()
            losses = self.face_losses(means, known)
            torch.autograd.backward([_PRETRAINING_WEIGHT * distance, *losses.values()])
            optimizer.step()
            yield


def canonical_face(
    model: FaceModel, expression: Float[Tensor, " e"]
) -> tuple[Float[Tensor, " e"], Float[Tensor, "j 3"]]:
    """An expression and joints at which the jaw is open by `MONO.canonical_jaw`.

    A free jaw turns by this angle. A jaw that follows the expression gets it from the coefficient that opens it most.
    Other joints are at rest. A model without a joint `jaw` keeps its jaw.
    """
    joints = expression.new_zeros(len(model.free_joint_names), 3)
    if "jaw" in model.free_joint_names:
        joints[model.free_joint_names.index("jaw"), 0] = CANONICAL_JAW
    elif "jaw" in model.joint_names:
        opening = model.joint_rotation_basis[:, model.joint_names.index("jaw"), 0].to(expression)
        best = opening.argmax()
        if opening[best] > 0:
            expression = expression.clone()
            expression[best] += (CANONICAL_JAW - expression @ opening) / opening[best]
    return expression, joints


@torch.no_grad()
def nearest_vertices(points: Float[Tensor, "n 3"], vertices: Float[Tensor, "v 3"]) -> Int[Tensor, " n"]:
    """The index of the vertex nearest to each point.

    On a CPU, a tree of the vertices finds it in 1/25 of the time that all distances take. Elsewhere, points are looked
    at in parts: all 100,000 of the paper at once would need 1.8 GB for their distances.
    """
    if is_native(points, vertices):
        from scipy.spatial import KDTree

        # A tree refuses numbers that are not finite, which the run reports later, in words for users.
        _, nearest = KDTree(vertices.numpy()).query(points.nan_to_num().numpy())
        return torch.from_numpy(nearest)
    # |p - v|^2 less |p|^2, which is the same for all vertices, and half of that.
    own, across = vertices.square().sum(-1) / 2, vertices.T
    return torch.cat([torch.addmm(own, part, across, alpha=-1).argmin(-1) for part in points.split(POINTS_AT_ONCE)])


def _pose_features(face: FaceParams) -> Float[Tensor, "b p"]:
    """R - I of the free joints, row by row."""
    return (matrix_from_axis_angle(face.joints) - torch.eye(3).to(face.joints)).flatten(1)


def _inverse(pose: Float[Tensor, "b 4 4"]) -> Float[Tensor, "b 4 4"]:
    """The inverses of rigid transforms."""
    turned = pose[:, :3, :3].transpose(1, 2)
    return rigid_transform(turned, -(turned @ pose[:, :3, 3:])[..., 0])


def _mean_square(values: Tensor) -> Float[Tensor, ""]:
    return values.square().mean()
