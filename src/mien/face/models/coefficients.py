"""Heads with coefficients that nobody publishes a basis for: anny's head, which they do not move.

Methods whose colours depend on the coefficients (HeadGaS) train on them. The mesh only says where the head is.
"""

import re
from dataclasses import replace

import torch

from mien.face.model import FaceModel

BASE = "anny"
"""The face model whose mesh it is."""
_NAME = re.compile(r"coefficients-([1-9][0-9]{0,2})")
_BOUND = 100.0
"""Largest size of a coefficient."""


def coefficient_count(name: str) -> int | None:
    """Return the number of coefficients of the face model `coefficients-N`, or None for other names."""
    found = _NAME.fullmatch(name)
    return None if found is None else int(found[1])


def coefficient_head(base: FaceModel, count: int) -> FaceModel:
    """Return the face model with this many coefficients in the place of its expressions, which move nothing.

    Args:
        base: The face model whose mesh, joints and landmarks it has.
        count: Number of coefficients.
    """
    like, vertices, joints = base.template, len(base.template), len(base.joint_names)
    return replace(
        base,
        name=f"coefficients-{count}",
        expression_basis=like.new_zeros(count, vertices, 3),
        expression_names=tuple(f"coefficient{index:03d}" for index in range(count)),
        expression_bounds=like.new_tensor([-_BOUND, _BOUND]).repeat(count, 1),
        expression_sigmas=torch.ones(count),
        joint_rotation_basis=like.new_zeros(count, joints, 3),
        joint_translation_basis=like.new_zeros(count, joints, 3),
    )
