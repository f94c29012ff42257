"""Expressions of one face model in the terms of another, so that any recording drives any avatar.

Models whose expressions have ARKit's names share them by name. For others, a linear map is fitted here, without
anybody's weights: both neutral faces are registered by their landmarks, and each motion of the one is matched by the
other's motions in the least-squares sense, within their bounds. Eyes and neck turn alike in all models.
"""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from mien.driving.motion import ARKIT_NAMES
from mien.errors import UserError
from mien.face.model import FaceModel
from mien.face.params import FaceParams

_TRANSFER_NOISE = 0.0005
"""Distance in metres by which a landmark of a matched motion may be off: the weight of the fit against the priors
below. Not varied, as the next three."""
_TRANSFER_SPREAD = 0.5  # standard deviation of ARKit's coefficients
_TRANSFER_JAW_SPREAD = 0.2  # the same of the angles of a jaw that is a joint, in radians
_TRANSFER_JAW = ((-0.05, 0.6), (-0.15, 0.15), (-0.1, 0.1))  # bounds of its angles about x, y and z, in radians
_TRANSFER_JAW_STEP = 0.2  # angle in radians over which a jaw's motion is taken as linear
_TRANSFER_SWEEPS = 40  # rounds of the bounded fit

_MARKS = "mediapipe"
_JAW = "jaw"
_BATCH = 16  # motions that are posed at once, which bounds the memory


def fit_expression_map(source: FaceModel, target: FaceModel) -> Callable[[FaceParams], FaceParams]:
    """Fit the map between two face models.

    It returns the target's mean person with the motions (expressions, then a free jaw's axis-angle) and head poses of
    the source's, within its bounds.
    """
    toward, normal = _normal_equations(source, target)
    lower, upper = _bounds(target)

    def transferred(face: FaceParams) -> FaceParams:
        wanted = _motions(source, face).double() @ toward
        if normal is not None:
            wanted = _within_bounds(normal, wanted, lower, upper)
        found = wanted.clamp(lower, upper).to(face.expression)
        rest, e = target.neutral(len(face)), len(target.expression_names)
        joints = rest.joints.clone()
        for row, name in enumerate(target.free_joint_names):
            if name == _JAW:
                joints[:, row] = found[:, e:]
            elif name in source.free_joint_names:
                joints[:, row] = face.joints[:, source.free_joint_names.index(name)]
        pose = {"head_rotation": face.head_rotation, "head_translation": face.head_translation}
        return replace(rest, expression=found[:, :e], joints=joints, **pose)

    return transferred


def _normal_equations(source: FaceModel, target: FaceModel) -> tuple[Float[Tensor, "s t"], Float[Tensor, "t t"] | None]:
    """What each motion of the source asks of each of the target, and the matrix of the target's motions.

    They are the two sides of the normal equations. If names are shared, there is no matrix, and the first is the map.
    """
    shared = set(source.expression_names) & set(target.expression_names) & set(ARKIT_NAMES)
    if len(shared) >= 30 and not any(_JAW in model.free_joint_names for model in (source, target)):
        by_name = torch.zeros(len(source.expression_names), len(target.expression_names), dtype=torch.float64)
        for name in shared:
            by_name[source.expression_names.index(name), target.expression_names.index(name)] = 1
        return by_name, None
    for model in (source, target):
        if _MARKS not in model.landmarks:
            raise UserError(
                f"the face model {model.name!r} has no landmarks, by which expressions are transferred; add it again "
                "(`mien face-models --add FILE`)"
            )
    (rest, theirs), (our_rest, ours) = _displacements(_at_landmarks(source)), _displacements(_at_landmarks(target))
    theirs = (theirs @ _registration(rest, our_rest).T).flatten(1)
    ours = ours.flatten(1)
    # The inverse variances of the motions, by which the fit prefers usual faces.
    e, sigmas = len(target.expression_names), target.expression_sigmas
    spread = torch.full((e,), _TRANSFER_SPREAD) if sigmas is None else sigmas
    if _JAW in target.free_joint_names:
        spread = torch.cat([spread, torch.full((3,), _TRANSFER_JAW_SPREAD)])
    precisions = spread.double().clamp_min(1e-6).square().reciprocal()
    normal = ours @ ours.T / _TRANSFER_NOISE**2 + torch.diag(precisions)
    return theirs @ ours.T / _TRANSFER_NOISE**2, normal


def _motions(model: FaceModel, face: FaceParams) -> Float[Tensor, "b s"]:
    if _JAW not in model.free_joint_names:
        return face.expression
    return torch.cat([face.expression, face.joints[:, model.free_joint_names.index(_JAW)]], dim=1)


def _bounds(model: FaceModel) -> tuple[Float[Tensor, " t"], Float[Tensor, " t"]]:
    bounds = model.expression_bounds.double()
    if _JAW in model.free_joint_names:
        bounds = torch.cat([bounds, torch.tensor(_TRANSFER_JAW, dtype=torch.float64)])
    return bounds[:, 0], bounds[:, 1]


def _marks(model: FaceModel, face: FaceParams) -> Float[Tensor, "b l 3"]:
    # The landmarks of the irises, which are the last, turn with the eyes.
    return model.landmark_positions(model.head_vertices_reference(face), _MARKS)[:, :468].double()


def _at_landmarks(model: FaceModel) -> FaceModel:
    """Return the model without the vertices that no landmark needs, so that it is posed quickly."""
    corners = model.faces[model.landmarks[_MARKS].faces]
    kept, corners = torch.unique(corners, return_inverse=True)
    marks = replace(model.landmarks[_MARKS], faces=torch.arange(len(corners)))
    return replace(
        model,
        template=model.template[kept],
        faces=corners.reshape(-1, 3),
        uv_faces=model.uv_faces[model.landmarks[_MARKS].faces],
        face_regions=model.face_regions[model.landmarks[_MARKS].faces],
        identity_basis=model.identity_basis[:, kept],
        expression_basis=model.expression_basis[:, kept],
        skinning_weights=model.skinning_weights[kept],
        pose_basis=None if model.pose_basis is None else model.pose_basis[:, kept],
        joint_regressor=None,
        landmarks={_MARKS: marks},
    )


def _displacements(model: FaceModel) -> tuple[Float[Tensor, "l 3"], Float[Tensor, "s l 3"]]:
    """The landmarks of the mean face in metres, and how far each motion moves them, in metres per unit."""
    e = len(model.expression_names)
    has_jaw = _JAW in model.free_joint_names
    count = e + 3 * has_jaw
    rest = _marks(model, model.neutral())
    found = []
    for motions in torch.eye(count).split(_BATCH):
        face = model.neutral(len(motions))
        joints = face.joints.clone()
        if has_jaw:
            joints[:, model.free_joint_names.index(_JAW)] += _TRANSFER_JAW_STEP * motions[:, e:]
        found.append(_marks(model, replace(face, expression=face.expression + motions[:, :e], joints=joints)) - rest)
    moved = torch.cat(found)
    moved[e:] /= _TRANSFER_JAW_STEP
    return rest[0], moved


def _registration(theirs: Float[Tensor, "l 3"], ours: Float[Tensor, "l 3"]) -> Float[Tensor, "3 3"]:
    """Return the rotation, times the scale, of the similarity that takes one neutral face to the other (Umeyama)."""
    a, b = theirs - theirs.mean(0), ours - ours.mean(0)
    u, sizes, vt = torch.linalg.svd(b.T @ a)
    signs = torch.ones(3, dtype=a.dtype)
    signs[2] = torch.linalg.det(u @ vt).sign()
    return (sizes * signs).sum() / a.square().sum() * (u * signs) @ vt


def _within_bounds(
    normal: Float[Tensor, "t t"], wanted: Float[Tensor, "b t"], lower: Float[Tensor, " t"], upper: Float[Tensor, " t"]
) -> Float[Tensor, "b t"]:
    """Minimise x normal x / 2 - wanted x within bounds, from the clamped free solution, one motion after the other."""
    found = torch.linalg.solve(normal, wanted.T).T
    if bool(((found >= lower) & (found <= upper)).all()):
        return found
    found = found.clamp(lower, upper)
    slope = found @ normal - wanted
    for _ in range(_TRANSFER_SWEEPS):
        for motion in range(len(normal)):
            old = found[:, motion]
            new = (old - slope[:, motion] / normal[motion, motion]).clamp(lower[motion], upper[motion])
            slope += (new - old)[:, None] * normal[motion]
            found[:, motion] = new
    return found
