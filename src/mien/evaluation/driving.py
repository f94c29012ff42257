"""Driving: one person's motion on another person's avatar."""

from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from mien.errors import UserError
from mien.face import FaceParams
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle


def drive(
    driver: FaceParams,
    driver_neutral: FaceParams,
    avatar_neutral: FaceParams,
    expression_bounds: Float[Tensor, "e 2"] | None = None,
    with_head_pose: bool = True,
) -> FaceParams:
    """Face parameters that make an avatar do what the driver does; its own identity and offsets stay.

    Expression coefficients are added as differences from each one's neutral. Joints, head rotation and translation are
    the driver's motion relative to the driver's neutral, seen from the driver's neutral frame and done from the
    avatar's: a nod stays a nod also where the two were filmed from different sides.

    Args:
        driver: The timesteps to play.
        driver_neutral: One timestep of the driver at rest, see `neutral_of`.
        avatar_neutral: One timestep of the avatar's person at rest.
        expression_bounds: `FaceModel.expression_bounds`; results are clamped there.
        with_head_pose: Whether the head follows the driver's; else it stays at the avatar's neutral.

    Raises:
        UserError: the two were tracked with different face models.
    """
    for name in ("expression", "joints"):
        theirs, ours = getattr(driver, name).shape[1:], getattr(avatar_neutral, name).shape[1:]
        if theirs != ours:
            raise UserError(
                f"the driver has {tuple(theirs)} {name} parameters, the avatar {tuple(ours)}: "
                "they were tracked with different face models; track the driver with the avatar's"
            )
    expression = avatar_neutral.expression + driver.expression - driver_neutral.expression
    if expression_bounds is not None:
        expression = expression.clamp(expression_bounds[:, 0], expression_bounds[:, 1])
    driven = replace(
        avatar_neutral,
        expression=expression,
        joints=_relative_rotation(driver.joints, driver_neutral.joints, avatar_neutral.joints),
        head_rotation=avatar_neutral.head_rotation.expand(len(driver), -1),
        head_translation=avatar_neutral.head_translation.expand(len(driver), -1),
    )
    if not with_head_pose:
        return driven
    there = matrix_from_axis_angle(driver_neutral.head_rotation)
    here = matrix_from_axis_angle(avatar_neutral.head_rotation)
    moved = (driver.head_translation - driver_neutral.head_translation) @ there[0]
    return replace(
        driven,
        head_rotation=_relative_rotation(
            driver.head_rotation, driver_neutral.head_rotation, avatar_neutral.head_rotation
        ),
        head_translation=avatar_neutral.head_translation + moved @ here[0].T,
    )


def _relative_rotation(
    driver: Float[Tensor, "b *j 3"], driver_neutral: Float[Tensor, "1 *j 3"], avatar_neutral: Float[Tensor, "1 *j 3"]
) -> Float[Tensor, "b *j 3"]:
    """Axis-angle of: the avatar's neutral rotation, after what leads from the driver's neutral to the driver's."""
    motion = matrix_from_axis_angle(driver_neutral).transpose(-1, -2) @ matrix_from_axis_angle(driver)
    return axis_angle_from_matrix(matrix_from_axis_angle(avatar_neutral) @ motion)
