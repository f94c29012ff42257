"""A face model reduced to its landmarks, with analytic derivatives for Levenberg-Marquardt."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.rotation import left_jacobian, matrix_from_axis_angle
from mien.tracking.fitting.parameters import ParameterLayout, joint_derivatives
from mien.tracking.fitting.views import CameraBatch
from mien.tracking.landmarks.detector_response import DetectorResponse, unknown_response


@dataclass(frozen=True, eq=False)
class Linearization:
    """Projected landmarks in pixels, and their derivatives by each parameter."""

    pixels: Float[Tensor, "b l 2"]
    by_frame: Float[Tensor, "b l 2 p"]
    """Derivatives by the per-frame parameters, in the order of the layout."""
    by_bias: Float[Tensor, "b l 2 3"]
    by_shared: Float[Tensor, "b l 2 s"] | None
    """Derivatives by identity, by `DetectorResponse.by_person`, and by the logarithm of the focal length."""


@dataclass(frozen=True, eq=False)
class LandmarkModel:
    """The l landmarks of a face model and the k joints that move them, in float64.

    Skinning is linear in the vertices, and landmarks are fixed mixtures of vertices. So a landmark is
    sum_k R_k y_k + W_k t_k. Here y_k is the weighted sum of its vertices' rest positions for joint k, which is linear
    in identity and expression. This is exact, and hundreds of times cheaper than posing the mesh.
    """

    face_model: FaceModel
    layout: ParameterLayout
    rest: Float[Tensor, "k l 3"]
    identity_basis: Float[Tensor, "i k l 3"]
    expression_basis: Float[Tensor, "e k l 3"]
    pose_basis: Float[Tensor, "q k l 3"] | None
    joint_weights: Float[Tensor, "k l"]
    joints: Int[Tensor, " k"]
    """Indices of the k joints in the face model: those that move a landmark."""
    response: DetectorResponse
    """Response of the detector. Its part by expression is already included in `expression_basis`."""

    def at(self, landmarks: Int[Tensor, " n"], layout: ParameterLayout) -> "LandmarkModel":
        """The model of some of the landmarks, with another layout of the free parameters."""
        return replace(
            self,
            layout=layout,
            rest=self.rest[:, landmarks],
            identity_basis=self.identity_basis[:, :, landmarks],
            expression_basis=self.expression_basis[:, :, landmarks],
            pose_basis=None if self.pose_basis is None else self.pose_basis[:, :, landmarks],
            joint_weights=self.joint_weights[:, landmarks],
            response=self.response.at(landmarks),
        )

    def head_points(
        self, face: FaceParams, bias: Float[Tensor, "l 3"]
    ) -> tuple[Float[Tensor, "b l 3"], Float[Tensor, "b k l 3"], Float[Tensor, "b k 4 4"]]:
        """Landmarks in the head frame, the weighted rest positions y_k, and the joint transforms."""
        k, points = self.joint_weights.shape
        static = self.rest + torch.einsum("i,iklc->klc", face.identity, self.identity_basis)
        static = static + self.joint_weights[:, :, None] * bias
        shaped = static + (face.expression @ self.expression_basis.flatten(1)).reshape(-1, k, points, 3)
        shaped = shaped + self.joint_weights[:, :, None] * self.response.of_turns(face.head_rotation)[:, None]
        if self.pose_basis is not None:
            turned = matrix_from_axis_angle(face.joints) - torch.eye(3).to(face.joints)
            shaped = shaped + torch.einsum("bq,qklc->bklc", turned.flatten(1), self.pose_basis)
        transforms = self.face_model.joint_transforms(face)[:, self.joints]
        moved = torch.einsum("bkrc,bklc->blr", transforms[:, :, :3, :3], shaped)
        return moved + torch.einsum("kl,bkc->blc", self.joint_weights, transforms[:, :, :3, 3]), shaped, transforms

    def project(
        self,
        state: Float[Tensor, "v p"],
        identity: Float[Tensor, " i"],
        bias: Float[Tensor, "l 3"],
        cameras: CameraBatch,
        row: Int[Tensor, " b"],
    ) -> Float[Tensor, "b l 2"]:
        """Landmarks in b pictures of v timesteps, in pixels. Each picture has its timestep `row` and its own camera."""
        face = self.layout.face_params(state, identity)
        points, _, _ = self.head_points(face, bias)
        pose = face.T_world_head
        world = points @ pose[:, :3, :3].transpose(-1, -2) + pose[:, None, :3, 3]
        return cameras.project(world[row])

    def linearize(
        self,
        state: Float[Tensor, "v p"],
        identity: Float[Tensor, " i"],
        bias: Float[Tensor, "l 3"],
        cameras: CameraBatch,
        row: Int[Tensor, " b"],
        with_identity: bool = False,
    ) -> Linearization:
        """Landmarks in b pictures, with derivatives. The head frame is computed once for each timestep (`row`)."""
        face = self.layout.face_params(state, identity)
        points, shaped, transforms = self.head_points(face, bias)
        rotation = matrix_from_axis_angle(face.head_rotation)
        turned = points @ rotation.transpose(-1, -2)
        world = turned + face.head_translation[:, None]
        pixels, by_world, by_log_focal = _project_with_derivatives(world[row], cameras)
        by_head = torch.einsum("blxc,bcd->blxd", by_world, rotation[row])

        by_rotation = torch.linalg.cross(turned[row][:, :, None].expand_as(by_world), by_world)
        by_rotation = torch.einsum("blxc,bcd->blxd", by_rotation, left_jacobian(face.head_rotation)[row])
        by_expression = _through_joints(transforms, self.expression_basis[self.layout.expression_index])
        by_angles, by_derived = self._by_joint_motion(transforms, shaped, face)
        by_expression[..., self.layout.derived_column] += by_derived
        of_head = torch.cat([by_expression, by_angles], dim=-1)
        by_frame = torch.cat([by_rotation, by_world, _chain(by_head, of_head, row)], dim=-1)
        by_bias = by_head @ torch.einsum("vkrc,kl->vlrc", transforms[:, :, :3, :3], self.joint_weights)[row]
        if not with_identity:
            return Linearization(pixels, by_frame, by_bias, None)
        by_identity = _chain(by_head, self._by_identity(transforms, face), row)
        by_person = torch.einsum("blxc,klc->blxk", by_bias, self.response.by_person)
        by_shared = torch.cat([by_identity, by_person, by_log_focal[..., None]], dim=-1)
        return Linearization(pixels, by_frame, by_bias, by_shared)

    def _by_joint_motion(
        self, transforms: Float[Tensor, "v k 4 4"], shaped: Float[Tensor, "v k l 3"], face: FaceParams
    ) -> tuple[Float[Tensor, "v l 3 m"], Float[Tensor, "v l 3 d"]]:
        """Derivatives of head-frame points through the joints: by free angles, and by expressions that move a joint."""
        by_parameter, by_turns = joint_derivatives(self.layout, self.face_model, face)
        by_parameter = by_parameter[:, :, self.joints]
        motion = torch.einsum("mvkrc,vklc->vlrm", by_parameter[..., :3], shaped)
        motion = motion + torch.einsum("mvkr,kl->vlrm", by_parameter[..., 3], self.joint_weights)
        if self.pose_basis is not None:
            motion = motion + torch.einsum("vlrq,mvq->vlrm", _through_joints(transforms, self.pose_basis), by_turns)
        count = len(self.layout.joint_index)
        return motion[..., :count], motion[..., count:]

    def _by_identity(self, transforms: Float[Tensor, "v k 4 4"], face: FaceParams) -> Float[Tensor, "v l 3 i"]:
        """Derivatives of head-frame points by identity, through the rest shape and through the places of the joints."""
        by_identity, places = _through_joints(transforms, self.identity_basis), self.face_model.joint_identity_basis
        if not places.any():
            return by_identity
        # A joint that turns points by R about its place p shifts them by p - R p. Its children add their own shifts.
        turns, shifts = self.face_model.joint_transforms(face)[:, :, :3, :3], []
        for joint, parent in enumerate(self.face_model.joint_parents):
            above = torch.eye(3).to(turns) if parent < 0 else turns[:, parent]
            own = (above - turns[:, joint]) @ places.permute(1, 2, 0)[joint]
            shifts.append(own if parent < 0 else shifts[parent] + own)
        return by_identity + torch.einsum(
            "vkri,kl->vlri", torch.stack(shifts, dim=1)[:, self.joints], self.joint_weights
        )


def reduce_face_model(
    face_model: FaceModel, layout: ParameterLayout, response: DetectorResponse | None = None
) -> LandmarkModel:
    """Reduce a face model to its MediaPipe landmarks as the detector sees them, in float64."""
    model = face_model.to(torch.zeros((), dtype=torch.float64))
    marks = model.landmarks["mediapipe"]
    corners = model.faces[marks.faces]
    share = marks.barycentric[:, :, None] * model.skinning_weights[corners]
    joints = share.sum((0, 1)).nonzero()[:, 0]
    share = share[:, :, joints]

    def gather(positions: Tensor) -> Tensor:
        return torch.einsum("...lnc,lnk->...klc", positions[..., corners, :], share)

    joint_weights = share.sum(1).T.contiguous()
    response = response or unknown_response(len(marks.faces), len(model.expression_basis))
    seen = torch.einsum("elc,kl->eklc", response.by_expression, joint_weights)
    return LandmarkModel(
        face_model=model,
        layout=layout,
        rest=gather(model.template),
        identity_basis=gather(model.identity_basis),
        expression_basis=gather(model.expression_basis) + seen,
        pose_basis=None if model.pose_basis is None else gather(model.pose_basis),
        joint_weights=joint_weights,
        joints=joints,
        response=response,
    )


def _project_with_derivatives(
    points: Float[Tensor, "b l 3"], cameras: CameraBatch
) -> tuple[Float[Tensor, "b l 2"], Float[Tensor, "b l 2 3"], Float[Tensor, "b l 2"]]:
    """Projections of world-space points in pixels, with derivatives by the point and by the log of the focal length."""
    in_camera = points @ cameras.viewmat[:, :3, :3].mT + cameras.viewmat[:, None, :3, 3]
    inverse_depth = 1 / in_camera[..., 2]
    focal = cameras.K[:, [0, 1], [0, 1]]
    by_log_focal = focal[:, None] * in_camera[..., :2] * inverse_depth[..., None]
    pixels = by_log_focal + cameras.K[:, None, :2, 2]
    scaled = torch.zeros(*points.shape[:2], 2, 3, dtype=points.dtype)
    scaled[..., 0, 0] = focal[:, :1] * inverse_depth
    scaled[..., 1, 1] = focal[:, 1:] * inverse_depth
    scaled[..., 2] = -by_log_focal * inverse_depth[..., None]
    return pixels, scaled @ cameras.viewmat[:, None, :3, :3], by_log_focal


def _chain(
    by_head: Float[Tensor, "b l 2 3"], of_head: Float[Tensor, "v l 3 s"], row: Int[Tensor, " b"]
) -> Float[Tensor, "b l 2 s"]:
    """Compute by_head @ of_head[row] axis by axis, which is many times faster than as many tiny matrix products."""
    out = by_head[..., :1] * of_head[row, :, None, 0]
    for axis in (1, 2):
        out.addcmul_(by_head[..., axis, None], of_head[row, :, None, axis])
    return out


def _through_joints(transforms: Float[Tensor, "v k 4 4"], basis: Float[Tensor, "e k l 3"]) -> Float[Tensor, "v l 3 e"]:
    """Effect of a basis of rest positions on head-frame points, summed over the joints in one matrix product."""
    timesteps, joints = transforms.shape[:2]
    left = transforms[:, :, :3, :3].transpose(1, 2).reshape(timesteps * 3, joints * 3)
    right = basis.permute(1, 3, 2, 0).reshape(joints * 3, -1)
    return (left @ right).reshape(timesteps, 3, basis.shape[2], len(basis)).transpose(1, 2)
