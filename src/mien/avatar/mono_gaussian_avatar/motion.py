"""The motion of free points: from the canonical face to others, by a network, and losses that keep it near a mesh.

Points deform by blend directions and skinning weights that the network says about their positions. Beside the face
model's joints there is one more bone, which stands still in the world while the head moves.
"""

from abc import ABC
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from torch import Tensor

from mien.arrays import is_native
from mien.avatar.avatar import Avatar
from mien.avatar.baking import Kept, as_array, bake_rig
from mien.avatar.mono_gaussian_avatar.networks import DeformationNet
from mien.avatar.mono_gaussian_avatar.settings import LENGTH_UNIT, WeightNorm
from mien.avatar.ops.points import at_places, random_places, sample_surface
from mien.avatar.ops.skin_points import blend_transforms, skin_points, unskin
from mien.avatar.settings import Progress
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.kernels import on_gpu
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
    T_world_head: Float[Tensor, "4 4"]


class BakedMotion(NamedTuple):
    """The points in the form that `mien.runtime` moves."""

    rig: Rig
    to_rest: Float[Tensor, "n 3"]
    """From each point's canonical position to its place in the rig."""
    still_weights: Float32[np.ndarray, " n"]
    still_pose: Float32[np.ndarray, "4 4"]


class FreePoints(Avatar, ABC):
    """Points that a network moves with the face, from the canonical one to others."""

    config: Any
    """A `FreePointsConfig`."""
    deformation: DeformationNet
    canonical_expression: Tensor
    canonical_joints: Tensor
    expression_variance: Tensor
    bones: Int[Tensor, " s"]
    """Joints that move skin. The others only place these: FLAME has five here, and nine that move nothing."""
    slots: Int[Tensor, " k"]
    """The place of each joint among these, or -1."""

    def new_deformation(self, face: FaceParams, form: WeightNorm) -> DeformationNet:
        """The network for faces of this kind, with random weights."""
        moved = self.face_model.skinning_weights.any(0)
        self.register_buffer("bones", moved.nonzero()[:, 0], persistent=False)
        self.register_buffer("slots", torch.where(moved, moved.cumsum(0) - 1, -1), persistent=False)
        outputs = (face.expression.shape[1], 9 * face.joints.shape[1], len(self.bones) + 1)
        return DeformationNet(self.config.deformation_width, *outputs, form).to(self.face_model.template)

    def first_means(self, face: FaceParams) -> Float[Tensor, "n 3"]:
        """Take the canonical face from all training timesteps, and return the first points: on it, or on a sphere."""
        config, like = self.config, self.face_model.template
        expression, joints = canonical_face(self.face_model, face.expression.detach().mean(0))
        self.register_buffer("canonical_expression", expression)
        self.register_buffer("canonical_joints", joints)
        self.register_buffer("expression_variance", face.expression.detach().var(0, correction=0))
        self._kept_rest, self._kept_surface = Kept[AtRest](), Kept[Any]()
        if config.start == "sphere":
            # Uniform in a cube, then projected onto the sphere, as in the published code.
            cube = 2 * torch.rand(config.points, 3).to(like) - 1
            return config.sphere_radius * torch.nn.functional.normalize(cube, dim=-1)
        return sample_surface(self.at_rest().vertices, self.face_model.faces, config.points)

    def canonical_face(self) -> FaceParams:
        """The canonical expression and joints, at the subject's usual head pose."""
        return replace(self.subject, expression=self.canonical_expression[None], joints=self.canonical_joints[None])

    def transforms(self, face: FaceParams) -> Float[Tensor, "b k 3 4"]:
        """The bones' transforms in the head frame, then that of the bone which stands still in the world."""
        still = _inverse(face.T_world_head) @ self.canonical_face().T_world_head
        moving = self.face_model.joint_transforms(face)[:, self.bones]
        return torch.cat([moving, still[:, None]], dim=1)[:, :, :3]

    def at_rest(self) -> AtRest:
        """What depends on the canonical face alone."""

        @torch.no_grad()
        def make() -> AtRest:
            face = self.canonical_face()
            vertices, transforms = self.face_model.head_vertices(face)[0], self.transforms(face)[0]
            return AtRest(vertices, transforms, self.coefficients(face, absolute=True), face.T_world_head[0])

        own = (self.canonical_expression, self.canonical_joints, *self.subject.tensors().values())
        return self._kept_rest.of(own, make)

    def coefficients(self, face: FaceParams, absolute: bool = False) -> Float[Tensor, "b c"]:
        """Weights of the blend directions: less those of the canonical face, or as they are (`absolute`)."""
        own = torch.cat([face.expression, _pose_features(face)], dim=1)
        return own if absolute else own - self.at_rest().coefficients

    def deformed(
        self, means: Float[Tensor, "n 3"], face: FaceParams
    ) -> tuple[Float[Tensor, "b n 3"], Float[Tensor, "b n 3"]]:
        """Points in the head frame, and their motion from the canonical positions, both in metres."""
        if on_gpu(means, face.expression):
            found = self._moved_by_kernels(means, face)
            if found is not None:
                return found
        offset, moved, weights = self.deformation(means / LENGTH_UNIT, self.coefficients(face))
        canonical = means + LENGTH_UNIT * offset
        at_rest = self.at_rest().transforms
        posed = skin_points(canonical, LENGTH_UNIT * moved, weights, at_rest, self.transforms(face))
        return posed, posed - canonical

    def _moved_by_kernels(self, means: Float[Tensor, "n 3"], face: FaceParams) -> tuple[Tensor, Tensor] | None:
        """`deformed` in few launches. None if the person's shape has a gradient."""
        from mien.avatar.mono_gaussian_avatar.motion_gpu import moved_points
        from mien.face.posing_gpu import move_bones

        rest = self.at_rest()
        found = move_bones(self.face_model, face, rest.T_world_head, self.slots, len(self.bones) + 1)
        if found is None:
            return None
        coefficients, bones = found
        outputs = self.deformation.outputs(means / LENGTH_UNIT, coefficients - rest.coefficients)
        return moved_points(outputs, means, rest.transforms, bones)

    def face_losses(self, means: Float[Tensor, "p 3"], share: float = 1.0) -> dict[str, Float[Tensor, ""]]:
        """Weighted distances of points' skinning weights and directions from those of the nearest canonical vertex.

        With units of a mean variance of 1, the term of expressions does not depend on how a face model scales its
        coefficients (the paper's weight is for FLAME). Nearest vertices are found in each step, because points move.
        `share` is a factor on all weights.
        """
        model = self.face_model
        if on_gpu(means):
            return self._face_losses_by_kernels(means, share)
        found = self.deformation.whole(means / LENGTH_UNIT)
        canonical = means + LENGTH_UNIT * found.offset.detach()
        nearest = nearest_vertices(canonical, self.at_rest().vertices)
        # The bone that stands still belongs to no vertex.
        weights = torch.nn.functional.pad(model.skinning_weights[nearest][:, self.bones], (0, 1))
        config, units = self.config, self._units()
        losses = {"skinning": config.face_skinning_weight * _mean_square(found.weights - weights)}
        difference = found.expression - model.expression_basis[:, nearest].permute(1, 2, 0) / LENGTH_UNIT
        difference = difference if units is None else difference * units
        losses["expression_directions"] = config.face_expression_weight * _mean_square(difference)
        if found.pose.shape[-1] > 0:
            basis = model.pose_basis
            correctives = 0 if basis is None else basis[:, nearest].permute(1, 2, 0) / LENGTH_UNIT
            losses["pose_correctives"] = config.face_correctives_weight * _mean_square(found.pose - correctives)
        return losses if share == 1 else {name: share * loss for name, loss in losses.items()}

    def _units(self) -> Float[Tensor, "*e"] | None:
        """Factors on differences of directions, by the settings."""
        config, variance = self.config, self.expression_variance
        if config.face_expression_units == "own":
            return None
        unit = variance.mean().clamp_min(1e-8)
        if config.face_expression_units == "each":
            # Coefficients that never moved would otherwise have an infinite weight.
            unit = unit / ((variance / unit).clamp_min(0.01) * len(variance))
        return unit.sqrt()

    def _face_losses_by_kernels(self, means: Float[Tensor, "p 3"], share: float) -> dict[str, Float[Tensor, ""]]:
        """`face_losses` in few launches."""
        from mien.avatar.mono_gaussian_avatar.motion_gpu import Surface, face_distances

        config, model, rest = self.config, self.face_model, self.at_rest()

        def surface() -> Surface:
            bases = [model.expression_basis] if model.pose_basis is None else [model.expression_basis, model.pose_basis]
            units, variance = self._units(), self.expression_variance
            units = torch.ones_like(variance) if units is None else units.expand_as(variance).contiguous()
            return Surface(rest.vertices, torch.cat(bases), model.skinning_weights.contiguous(), self.bones, units)

        weights = (config.face_skinning_weight, config.face_expression_weight, config.face_correctives_weight)
        outputs = self.deformation.outputs(means / LENGTH_UNIT)
        own = self._kept_surface.of((rest.vertices, self.expression_variance), surface)
        skinning, expression, pose = (share * weight for weight in weights)
        losses = face_distances(outputs, means, own, (skinning, expression, pose))
        names = ("skinning", "expression_directions", "pose_correctives")[: 3 if self.deformation.pose_features else 2]
        return dict(zip(names, losses, strict=False))

    def chosen_means(self, progress: Progress) -> Float[Tensor, "p 3"]:
        """The next `face_points` points, detached: on average, losses of them are the paper's means over all points."""
        n, turn = len(self.store), progress.step // progress.frames
        means, first, count = self.store["means"].detach(), turn * self.config.face_points % n, self.config.face_points
        chosen, more = means[first : first + count], min(count, n) - (n - first)
        return torch.cat([chosen, means[:more]]) if more > 0 else chosen

    def baked_motion(self) -> BakedMotion:
        """The points as those of a rig with blend directions and skinning weights."""
        means, rig = self.store["means"], bake_rig(self.face_model, self.subject)
        found = self.deformation.whole(means / LENGTH_UNIT)
        expression, pose = LENGTH_UNIT * found.expression, LENGTH_UNIT * found.pose
        face = self.canonical_face()
        canonical = means + LENGTH_UNIT * found.offset
        skinning = blend_transforms(found.weights, self.transforms(face))[0]
        coefficients, still = self.coefficients(face, absolute=True), found.weights[:, -1]
        weights = found.weights.new_zeros(len(means), len(rig.joint_parents))
        weights[:, self.bones] = found.weights[:, :-1]
        rest = unskin(canonical, skinning) - torch.cat([expression, pose], dim=-1) @ coefficients[0]
        moved = replace(
            rig,
            template=as_array(rest),
            expression_basis=as_array(expression.permute(2, 0, 1)),
            skinning_weights=as_array(weights),
            pose_basis=as_array(pose.permute(2, 0, 1)),
        )
        return BakedMotion(moved, rest - canonical, as_array(still), as_array(face.T_world_head[0]))

    def pretrain(self, face: FaceParams) -> Iterator[None]:
        """Teach the network the face model's motion in training frames, before the first picture.

        The published network starts without any motion, and needs some hundred thousand steps to find it.
        """
        steps = self.config.pretraining
        optimizer = torch.optim.Adam(self.deformation.parameters(), lr=_PRETRAINING_RATE)
        canonical, faces = self.at_rest().vertices, self.face_model.faces
        for step in range(steps):
            optimizer.param_groups[0]["lr"] = _PRETRAINING_RATE * 0.1 ** (step / steps)
            frames = face[torch.randint(len(face), (_PRETRAINING_FRAMES,))].detach()
            triangles, weights = random_places(canonical, faces, _PRETRAINING_POINTS)
            corners = faces[triangles]
            means = at_places(canonical, corners, weights)
            target = at_places(self.face_model.head_vertices(frames), corners, weights)
            found, _ = self.deformed(means, frames)
            distance = (found - target).norm(dim=-1).mean() / LENGTH_UNIT
            optimizer.zero_grad()
            losses = self.face_losses(means)
            torch.autograd.backward([_PRETRAINING_WEIGHT * distance, *losses.values()])
            optimizer.step()
            yield


def canonical_face(
    model: FaceModel, expression: Float[Tensor, " e"]
) -> tuple[Float[Tensor, " e"], Float[Tensor, "j 3"]]:
    """An expression and joints at which the jaw is open by `CANONICAL_JAW`.

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
    identity = torch.eye(3, dtype=face.joints.dtype, device=face.joints.device)
    return (matrix_from_axis_angle(face.joints) - identity).flatten(1)


def _inverse(pose: Float[Tensor, "b 4 4"]) -> Float[Tensor, "b 4 4"]:
    turned = pose[:, :3, :3].transpose(1, 2)
    return rigid_transform(turned, -(turned @ pose[:, :3, 3:])[..., 0])


def _mean_square(values: Tensor) -> Float[Tensor, ""]:
    return values.square().mean()
