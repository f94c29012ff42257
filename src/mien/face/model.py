"""FaceModel: a linear head model with skinned joints, the same class for every source (anny, FLAME, ICT, GNM)."""

import hashlib
from dataclasses import dataclass, fields, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mien.face.params import FaceParams
from mien.face.posing import has_native_posing, pose_vertices
from mien.rotation import matrix_from_axis_angle, rigid_transform

JOINTS = ("head", "neck", "jaw", "left_eye", "right_eye")
"""Joints of the models that mien builds. Other models may have other joints after `head`."""
JOINT_PARENTS = (-1, 0, 0, 0, 0)
"""Parents of `JOINTS`, as in `FaceModel.joint_parents`."""
EYE_BACK = 0.08
"""Distance from the midpoint of the eyeballs' centres back to the origin of the head frame, in metres."""


@dataclass(frozen=True, eq=False)
class Landmarks:
    """l landmarks as points on a mesh's triangles."""

    faces: Int[Tensor, " l"]
    """Index of each landmark's triangle."""
    barycentric: Float[Tensor, "l 3"]
    """Weights of the triangle's vertices; they sum to 1."""

    def positions(self, vertices: Float[Tensor, "*b v 3"], faces: Int[Tensor, "f 3"]) -> Float[Tensor, "*b l 3"]:
        """Return the landmarks' positions on a mesh with these vertices."""
        corners = vertices[..., faces[self.faces], :]
        return (corners * self.barycentric[:, :, None].to(vertices)).sum(-2)


@dataclass(frozen=True, eq=False)
class FaceModel:
    """A head: template + identity + expression + pose correctives, then linear blend skinning.

    All lengths are in metres, in the head frame: +x to the subject's left, +y up, +z ahead, origin about between the
    ears. Joint 0 is `head`. It is at the origin, and its motion is the head pose itself (`FaceParams.T_world_head`).
    Other joints move relative to their parent. A joint's motion is either free (a row of `FaceParams.joints`) or
    derived from the expression, never both. A derived joint (such as a jaw that follows `jawOpen`) turns by
    `joint_rotation_basis` and shifts by `joint_translation_basis`, both linear in the expression.
    """

    name: str
    template: Float[Tensor, "v 3"]
    faces: Int[Tensor, "f 3"]
    """Vertex indices of the triangles, counter-clockwise seen from outside."""
    uv: Float[Tensor, "u 2"]
    """Texture coordinates, 0..1, v upwards."""
    uv_faces: Int[Tensor, "f 3"]
    """Indices into `uv`."""
    region_names: tuple[str, ...]
    """Names of the model's regions: skin, lips, eyelids, eyes, teeth, tongue, mouth, scalp, ears, nose, brows, neck,
    ..."""
    face_regions: Int[Tensor, " f"]
    """Index of each triangle's region in `region_names`."""
    identity_basis: Float[Tensor, "i v 3"]
    expression_basis: Float[Tensor, "e v 3"]
    expression_names: tuple[str, ...]
    expression_bounds: Float[Tensor, "e 2"]
    """Lower and upper bounds of the coefficients for trackers. Equal bounds fix a coefficient."""
    joint_names: tuple[str, ...]
    joint_parents: tuple[int, ...]
    """Index of each joint's parent; -1 for the head. Parents come before children."""
    joint_free: tuple[bool, ...]
    """Whether a joint is free; False for the head and for derived joints."""
    joint_template: Float[Tensor, "k 3"]
    """Positions of the joints at rest."""
    joint_identity_basis: Float[Tensor, "i k 3"]
    joint_rotation_basis: Float[Tensor, "e k 3"]
    """Derived axis-angle per unit of expression, in radians."""
    joint_translation_basis: Float[Tensor, "e k 3"]
    """Derived shift per unit of expression, in metres."""
    skinning_weights: Float[Tensor, "v k"]
    landmarks: dict[str, Landmarks]
    """Landmark sets by name: `mediapipe` (478 points) and `ibug68` (300-W's 68 points)."""
    pose_basis: Float[Tensor, "p v 3"] | None = None
    """Pose correctives, p = 9 per free joint, as factors of that joint's R - I, row by row."""
    expression_sigmas: Float[Tensor, " e"] | None = None
    """Standard deviations of the coefficients over time, for trackers' priors. If None, the names decide (ARKit's)."""
    shareable: bool = True
    """Whether the licence lets an avatar contain a copy. If not, an avatar only names the model and is not exported."""
    joint_regressor: Float[Tensor, "k v"] | None = None
    """Metres that a joint at rest moves per metre of each vertex offset, in models that regress joints from the shaped
    vertices (FLAME's). If None, offsets do not move joints."""
    flame_origin: Float[Tensor, " 3"] | None = None
    """Origin of the head frame in FLAME's coordinates, in metres. None for models that are not in FLAME's schema."""

    @cached_property
    def content_hash(self) -> str:
        """SHA-256 over everything that decides vertex positions, as 16 hex digits.

        Landmarks and regions do not count.
        """
        digest = hashlib.sha256()
        geometry = (
            "template", "faces", "identity_basis", "expression_basis", "joint_template", "joint_identity_basis",
            "joint_rotation_basis", "joint_translation_basis", "skinning_weights", "pose_basis", "joint_regressor",
        )  # fmt: skip
        for name in geometry:
            tensor = getattr(self, name)
            if tensor is not None:
                digest.update(name.encode() + str(tuple(tensor.shape)).encode())
                digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
        digest.update("|".join((*self.expression_names, *self.joint_names)).encode())
        return digest.hexdigest()[:16]

    @cached_property
    def topology_hash(self) -> str:
        """SHA-256 over the triangles, as 16 hex digits. Landmarks belong to meshes with one such hash."""
        return hashlib.sha256(self.faces.to(torch.int64).cpu().contiguous().numpy().tobytes()).hexdigest()[:16]

    @cached_property
    def free_joint_names(self) -> tuple[str, ...]:
        """Names of the rows of `FaceParams.joints`."""
        return tuple(name for name, free in zip(self.joint_names, self.joint_free, strict=True) if free)

    def neutral(self, timesteps: int = 1) -> FaceParams:
        """Return parameters of the mean person at rest at the world's origin."""
        like = self.template
        return FaceParams(
            identity=like.new_zeros(self.identity_basis.shape[0]),
            expression=like.new_zeros(timesteps, self.expression_basis.shape[0]),
            joints=like.new_zeros(timesteps, len(self.free_joint_names), 3),
            head_rotation=like.new_zeros(timesteps, 3),
            head_translation=like.new_zeros(timesteps, 3),
        )

    def region_mask(self, *names: str) -> Bool[Tensor, " f"]:
        """Return which triangles belong to any of the named regions. Names that the model lacks match nothing."""
        wanted = [index for index, name in enumerate(self.region_names) if name in names]
        return torch.isin(self.face_regions, self.face_regions.new_tensor(wanted))

    def __call__(self, face: FaceParams) -> Float[Tensor, "b v 3"]:
        """Return vertices in world space, in metres.

        They are differentiable in every field of `face`, and computed natively for float32 on a CPU.
        """
        if has_native_posing(self, face):
            return pose_vertices(self, face, in_world=True)
        return self.vertices_reference(face)

    def head_vertices(self, face: FaceParams) -> Float[Tensor, "b v 3"]:
        """Return vertices in the head frame, in metres.

        They are differentiable in every field of `face` but the head pose.
        """
        if has_native_posing(self, face):
            return pose_vertices(self, face, in_world=False)
        return self.head_vertices_reference(face)

    def vertices_reference(self, face: FaceParams) -> Float[Tensor, "b v 3"]:
        """`__call__` in plain PyTorch, any dtype and device."""
        pose = face.T_world_head
        return self.head_vertices_reference(face) @ pose[:, :3, :3].transpose(-1, -2) + pose[:, None, :3, 3]

    def head_vertices_reference(self, face: FaceParams) -> Float[Tensor, "b v 3"]:
        """`head_vertices` in plain PyTorch, any dtype and device."""
        e, v = self.expression_basis.shape[:2]
        moved = (face.expression @ self.expression_basis.reshape(e, v * 3)).reshape(-1, v, 3)
        shaped = self.rest_vertices(face) + moved
        if self.pose_basis is not None:
            like = face.joints
            turned = matrix_from_axis_angle(like) - torch.eye(3, dtype=like.dtype, device=like.device)
            shaped = shaped + torch.einsum("bp,pvc->bvc", turned.flatten(1), self.pose_basis)
        transforms = self.joint_transforms(face)
        moved = torch.einsum("vk,bkrc->bvrc", self.skinning_weights, transforms[:, :, :3])
        return (moved[..., :3] @ shaped[..., None])[..., 0] + moved[..., 3]

    def rest_vertices(self, face: FaceParams) -> Float[Tensor, "v 3"]:
        """Return this person's vertices without expression, in the head frame, in metres."""
        rest = self.template + torch.einsum("i,ivc->vc", face.identity, self.identity_basis)
        return rest if face.vertex_offsets is None else rest + face.vertex_offsets

    def rest_joints(self, face: FaceParams) -> Float[Tensor, "k 3"]:
        """Return this person's joints without expression, in the head frame, in metres."""
        joints = self.joint_template + torch.einsum("i,ikc->kc", face.identity, self.joint_identity_basis)
        if self.joint_regressor is None or face.vertex_offsets is None:
            return joints
        return joints + self.joint_regressor @ face.vertex_offsets

    def joint_transforms(self, face: FaceParams) -> Float[Tensor, "b k 4 4"]:
        """Return each joint's transform of points of the rest pose, in the head frame. The head's is the identity."""
        rest = self.rest_joints(face)
        rotation = torch.einsum("be,ekc->bkc", face.expression, self.joint_rotation_basis)
        shift = torch.einsum("be,ekc->bkc", face.expression, self.joint_translation_basis)
        # Stack joint by joint: an index tensor would be copied to the GPU in every training step.
        given = iter(face.joints.unbind(1))
        turns = [next(given) if free else rotation[:, index] for index, free in enumerate(self.joint_free)]
        matrices = matrix_from_axis_angle(torch.stack(turns, dim=1))
        # Rotation about the joint: x -> R (x - rest) + rest + shift.
        about = rest + shift - (matrices @ rest[:, :, None])[..., 0]
        local = rigid_transform(matrices, about)
        chained: list[Tensor] = []
        for index, parent in enumerate(self.joint_parents):
            chained.append(local[:, index] if parent < 0 else chained[parent] @ local[:, index])
        return torch.stack(chained, dim=1)

    def landmark_positions(self, vertices: Float[Tensor, "*b v 3"], name: str) -> Float[Tensor, "*b l 3"]:
        """Return the positions of a named landmark set on a posed mesh."""
        return self.landmarks[name].positions(vertices, self.faces)

    def to(self, like: Tensor) -> "FaceModel":
        """Return the same model with the float dtype and the device of `like`."""

        def move(value: object) -> object:
            if isinstance(value, Tensor):
                return value.to(like) if value.is_floating_point() else value.to(like.device)
            return value

        moved = {f.name: move(getattr(self, f.name)) for f in fields(self) if f.name != "landmarks"}
        marks = {k: Landmarks(m.faces.to(like.device), m.barycentric.to(like)) for k, m in self.landmarks.items()}
        return replace(self, **moved, landmarks=marks)  # type: ignore[arg-type]
