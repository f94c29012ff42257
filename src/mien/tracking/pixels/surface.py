"""The surface of a face model posed in float32, with the derivatives of its vertices."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.machine.parallel import map_in_threads
from mien.render.mesh import vertex_normals
from mien.rotation import left_jacobian, matrix_from_axis_angle
from mien.tracking.fitting.fit import Subject
from mien.tracking.fitting.parameters import ParameterLayout, joint_derivatives
from mien.tracking.fitting.solver import NormalEquations, join_frames
from mien.tracking.fitting.views import CameraBatch, Views


@dataclass(frozen=True, eq=False)
class PosedSurface:
    """The surface at one timestep, in world space."""

    vertices: Float[Tensor, "v 3"]
    normals: Float[Tensor, "v 3"]
    jacobian: Float[Tensor, "v 3 p"] | None
    """Derivatives of the vertices by the per-frame parameters, then, if requested, by the identity. The latter ignore
    that joints move with the identity, because joints hardly turn the parts that a photometric fit uses."""


@dataclass(frozen=True, eq=False)
class SurfaceModel:
    """A face model and its layout of free parameters, with bases laid out for derivatives."""

    face_model: FaceModel
    exact: FaceModel
    """The same face model in float64, for the chain of joints."""
    layout: ParameterLayout
    expression_basis: Float[Tensor, "v 3 e"]
    """Basis of the expressions that the fit may move."""
    identity_basis: Float[Tensor, "v 3 i"]

    def pose(
        self,
        state: Float[Tensor, " p"],
        identity: Float[Tensor, " i"],
        *,
        derive: bool = True,
        derive_identity: bool = False,
    ) -> PosedSurface:
        """Vertices, normals and derivatives of one timestep. `state` and `identity` are float64."""
        exact = self.layout.face_params(state[None], identity)
        face = exact.to(self.face_model.template)
        shaped = self._shaped(face)
        transforms = self.exact.joint_transforms(exact)[0, :, :3].float()
        blended = (self.face_model.skinning_weights @ transforms.flatten(1)).reshape(-1, 3, 4)
        turns = blended[..., :3]
        in_head = (turns @ shaped[..., None])[..., 0] + blended[..., 3]
        rotation = matrix_from_axis_angle(exact.head_rotation[0]).float()
        turned = in_head @ rotation.T
        vertices = turned + face.head_translation[0]
        normals = vertex_normals(vertices, self.face_model.faces)
        if not derive:
            return PosedSurface(vertices, normals, None)

        spin = left_jacobian(exact.head_rotation)[0].float()
        by_rotation = torch.linalg.cross(spin.T[None].expand(len(turned), 3, 3), turned[:, None].expand(-1, 3, 3))
        by_translation = torch.eye(3).expand(len(turned), 3, 3)
        by_expression = self.expression_basis
        by_transforms, by_turns = joint_derivatives(self.layout, self.exact, exact)
        angles, points = len(self.layout.joint_index), torch.cat([shaped, shaped.new_ones(len(shaped), 1)], dim=1)
        weighted = (self.face_model.skinning_weights[:, :, None] * points[:, None]).flatten(1)
        by_transforms = by_transforms[:, 0].float().permute(1, 3, 2, 0).flatten(0, 1)
        motion = (weighted @ by_transforms.flatten(1)).reshape(-1, *by_transforms.shape[1:])
        parts = [_apply(rotation @ turns, by_expression), _rotate(rotation, motion[..., :angles])]
        parts[0][:, :, self.layout.derived_column] += _rotate(rotation, motion[..., angles:])
        basis = self.face_model.pose_basis
        if basis is not None and angles:
            correctives = by_turns[:angles, 0].float() @ basis.flatten(1)
            correctives = correctives.reshape(-1, *basis.shape[1:]).permute(1, 2, 0)
            parts[1] = parts[1] + _apply(rotation @ turns, correctives)
        if derive_identity:
            parts.append(_apply(rotation @ turns, self.identity_basis))
        return PosedSurface(vertices, normals, torch.cat([by_rotation.mT, by_translation, *parts], dim=-1).contiguous())

    def _shaped(self, face: FaceParams) -> Float[Tensor, "v 3"]:
        model = self.face_model
        shaped = model.template + self.identity_basis @ face.identity
        shaped = shaped + self.expression_basis @ face.expression[0, self.layout.expression_index]
        if model.pose_basis is not None:
            turned = matrix_from_axis_angle(face.joints) - torch.eye(3)
            shaped = shaped + (turned.flatten() @ model.pose_basis.flatten(1)).reshape(-1, 3)
        return shaped


def surface_model(face_model: FaceModel, layout: ParameterLayout) -> SurfaceModel:
    """The surface model of a face model and a layout."""
    model = face_model.to(torch.zeros(()))
    return SurfaceModel(
        model,
        face_model.to(torch.zeros((), dtype=torch.float64)),
        layout,
        model.expression_basis[layout.expression_index].permute(1, 2, 0).contiguous(),
        model.identity_basis.permute(1, 2, 0).contiguous(),
    )


def _apply(turns: Float[Tensor, "v 3 3"], basis: Float[Tensor, "v 3 n"]) -> Float[Tensor, "v 3 n"]:
    """Multiply the basis by one matrix per vertex, as sums of long rows, because many small products are slow."""
    out = turns[:, :, 0, None] * basis[:, None, 0]
    out.addcmul_(turns[:, :, 1, None], basis[:, None, 1])
    return out.addcmul_(turns[:, :, 2, None], basis[:, None, 2])


def _rotate(rotation: Float[Tensor, "3 3"], vectors: Float[Tensor, "v 3 n"]) -> Float[Tensor, "v 3 n"]:
    return torch.einsum("rc,vcn->vrn", rotation, vectors)


def equations_of_pictures(
    model: SurfaceModel,
    views: Views,
    state: Float[Tensor, "v p"],
    rows: Int[Tensor, " k"],
    subject: Subject,
    cameras: CameraBatch,
    weight: float,
    of_picture: Callable[[PosedSurface, int, int, CameraBatch], tuple[float, Tensor, Tensor]],
    shared: bool,
) -> NormalEquations:
    """The normal equations of some timesteps: the weighted sum of those of their pictures.

    `of_picture` returns cost, half gradient and half Hessian of a posed surface, a timestep's row and a camera. If they
    are `shared`, the parameters of each timestep are followed by identity and the logarithm of the focal length.
    """

    def of_row(row: int) -> NormalEquations:
        posed, seen_by = model.pose(state[row], subject.identity, derive_identity=shared), views.seen_by(row)
        assert posed.jacobian is not None
        if shared:
            by_focal = _by_log_focal(posed.vertices, cameras, seen_by)
            posed = replace(posed, jacobian=torch.cat([posed.jacobian, by_focal], dim=2).contiguous())
        costs, gradients, hessians = zip(*(of_picture(posed, row, camera, cameras) for camera in seen_by), strict=True)
        return NormalEquations(
            weight * torch.tensor([sum(costs)], dtype=torch.float64),
            weight * torch.stack(gradients).sum(0, keepdim=True),
            weight * torch.stack(hessians).sum(0, keepdim=True),
        )

    return join_frames(map_in_threads(of_row, rows.tolist()))


def _by_log_focal(vertices: Float[Tensor, "v 3"], cameras: CameraBatch, seen_by: list[int]) -> Float[Tensor, "v 3 1"]:
    """Motion of vertices that looks like a change of the log of the focal length; zero if several cameras see them."""
    if len(seen_by) != 1:
        return torch.zeros(len(vertices), 3, 1)  # Several cameras are calibrated.
    viewmat = cameras.viewmat[seen_by[0]].float()
    across = vertices @ viewmat[:2, :3].T + viewmat[:2, 3]
    return (across @ viewmat[:2, :3])[..., None]
