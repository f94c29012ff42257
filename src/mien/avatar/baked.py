"""BakedAvatar: the closed family that exporters and the web runtime read without knowing the method.

An avatar's centres move with a mesh (`MeshBound`), by their own blend directions and skinning weights
(`BlendSkinned`) or not at all (`Static`); its attributes are constant, or follow the expression linearly
(`LinearBases`) or through a small network (`AttributeNetwork`). `pose_baked` is the reference of what a runtime has
to do.
"""

from dataclasses import dataclass, fields
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import leaky_relu, softplus

from mien.avatar.activation import sigmoid
from mien.avatar.rig import bind_to_world
from mien.face import FaceModel, FaceParams, head_poses
from mien.gaussians import Gaussians, sh_from_rgb


@dataclass(frozen=True, eq=False)
class Rig:
    """m points of one person that move as a face model's vertices do (`FaceModel.head_vertices`), identity applied."""

    template: Float[Tensor, "m 3"]
    """In the head frame, metres."""
    expression_names: tuple[str, ...]
    expression_basis: Float[Tensor, "e m 3"]
    joint_names: tuple[str, ...]
    joint_parents: tuple[int, ...]
    joint_free: tuple[bool, ...]
    joint_template: Float[Tensor, "k 3"]
    joint_rotation_basis: Float[Tensor, "e k 3"]
    joint_translation_basis: Float[Tensor, "e k 3"]
    skinning_weights: Float[Tensor, "m k"]
    pose_basis: Float[Tensor, "p m 3"] | None = None


@dataclass(frozen=True, eq=False)
class Attributes:
    """Raw values of n Gaussians that do not depend on the binding."""

    quats: Float[Tensor, "n 4"]
    log_scales: Float[Tensor, "n 3"]
    opacity_logits: Float[Tensor, " n"]
    sh: Float[Tensor, "n k 3"]


@dataclass(frozen=True, eq=False)
class LinearBases:
    """What a unit of each expression coefficient adds to the raw values; None adds nothing."""

    means: Float[Tensor, "e n 3"] | None = None
    log_scales: Float[Tensor, "e n 3"] | None = None
    opacity_logits: Float[Tensor, "e n"] | None = None
    sh: Float[Tensor, "e n k 3"] | None = None


@dataclass(frozen=True, eq=False)
class AttributeNetwork:
    """A small network, the same for all Gaussians, whose outputs are added to the raw values.

    Its input is a row of `base` (and, behind it, what `input` names): `features` adds the expression's combination of
    `basis`, and the free joints' of `joint_basis`, to the first f columns of `base`; `displacement` appends the
    centre's motion from the rig's template, in metres.
    """

    input: Literal["features", "displacement"]
    base: Float[Tensor, "n d"]
    basis: Float[Tensor, "e n f"]
    weights: tuple[Tensor, ...]
    """[out, in] of each layer."""
    biases: tuple[Tensor, ...]
    activation: Literal["relu", "leaky_relu", "softplus"]
    """Between layers; leaky slope 0.01."""
    outputs: tuple[str, ...]
    """Of quats, log_scales, opacity_logits, sh: in the order of the last layer's columns."""
    joint_basis: Float[Tensor, "j n f"] | None = None
    """Three for each free joint: what a radian of its axis-angle's components adds."""


@dataclass(frozen=True, eq=False)
class MeshBound:
    """Gaussians in the frames of a mesh's triangles (methods: gaussian_avatars)."""

    rig: Rig
    """The mesh's vertices."""
    faces: Int[Tensor, "f 3"]
    face_index: Int[Tensor, " n"]
    """Index into `faces` of every Gaussian."""
    means: Float[Tensor, "n 3"]
    """In triangle units, as the attributes' scales and rotations are."""
    attributes: Attributes
    sh_frame: Literal["world", "head"]
    """In which frame the view direction of SH is taken."""


@dataclass(frozen=True, eq=False)
class BlendSkinned:
    """Gaussians that each carry their own blend directions and skinning weights (methods: mono_gaussian_avatar)."""

    rig: Rig
    """The Gaussians' own centres."""
    attributes: Attributes
    scale_activation: Literal["exp", "sigmoid"] = "exp"
    scale_gain: float = 1.0
    """With `sigmoid`: scale = gain * sigmoid(raw) + offset, metres."""
    scale_offset: float = 0.0
    colour_activation: Literal["sh", "sigmoid"] = "sh"
    """With `sigmoid`: the one SH coefficient is the logit of the colour."""
    bases: LinearBases | None = None
    network: AttributeNetwork | None = None


@dataclass(frozen=True, eq=False)
class Static:
    """Gaussians that stay where they are in the head frame (methods: headgas)."""

    means: Float[Tensor, "n 3"]
    """Metres."""
    attributes: Attributes
    expression_names: tuple[str, ...]
    joint_names: tuple[str, ...] = ()
    """Free joints, in the order of the network's `joint_basis`."""
    bases: LinearBases | None = None
    network: AttributeNetwork | None = None


BakedAvatar = MeshBound | BlendSkinned | Static


def bake_rig(face_model: FaceModel, subject: FaceParams) -> Rig:
    """A face model's vertices with one subject's identity and offsets applied."""
    return Rig(
        template=face_model.rest_vertices(subject),
        expression_names=face_model.expression_names,
        expression_basis=face_model.expression_basis,
        joint_names=face_model.joint_names,
        joint_parents=face_model.joint_parents,
        joint_free=face_model.joint_free,
        joint_template=face_model.rest_joints(subject),
        joint_rotation_basis=face_model.joint_rotation_basis,
        joint_translation_basis=face_model.joint_translation_basis,
        skinning_weights=face_model.skinning_weights,
        pose_basis=face_model.pose_basis,
    )


def rig_points(rig: Rig, face: FaceParams) -> Float[Tensor, "b m 3"]:
    """The rig's points in the head frame, metres; `face.identity` and `vertex_offsets` do not count."""
    like = rig.template
    none = torch.zeros(0, 3, dtype=torch.long, device=like.device)
    model = FaceModel(
        name="baked", template=rig.template, faces=none, uv=like.new_zeros(0, 2), uv_faces=none, region_names=(),
        face_regions=none[:, 0], identity_basis=like.new_zeros(0, *like.shape), expression_basis=rig.expression_basis,
        expression_names=rig.expression_names, expression_bounds=like.new_zeros(len(rig.expression_names), 2),
        joint_names=rig.joint_names, joint_parents=rig.joint_parents, joint_free=rig.joint_free,
        joint_template=rig.joint_template, joint_identity_basis=like.new_zeros(0, *rig.joint_template.shape),
        joint_rotation_basis=rig.joint_rotation_basis, joint_translation_basis=rig.joint_translation_basis,
        skinning_weights=rig.skinning_weights, landmarks={}, pose_basis=rig.pose_basis,
    )  # fmt: skip
    head, still = face.head_rotation, face.head_translation
    return model.head_vertices(FaceParams(like.new_zeros(0), face.expression, face.joints, head, still))


def pose_baked(baked: BakedAvatar, face: FaceParams) -> Gaussians:
    """The Gaussians of some timesteps; only expression, joints and head pose of `face` count."""
    if isinstance(baked, MeshBound):
        return _pose_mesh_bound(baked, face)
    if isinstance(baked, BlendSkinned):
        centres = rig_points(baked.rig, face)
        raw = _raw_values(baked.attributes, baked.bases, baked.network, centres - baked.rig.template, face)
        if baked.scale_activation == "sigmoid":
            scales = baked.scale_gain * sigmoid(raw["log_scales"]) + baked.scale_offset
        else:
            scales = raw["log_scales"].exp()
        sh = sh_from_rgb(sigmoid(raw["sh"])) if baked.colour_activation == "sigmoid" else raw["sh"]
        return Gaussians(centres, raw["quats"], scales, sigmoid(raw["opacity_logits"]), sh, head_poses(face))
    still = baked.means.expand(len(face), -1, -1)
    raw = _raw_values(baked.attributes, baked.bases, baked.network, torch.zeros_like(still), face)
    scales, opacities = raw["log_scales"].exp(), sigmoid(raw["opacity_logits"])
    return Gaussians(still + raw["means"], raw["quats"], scales, opacities, raw["sh"], head_poses(face))


def _pose_mesh_bound(baked: MeshBound, face: FaceParams) -> Gaussians:
    pose, raw = head_poses(face), baked.attributes
    vertices = rig_points(baked.rig, face)
    if baked.sh_frame == "world":
        vertices = vertices @ pose[:, :3, :3].transpose(-1, -2) + pose[:, None, :3, 3]
    bound = bind_to_world(vertices, baked.faces, baked.face_index, baked.means, raw.quats, raw.log_scales)
    return Gaussians(
        *bound, sigmoid(raw.opacity_logits), raw.sh, T_world_local=pose if baked.sh_frame == "head" else None
    )


def _raw_values(
    attributes: Attributes,
    bases: LinearBases | None,
    network: AttributeNetwork | None,
    displacement: Float[Tensor, "b n 3"],
    face: FaceParams,
) -> dict[str, Tensor]:
    """Raw values of some timesteps: constants, plus linear bases, plus the network's outputs."""
    batch = len(face)
    raw = {f.name: (value := getattr(attributes, f.name)).expand(batch, *value.shape) for f in fields(Attributes)}
    raw["means"] = torch.zeros_like(displacement)
    if bases is not None:
        for f in fields(LinearBases):
            basis = getattr(bases, f.name)
            if basis is not None:
                raw[f.name] = raw[f.name] + torch.einsum("be,e...->b...", face.expression, basis)
    if network is not None:
        outputs = run_network(network, displacement, face)
        widths = [raw[name][0, 0].numel() for name in network.outputs]
        for name, part in zip(network.outputs, outputs.split(widths, dim=-1), strict=True):
            raw[name] = raw[name] + part.reshape(raw[name].shape)
    return raw


def run_network(
    network: AttributeNetwork, displacement: Float[Tensor, "b n 3"], face: FaceParams
) -> Float[Tensor, "b n out"]:
    """The outputs of an attribute network for some timesteps."""
    values = network.base.expand(len(face), -1, -1)
    if network.input == "features":
        blended = torch.einsum("be,enf->bnf", face.expression, network.basis)
        if network.joint_basis is not None:
            blended = blended + torch.einsum("bj,jnf->bnf", face.joints.flatten(1), network.joint_basis)
        f = blended.shape[-1]
        values = torch.cat([values[..., :f] + blended, values[..., f:]], dim=-1)
    else:
        values = torch.cat([values, displacement], dim=-1)
    activation = {"relu": torch.relu, "leaky_relu": leaky_relu, "softplus": softplus}[network.activation]
    for index, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        values = values @ weight.T + bias
        if index + 1 < len(network.weights):
            values = activation(values)
    return values
