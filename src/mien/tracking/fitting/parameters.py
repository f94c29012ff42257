"""The per-frame parameters of a fit as one vector: head pose, free expression coefficients, free joint angles."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.rotation import matrix_from_axis_angle
from mien.tracking.fitting.solver import Bounds

_JOINT_SIGMAS = (
    ("eye", (0.4, 0.4, 0.0)),
    ("neck", (0.0, 0.0, 0.0)),
    ("jaw", (0.25, 0.05, 0.03)),
)
"""Prior standard deviations of joint angles in radians, by a word in the joint's name; 0 fixes an angle. Eyes do not
roll, a face says nothing about its neck, and a jaw opens (about x), shifts a little (about y) and hardly twists."""
_JAW_BOUNDS = (-0.03, 0.6)  # bounds of the jaw's opening angle in radians
_EYES_ALIKE_SIGMAS = (0.1, 0.03)
"""Standard deviations of the difference of both eyes' angles (up-down, left-right), in radians: they look at one thing.
"""
_EXPRESSION_SIGMAS = (
    ("brow", 0.25),
    ("cheek", 0.3),
    ("nose", 0.3),
    ("jaw", 0.5),
    ("mouth", 0.4),
    ("eyeLook", 0.3),
    ("eyeBlink", 2.0),
    ("eyeWide", 1.0),
    ("eye", 0.5),
)
"""Prior standard deviations of expression coefficients, by the beginning of their name. That of brows is small, because
otherwise they follow the head's pitch. Not varied one by one. Measured: a third of all of them has the same errors, and
d3's frown shrinks to a third (log, "Fit to pixels")."""
_OTHER_EXPRESSION_SIGMA = 0.4  # the same for all other names


@dataclass(frozen=True, eq=False)
class ParameterLayout:
    """The order of the vector's components: rotation (3), translation (3), expression, joint angles."""

    names: tuple[str, ...]
    expression_index: Int[Tensor, " n"]
    """Columns of `FaceParams.expression` that the fit may move."""
    joint_index: Int[Tensor, " m"]
    """Components of the flattened `FaceParams.joints` that the fit may move."""
    derived_expression: Int[Tensor, " d"]
    """Free expressions that move a joint and, with it, landmarks."""
    derived_column: Int[Tensor, " d"]
    """Positions of `derived_expression` in `expression_index`."""
    expressions: int
    """Number of expressions of the face model."""
    joints: int
    """Number of free joints of the face model."""
    lower: Float[Tensor, " p"]
    upper: Float[Tensor, " p"]
    precision: Float[Tensor, "p p"]
    """Precision matrix of the prior, whose mean is zero. It is zero for the head pose."""
    units: Float[Tensor, " q"]
    """The amount of each expression coefficient, then of each joint angle, that is worth 1 of an ARKit coefficient."""

    @property
    def bounds(self) -> Bounds:
        """The bounds of the parameters."""
        return Bounds(self.lower, self.upper)

    @property
    def size(self) -> int:
        """The number of parameters per frame, p."""
        return len(self.names)

    @property
    def expression_columns(self) -> slice:
        """The columns of the expression in the vector."""
        return slice(6, 6 + len(self.expression_index))

    @property
    def joint_columns(self) -> slice:
        """The columns of the joint angles in the vector."""
        return slice(6 + len(self.expression_index), self.size)

    def face_params(self, state: Float[Tensor, "b p"], identity: Float[Tensor, " i"]) -> FaceParams:
        """The vectors as face parameters. Parameters that the fit may not move are zero."""
        expression = state.new_zeros(len(state), self.expressions)
        expression[:, self.expression_index] = state[:, self.expression_columns]
        joints = state.new_zeros(len(state), self.joints * 3)
        joints[:, self.joint_index] = state[:, self.joint_columns]
        return FaceParams(identity, expression, joints.reshape(-1, self.joints, 3), state[:, :3], state[:, 3:6])


def layout_of(face_model: FaceModel) -> ParameterLayout:
    """The free parameters of a face model with their bounds and priors."""
    bounds = face_model.expression_bounds.double()
    expression_index = (bounds[:, 0] < bounds[:, 1]).nonzero()[:, 0]
    joint_names = face_model.free_joint_names
    by_joint = [next((s for word, s in _JOINT_SIGMAS if word in name.lower()), (0.2,) * 3) for name in joint_names]
    sigmas = torch.tensor(by_joint, dtype=torch.float64).reshape(-1)
    joint_index = (sigmas > 0).nonzero()[:, 0]
    relevant = _joints_behind_landmarks(face_model)
    turns, shifts = face_model.joint_rotation_basis[:, relevant], face_model.joint_translation_basis[:, relevant]
    moves = turns.flatten(1).any(1) | shifts.flatten(1).any(1)
    derived_column = moves[expression_index].nonzero()[:, 0]

    names = [f"rotation_{axis}" for axis in "xyz"] + [f"translation_{axis}" for axis in "xyz"]
    names += [face_model.expression_names[index] for index in expression_index]
    names += [f"{joint_names[index // 3]}_{'xyz'[index % 3]}" for index in joint_index.tolist()]
    free = torch.full((len(names),), torch.inf, dtype=torch.float64)
    lower, upper = -free, free.clone()
    expression = slice(6, 6 + len(expression_index))
    lower[expression], upper[expression] = bounds[expression_index].unbind(-1)
    if "jaw_x" in names:
        lower[names.index("jaw_x")], upper[names.index("jaw_x")] = _JAW_BOUNDS
    prior_sigmas = _expression_sigmas(face_model)[expression_index].tolist() + sigmas[joint_index].tolist()
    precision = torch.zeros(len(names), len(names), dtype=torch.float64)
    precision.diagonal()[6:] = torch.tensor(prior_sigmas, dtype=torch.float64) ** -2
    _tie_eyes(precision, names)
    return ParameterLayout(
        tuple(names), expression_index, joint_index, expression_index[derived_column], derived_column,
        len(bounds), len(joint_names), lower, upper, precision, _units(face_model, expression_index, names),
    )  # fmt: skip


def _joints_behind_landmarks(face_model: FaceModel) -> list[int]:
    """Joints that move landmarks, and all their parents."""
    corners = face_model.faces[face_model.landmarks["mediapipe"].faces]
    relevant = set(face_model.skinning_weights[corners].sum((0, 1)).nonzero()[:, 0].tolist())
    for index in reversed(range(len(face_model.joint_names))):
        if index in relevant and face_model.joint_parents[index] >= 0:
            relevant.add(face_model.joint_parents[index])
    return sorted(relevant)


def _expression_sigmas(face_model: FaceModel) -> Float[Tensor, " e"]:
    if face_model.expression_sigmas is not None:
        return face_model.expression_sigmas.double()
    sigmas = [
        next((sigma for word, sigma in _EXPRESSION_SIGMAS if name.startswith(word)), _OTHER_EXPRESSION_SIGMA)
        for name in face_model.expression_names
    ]
    return torch.tensor(sigmas, dtype=torch.float64)


def _units(face_model: FaceModel, expression_index: Int[Tensor, " n"], names: list[str]) -> Float[Tensor, " q"]:
    units = torch.ones(len(names) - 6, dtype=torch.float64)
    if face_model.expression_sigmas is not None:
        relative = _expression_sigmas(face_model)[expression_index] / _OTHER_EXPRESSION_SIGMA
        units[: len(expression_index)] = relative
    units[len(expression_index) :] = 0.35  # opening angle of a wide open mouth, in radians. Anatomy
    return units


def _tie_eyes(precision: Float[Tensor, "p p"], names: list[str]) -> None:
    for axis, sigma in zip("xy", _EYES_ALIKE_SIGMAS, strict=True):
        pair = [index for index, name in enumerate(names) if "eye" in name.lower() and name.endswith(f"_{axis}")]
        if len(pair) == 2:
            stiffness = torch.tensor([[1.0, -1.0], [-1.0, 1.0]], dtype=torch.float64) / sigma**2
            precision[torch.tensor(pair)[:, None], torch.tensor(pair)] += stiffness


def pose_only(layout: ParameterLayout) -> ParameterLayout:
    """The layout of a fit that moves only the head pose."""
    none = torch.zeros(0, dtype=torch.long)
    return ParameterLayout(
        layout.names[:6], none, none, none, none, layout.expressions, layout.joints,
        layout.lower[:6], layout.upper[:6], layout.precision[:6, :6], layout.units[:0],
    )  # fmt: skip


def joint_derivatives(
    layout: ParameterLayout, face_model: FaceModel, face: FaceParams
) -> tuple[Float[Tensor, "q t k 3 4"], Float[Tensor, "q t n"]]:
    """Derivatives of the joint transforms and of the free joints' rotation matrices at t timesteps.

    They are by the q free joint angles, then expressions that move a joint (`ParameterLayout.derived_expression`), by
    central differences. Only the short chain of joints is differentiated this way. In float64 the error is below 1e-9.
    """
    free, derived, angles = layout.joint_index, layout.derived_expression, face.joints.flatten(1)
    at = torch.cat([angles[:, free], face.expression[:, derived]], dim=1)
    count, parameters = at.shape
    if parameters == 0:
        return at.new_zeros(0, count, len(face_model.joint_names), 3, 4), at.new_zeros(0, count, 3 * angles.shape[1])
    step = 1e-5 * torch.eye(parameters).to(at)[:, None]
    moved, times = torch.cat([at + step, at - step]).flatten(0, 1), (2 * parameters, 1)
    joints = angles.repeat(times).index_copy(1, free, moved[:, : len(free)]).reshape(-1, *face.joints.shape[1:])
    expression = face.expression.repeat(times).index_copy(1, derived, moved[:, len(free) :])
    head = face.head_rotation.repeat(times), face.head_translation.repeat(times)
    moved_face = FaceParams(face.identity, expression, joints, *head, face.vertex_offsets)

    def slopes(values: Tensor) -> Tensor:
        above, below = values.unflatten(0, (2, parameters, count))
        return (above - below) / 2e-5

    transforms = face_model.joint_transforms(moved_face)[:, :, :3]
    return slopes(transforms), slopes(matrix_from_axis_angle(joints).flatten(1))
