"""A synthetic person: the face model's head and everything beyond the face model, ready to be posed and drawn."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import torch
from jaxtyping import Float, Int

from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.lab.synthetic.accessories import Glasses, RigidMesh, build_glasses, build_shirt, stack_meshes
from mien.lab.synthetic.anatomy import CHIN, SIDES, Anatomy, measure_anatomy
from mien.lab.synthetic.facial_hair import Lashes, RootedStrands, SkinStrands, grow_beard, grow_brows
from mien.lab.synthetic.hair import DrapedStrands, HeadPose, Strands, grow_long_hair, grow_short_hair, ribbon_faces
from mien.lab.synthetic.motion import neck_pivot, shoulder_rotation
from mien.lab.synthetic.posing import HeadPoser, head_pose, landmark_positions
from mien.lab.synthetic.recipe import PEOPLE, SyntheticRecipe
from mien.lab.synthetic.shading import Lighting, Visibility, compute_visibility, studio_lighting
from mien.lab.synthetic.skin import SkinTextures, paint_skin
from mien.machine import exact

Hair = Strands | DrapedStrands | RootedStrands | SkinStrands | Lashes
Material = IntEnum("Material", ("SKIN", "EYE", "TEETH", "MOUTH", "HAIR", "SHIRT", "FRAME"), start=0)


@dataclass(frozen=True, eq=False)
class Eye:
    """One eyeball at rest."""

    vertices: Int[np.ndarray, " e"]
    local: Float[np.ndarray, "e 3"]
    """Offsets from the centre in metres, +z along the line of sight. Interpolated and normalised, they give exact
    directions."""
    front: Int[np.ndarray, " i"]
    """Vertices of the iris."""
    radius: float
    """Radius in metres."""
    iris_size: float
    """Sine of the angle between the line of sight and the iris's rim."""


@dataclass(frozen=True, eq=False)
class Subject:
    """Everything about a person that does not move by itself, in the head frame at rest."""

    model: FaceModel
    poser: HeadPoser
    anatomy: Anatomy
    textures: SkinTextures
    lighting: Lighting
    visibility: Visibility
    eyes: tuple[Eye, ...]
    iris_color: Float[np.ndarray, " 3"]
    wet_eyes: bool
    shirt_color: Float[np.ndarray, " 3"]
    hair: tuple[Hair, ...]
    """Of the scalp, brows, beard and lashes, if present, in the order of `faces`."""
    glasses: Glasses | None
    shirt: RigidMesh | None
    faces: Int[np.ndarray, "f 3"]
    """Triangles of everything that is opaque."""
    materials: Int[np.ndarray, " f"]
    model_faces: Int[np.ndarray, " m"]
    """Indices of the face model's triangles that come first in `faces`, in this order."""


@dataclass(frozen=True, eq=False)
class PosedSubject(HeadPose):
    """A subject at one timestep, in the head frame."""

    strands: tuple[Strands, ...]
    """The subject's hair."""
    R_world_head: Float[np.ndarray, "3 3"]
    viewpoint: Float[np.ndarray, " 3"]
    """Position of the camera."""


def build_subject(model: FaceModel, identity: torch.Tensor, recipe: SyntheticRecipe, seed: int) -> Subject:
    """Build a person from a seed: paint the skin, add hair and clothes, and compute what shades what."""
    random = np.random.default_rng([seed, 6])
    anatomy = measure_anatomy(model, identity)
    hair_color = _color(random, "hair")
    collar, size = _collar(anatomy)
    eyes = tuple(_eye(anatomy, side) for side in SIDES)
    scalp = None
    if recipe.hair == "long":
        scalp = grow_long_hair(anatomy, hair_color, float(collar[1]), seed)
    elif recipe.hair == "short":
        scalp = grow_short_hair(anatomy, hair_color, seed)
    hair: list[Hair] = [] if scalp is None else [scalp]
    if recipe.brows_and_lashes:
        hair.append(grow_brows(anatomy, 0.7 * hair_color, seed))
    if recipe.beard > 0:
        hair.append(grow_beard(anatomy, 0.8 * hair_color, recipe.beard, seed))
    if recipe.brows_and_lashes:
        hair.append(Lashes(eyes[0].radius))
    glasses = build_glasses(anatomy) if recipe.glasses else None
    shirt = build_shirt(collar, size, _shoulder_points(anatomy, collar, size), seed) if recipe.clothes else None
    # Triangles deep under the shirt are left out.
    is_kept = anatomy.vertices[anatomy.faces].mean(1)[:, 1] > (collar[1] - 0.065 if recipe.clothes else -np.inf)
    kept = np.flatnonzero(is_kept)
    faces, materials = _all_faces(anatomy, kept, hair, glasses, shirt)
    occluders = _occluders(anatomy, scalp, glasses, shirt) if recipe.detail.shadows else None
    return Subject(
        model=model, poser=HeadPoser(model, identity), anatomy=anatomy,
        textures=paint_skin(anatomy, recipe, seed, 0.75 * hair_color), lighting=studio_lighting(seed),
        visibility=compute_visibility(anatomy.vertices, anatomy.normals, occluders), eyes=eyes,
        iris_color=_color(random, "iris"), wet_eyes=recipe.detail.wet_eyes, shirt_color=_color(random, "shirt"),
        hair=tuple(hair), glasses=glasses, shirt=shirt, faces=faces, materials=materials, model_faces=kept,
    )  # fmt: skip


def _color(random: np.random.Generator, of: str) -> Float[np.ndarray, " 3"]:
    colors = PEOPLE["colors"][of]
    return np.array(colors[random.integers(len(colors))], np.float32)


def pose_subject(subject: Subject, face: FaceParams, camera_position: Float[np.ndarray, " 3"]) -> PosedSubject:
    """Return the subject at one timestep (`face` has a batch of one)."""
    model = subject.model
    head = subject.poser(face)
    landmarks = landmark_positions(model, head)
    normals = exact.vertex_normals(head, subject.anatomy.faces)
    T_world_head = head_pose(face)
    R = T_world_head[:3, :3]
    centers = np.stack([head[eye.vertices].mean(0) for eye in subject.eyes])
    pose = HeadPose(head, normals, landmarks, centers, _shoulders(subject, face, R))
    return PosedSubject(
        **vars(pose), strands=tuple(hair.posed(pose) for hair in subject.hair), R_world_head=R,
        viewpoint=exact.rotated(camera_position - T_world_head[:3, 3], R.T),
    )  # fmt: skip


def opaque_vertices(subject: Subject, posed: PosedSubject) -> Float[np.ndarray, "w 3"]:
    """Return the vertices of `subject.faces` in the head frame."""
    parts = [posed.head]
    parts += [strands.ribbon_vertices(posed.viewpoint) for strands in posed.strands]
    if subject.glasses is not None:
        parts.append(subject.glasses.frame.vertices)
    if subject.shirt is not None:
        T = posed.T_head_shoulders
        parts.append(exact.rotated(subject.shirt.vertices, T[:3, :3], T[:3, 3]))
    return np.concatenate(parts).astype(np.float32)


def _shoulders(subject: Subject, face: FaceParams, R_world_head: np.ndarray) -> Float[np.ndarray, "4 4"]:
    """Return the shoulders' pose in the head frame. They turn less than the head, about the neck joint."""
    pivot = neck_pivot(subject.model, face.identity)
    R = exact.product(R_world_head.T, shoulder_rotation(face.head_rotation[0].numpy()))
    T = np.eye(4, dtype=np.float32)
    T[:3, :3], T[:3, 3] = R, pivot - exact.dot(R, pivot)
    return T


def _eye(anatomy: Anatomy, side: str) -> Eye:
    vertices = anatomy.eye_vertices(side)
    iris = np.intersect1d(vertices, np.unique(anatomy.faces[anatomy.region("irises")]))
    offsets = anatomy.vertices[vertices] - anatomy.vertices[vertices].mean(0)
    directions = offsets / exact.length(offsets)[:, None]
    axis = directions[np.isin(vertices, iris)].mean(0) if len(iris) else np.array([0, 0, 1.0])
    axis = axis / exact.length(axis)
    right = np.cross([0, 1, 0], axis)
    right /= exact.length(right)
    basis = np.stack([right, np.cross(axis, right), axis]).T
    rim = exact.length(exact.product(directions, basis)[np.isin(vertices, iris), :2]).max() if len(iris) else 0.42
    radius = float(exact.length(offsets).mean())
    return Eye(vertices, exact.product(offsets, basis).astype(np.float32), iris, radius, float(rim))


def _collar(anatomy: Anatomy) -> tuple[Float[np.ndarray, " 3"], tuple[float, float]]:
    """Return the middle, half width and half depth of the neck at the collar's height."""
    y = float(anatomy.landmarks[CHIN, 1]) - 0.052
    neck = anatomy.vertices[np.unique(anatomy.faces[anatomy.skin])]
    ring = neck[np.abs(neck[:, 1] - y) < 0.012]
    ring = ring[np.abs(ring[:, 0]) < 0.085]
    half_width = float(np.quantile(np.abs(ring[:, 0]), 0.95))
    front, back = np.quantile(ring[:, 2], 0.97), np.quantile(ring[:, 2], 0.03)
    return np.array([0, y, 0.5 * (front + back)], np.float32), (half_width, 0.5 * float(front - back))


def _shoulder_points(
    anatomy: Anatomy, collar: Float[np.ndarray, " 3"], size: tuple[float, float]
) -> Float[np.ndarray, "p 3"]:
    """Return dense points of the model's skin that a shirt has to cover: low and beside the neck."""
    faces = anatomy.faces[anatomy.skin]
    centers = anatomy.vertices[faces].mean(1) - collar
    beside = (centers[:, 1] < 0.02) & (centers[:, 1] > -0.06) & (np.abs(centers[:, 0]) > 1.02 * size[0])
    weights = np.random.default_rng(0).dirichlet((1, 1, 1), (beside.sum(), 40)).astype(np.float32)
    corners = anatomy.vertices[faces[beside]]
    return np.concatenate([exact.product(weights, corners).reshape(-1, 3), corners.reshape(-1, 3)])


def _occluders(
    anatomy: Anatomy, scalp: Strands | DrapedStrands | None, glasses: Glasses | None, shirt: RigidMesh | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return what casts shadows: the head at rest, every fourth strand three times as wide, the rims, the shoulders."""
    closed = ~anatomy.region("eyes", "irises", "teeth", "tongue", "mouth", "eye_sockets")
    meshes = [(anatomy.vertices, anatomy.faces[closed])]
    if scalp is not None:
        hair = scalp.rest if isinstance(scalp, DrapedStrands) else scalp
        wide = Strands(hair.points[::4], 3.0 * hair.widths[::4], hair.colors[::4], hair.outwards[::4])
        # Ribbons that face the skull's centre lie flat on the skin.
        meshes.append((wide.ribbon_vertices(anatomy.skull_center), ribbon_faces(*wide.widths.shape)))
    meshes += [
        (part.vertices, part.faces) for part in ([glasses.frame] if glasses else []) + ([shirt] if shirt else [])
    ]
    return stack_meshes(meshes)


def _all_faces(
    anatomy: Anatomy, kept: np.ndarray, hair: Sequence[Hair], glasses: Glasses | None, shirt: RigidMesh | None,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return the triangles over `opaque_vertices` and their materials."""
    of_model = np.full(len(anatomy.faces), int(Material.SKIN))
    of_model[anatomy.region("eyes", "irises")] = Material.EYE
    of_model[anatomy.region("teeth")] = Material.TEETH
    of_model[anatomy.region("mouth", "tongue", "eye_sockets")] = Material.MOUTH
    faces, materials, start = [anatomy.faces[kept]], [of_model[kept]], len(anatomy.vertices)

    def add(part_faces: np.ndarray, vertices: int, material: int) -> None:
        nonlocal start
        faces.append(part_faces + start)
        materials.append(np.full(len(part_faces), material))
        start += vertices

    rest = HeadPose(anatomy.vertices, anatomy.normals, anatomy.landmarks, np.zeros((2, 3)), np.eye(4))
    for part in hair:
        strands, points = part.posed(rest).widths.shape
        add(ribbon_faces(strands, points), 2 * strands * points, Material.HAIR)
    if glasses is not None:
        add(glasses.frame.faces, len(glasses.frame.vertices), Material.FRAME)
    if shirt is not None:
        add(shirt.faces, len(shirt.vertices), Material.SHIRT)
    return np.concatenate(faces), np.concatenate(materials)
