"""A head that the face model cannot represent: its shape leaves the model's space, and its face moves differently."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.lab.synthetic.arithmetic import SolidNoise, smoothstep
from mien.lab.synthetic.posing import rest_vertices
from mien.machine import exact

_EXTRA = (("jawOpen", "mouthSmileLeft"), ("mouthPucker", "mouthFunnel"), ("browInnerUp", "browDownLeft"))
"""Pairs of expressions whose product drives an additional field: muscles that work together do not just add up."""
_WANDERING = 2
"""Number of additional fields that come and go by themselves."""
_EYE_INNER, _EYE_OUTER = 0.018, 0.045
"""Distances from an eyeball's centre in metres. Closer vertices are not bent, so that lids close; farther ones are bent
fully."""


@dataclass(frozen=True, eq=False)
class OffModel:
    """The head that is drawn instead of the face model's."""

    model: FaceModel
    """The face model with a bent template, bent expressions, and additional expressions at the end."""
    offsets: Float[Tensor, "v 3"]
    """Offsets of the drawn neutral head from the face model's, in the head frame, in metres."""

    def face(self, face: FaceParams, fps: float, seed: int) -> FaceParams:
        """Convert the face model's parameters to parameters of `model`."""
        random, names = np.random.default_rng([seed, 12]), self.model.expression_names
        times = np.arange(len(face)) / fps
        extra = [face.expression[:, names.index(first)] * face.expression[:, names.index(second)]
                 for first, second in _EXTRA]  # fmt: skip
        total = np.abs(face.expression.numpy()).sum(-1)
        active = torch.from_numpy(np.clip(total, 0, 1))  # nothing moves in a resting face
        for _ in range(_WANDERING):
            wave = np.sin(2 * np.pi * (random.uniform(0.2, 0.45) * times + random.uniform())).astype(np.float32)
            extra.append(torch.from_numpy(wave).clamp_min(0) * active)
        return replace(face, expression=torch.cat([face.expression, torch.stack(extra, -1)], -1))


def bend_off_model(model: FaceModel, identity: Float[Tensor, " i"], strength: float, seed: int) -> OffModel:
    """Make a head beyond the face model from a seed. `strength` 1 moves vertices by about 5 mm, and no eye."""
    points, noise = rest_vertices(model, identity), SolidNoise(seed + 101)
    free = _away_from_eyes(model, points)
    offsets = torch.from_numpy(strength * free[:, None] * _warp(points, noise)).float()
    basis = _bent_expressions(model, points, strength * free, noise)
    extra = torch.from_numpy(strength * _extra_fields(points, free, noise)).float()
    count, joints = len(extra), model.joint_rotation_basis.shape[1]
    drawn = replace(
        model, template=model.template + offsets, expression_basis=torch.cat([basis, extra]),
        expression_names=(*model.expression_names, *(f"offModel{index}" for index in range(count))),
        expression_bounds=torch.cat([model.expression_bounds, torch.tensor([[0.0, 1.0]]).expand(count, 2)]),
        joint_rotation_basis=torch.cat([model.joint_rotation_basis, torch.zeros(count, joints, 3)]),
        joint_translation_basis=torch.cat([model.joint_translation_basis, torch.zeros(count, joints, 3)]),
    )  # fmt: skip
    return OffModel(drawn, offsets)


def _away_from_eyes(model: FaceModel, points: np.ndarray) -> Float[np.ndarray, " v"]:
    """Return 0 at the eyes, 1 far from them, and 0 again at the base of the neck, where the shirt begins."""
    eyes = model.faces[model.region_mask("eyes", "irises")].unique().numpy()
    free = smoothstep(-0.13, -0.08, points[:, 1])
    for side in (-1.0, 1.0):
        center = points[eyes[points[eyes, 0] * side > 0]].mean(0)
        free = free * smoothstep(_EYE_INNER, _EYE_OUTER, exact.length(points - center))
    return free.astype(np.float32)


def _field(points: np.ndarray, noise: SolidNoise, wavelength: float, shift: float) -> Float[np.ndarray, "v 3"]:
    return np.stack([noise(points + shift + 3.7 * axis * wavelength, wavelength) for axis in range(3)], -1)


def _warp(points: np.ndarray, noise: SolidNoise) -> Float[np.ndarray, "v 3"]:
    """Return the offsets of a nose bent sideways, a jaw that widens downwards, and bulges of two sizes."""
    x, y, z = points.T
    front = smoothstep(0.02, 0.09, z)
    nose = np.exp(-((x / 0.016) ** 2) - (((y + 0.02) / 0.03) ** 2)) * front
    jaw = smoothstep(-0.03, -0.09, y) * np.tanh(x / 0.03)
    bent = np.stack([0.0035 * nose + 0.005 * jaw, 0.002 * nose, 0.003 * nose - 0.003 * np.abs(jaw)], -1)
    return bent + 0.007 * _field(points, noise, 0.075, 0.3) + 0.0028 * _field(points, noise, 0.032, 1.1)


def _bent_expressions(
    model: FaceModel, points: np.ndarray, share: np.ndarray, noise: SolidNoise
) -> Float[Tensor, "e v 3"]:
    """Make each expression stronger in some places, weaker in others and slightly sideways, each in its own way."""
    basis = model.expression_basis.numpy().copy()
    for index, field in enumerate(basis):
        gain = 1 + 0.45 * share * noise(points + 0.61 * index, 0.05)
        aside = 0.25 * share[:, None] * _field(points, noise, 0.06, 0.37 * index)
        basis[index] = field * gain[:, None] + exact.length(field)[:, None] * aside
    return torch.from_numpy(basis)


def _extra_fields(points: np.ndarray, free: np.ndarray, noise: SolidNoise) -> Float[np.ndarray, "k v 3"]:
    """Return displacements of 3 to 5 mm on cheeks, chin and forehead that no expression of the model makes."""
    front = smoothstep(0.0, 0.05, points[:, 2]) * free
    places = (
        ((-0.04, -0.04, 0.07), 0.024), ((0.0, -0.085, 0.08), 0.022), ((0.0, 0.055, 0.09), 0.026),
        ((0.042, -0.045, 0.065), 0.022), ((0.02, -0.07, 0.08), 0.02),
    )  # fmt: skip
    fields = []
    for index, (center, radius) in enumerate(places):
        ball = np.exp(-((points - np.array(center)) ** 2).sum(-1) / (2 * radius * radius)) * front
        direction = np.array([0.3, 0.5, 1.0]) / 1.16 + 0.6 * _field(points, noise, 0.03, 2.0 + index)
        fields.append(0.0042 * ball[:, None] * direction)
    return np.stack(fields).astype(np.float32)
