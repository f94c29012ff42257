"""The eyes of a face model: the eyeballs, the skin around them, and the coefficient that closes their lids."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mien.camera import Camera
from mien.face.model import FaceModel
from mien.render.mesh import rasterize_mesh
from mien.tracking.fitting.fit import HIDING_REGIONS
from mien.tracking.fitting.parameters import ParameterLayout
from mien.tracking.landmarks.groups import LEFT_EYELIDS, LEFT_LID_PAIRS, RIGHT_EYELIDS, RIGHT_LID_PAIRS

_LIDS_REACH = 1.3  # distance from an eyeball's centre that contains its lids, in radii. Set by eye on the face models
_AROUND_REACH = 3.5  # distance from an eyeball's centre that contains everything that may hide it, in radii. Set by eye
_MOST_CLOSING = 1.25  # a coefficient closes an eye if the lids meet within this multiple of its upper bound
_OTHERS_SHARE = 0.2  # a coefficient is not an eye's own if it moves the other eye's lids by more than this share


@dataclass(frozen=True, eq=False)
class Eye:
    """One eye and the coefficient that closes it."""

    column: int
    """Column of the state that holds the coefficient that moves the lids."""
    closed: float
    """Value of the coefficient at which the lids of the mean person have met. It is worth 1 of the ARKit coefficient,
    which closes an eye firmly, or more if the lids do not touch before."""
    vertices: Int[Tensor, " n"]
    """Indices, in the face model, of the vertices of the triangles below."""
    faces: Int[Tensor, "f 3"]
    """Triangles of the eyeball, then of its lids, then of their surroundings, as indices into `vertices`."""
    ball: int
    """Number of triangles of the eyeball."""
    lids: int
    """Number of triangles of the eyeball and the lids together."""
    skin: Bool[Tensor, " f"]
    """Which triangles are skin."""
    forward: Float[Tensor, " 3"]
    """Direction from the eyeball's centre through its lids, in the head frame."""

    @property
    def moving(self) -> Int[Tensor, "m 3"]:
        """The triangles of the eyeball, then those of the lids."""
        return self.faces[: self.lids]


def eyes_of(model: FaceModel, layout: ParameterLayout) -> list[Eye]:
    """The eyes that have a coefficient of their own to close the lids. Empty if the model has no eyeballs.

    Of the free coefficients that can close an eye, it is the one with the least motion elsewhere.
    """
    ball, free, eyelids = model.region_mask("eyes", "irises"), layout.expression_index, (RIGHT_EYELIDS, LEFT_EYELIDS)
    if not ball.any() or len(free) == 0:
        return []
    marks, bounds = model.landmark_positions(model.template, "mediapipe"), model.expression_bounds[free]
    moved, closing = model.landmark_positions(model.expression_basis[free], "mediapipe"), []
    for pairs in (RIGHT_LID_PAIRS, LEFT_LID_PAIRS):
        # The share of the mean person's gap between the lids that each coefficient closes, per unit.
        upper, lower = (list(side) for side in zip(*pairs, strict=True))
        gap, change = marks[upper] - marks[lower], moved[:, upper] - moved[:, lower]
        closing.append(-((change * gap).sum(-1) / (gap**2).sum(-1)).mean(1))
    middles = torch.stack([marks[list(lids)].mean(0) for lids in eyelids])
    nearest, eyes = torch.cdist(model.template[model.faces].mean(1), middles).argmin(1), []
    for number, lids in enumerate(eyelids):
        own, share = ball & (nearest == number), closing[number]
        able = (share * _MOST_CLOSING * bounds[:, 1] >= 1) & (closing[1 - number].abs() < _OTHERS_SHARE * share)
        if able.any() and own.any():
            elsewhere = torch.ones(moved.shape[1], dtype=torch.bool)
            elsewhere[list(lids)] = False
            cost = (moved[:, elsewhere] ** 2).sum((1, 2)) / share**2
            index = int(cost.where(able, torch.inf).argmin())
            eyes.append(_eye(model, layout, own, middles[number], index, float(bounds[index, 1])))
    return eyes


def _eye(
    model: FaceModel,
    layout: ParameterLayout,
    ball: Bool[Tensor, " f"],
    middle: Float[Tensor, " 3"],
    index: int,
    most: float,
) -> Eye:
    own = model.template[model.faces[ball].flatten().unique()]
    center = own.mean(0)
    radius = (own - center).norm(dim=1).max()
    distance = (model.template - center).norm(dim=1)
    lids = (distance < _LIDS_REACH * radius)[model.faces].any(1) & ~ball
    around = (distance < _AROUND_REACH * radius)[model.faces].any(1) & ~ball & ~lids
    forward = torch.nn.functional.normalize(middle - center, dim=0)
    parts = [part.nonzero()[:, 0] for part in (ball, lids, around)]
    triangles = torch.cat(parts)
    vertices, faces = model.faces[triangles].unique(return_inverse=True)
    skin = ~model.region_mask(*HIDING_REGIONS)[triangles]
    eye = Eye(
        layout.expression_columns.start + index, most, vertices, faces, len(parts[0]), len(parts[0]) + len(parts[1]),
        skin, forward,
    )  # fmt: skip
    motion = model.expression_basis[layout.expression_index[index]][vertices]
    touching = _where_lids_touch(eye, model.template[vertices], motion, center, radius)
    return replace(eye, closed=min(max(touching, float(layout.units[index])), most))


def _where_lids_touch(
    eye: Eye,
    rest: Float[Tensor, "n 3"],
    motion: Float[Tensor, "n 3"],
    center: Float[Tensor, " 3"],
    radius: Float[Tensor, ""],
) -> float:
    """The value of the coefficient at which the least of the eyeball is seen from far in front."""
    width, far = 192, 40.0 * radius
    focal = width * far / (4 * radius)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, width / 2], [0, 0, 1]])
    viewmat = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    viewmat[:3, 3] = torch.stack([-center[0], center[1], center[2] + far])
    camera = Camera(K, viewmat, width, width)

    def left(amount: float) -> int:
        seen = rasterize_mesh(rest + amount * motion, eye.moving, camera).face_index
        return int(((seen >= 0) & (seen < eye.ball)).sum())

    return min((eye.closed * step / 64 for step in range(65)), key=left)
