"""BakedAvatar: a closed family of formats that exporters and the web runtime read without knowing the method.

An avatar's centres move with a mesh (`MeshBound`), move by their own blend directions and skinning weights
(`BlendSkinned`), or do not move at all (`Static`). Its attributes are constant, or depend on the expression linearly
(`LinearBases`) or through a small network (`AttributeNetwork`). `pose_baked` is the reference implementation for
runtimes.
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
    """m points of one person that move like a face model's vertices (`FaceModel.head_vertices`), identity applied."""

    template: Float[Tensor, "m 3"]
    """Rest positions in the head frame, in metres."""
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
    """Raw values of n Gaussians, independent of how the Gaussians are bound."""

    quats: Float[Tensor, "n 4"]
    log_scales: Float[Tensor, "n 3"]
    opacity_logits: Float[Tensor, " n"]
    sh: Float[Tensor, "n k 3"]


@dataclass(frozen=True, eq=False)
class LinearBases:
    """Changes of the raw values per unit of each expression coefficient. None means no change."""

    means: Float[Tensor, "e n 3"] | None = None
    log_scales: Float[Tensor, "e n 3"] | None = None
    opacity_logits: Float[Tensor, "e n"] | None = None
    sh: Float[Tensor, "e n k 3"] | None = None


@dataclass(frozen=True, eq=False)
class AttributeNetwork:
    """A small network, the same for all Gaussians. Its outputs are added to the raw values.

    Its input is a row of `base` with an addition. With `features`, two sums are added to the first f columns: `basis`
    weighted by the expression, and `joint_basis` weighted by the free joints. With `displacement`, the centre's motion
    from the rig's template is appended, in metres.
    """

    input: Literal["features", "displacement"]
    base: Float[Tensor, "n d"]
    basis: Float[Tensor, "e n f"]
    weights: tuple[Tensor, ...]
    """Weights of each layer, [out, in]."""
    biases: tuple[Tensor, ...]
    activation: Literal["relu", "leaky_relu", "softplus"]
    """Activation between layers. The slope of leaky_relu is 0.01."""
    outputs: tuple[str, ...]
    """Names out of quats, log_scales, opacity_logits and sh, in the order of the last layer's columns."""
    joint_basis: Float[Tensor, "j n f"] | None = None
    """Three entries for each free joint: the change per radian of each component of its axis-angle vector."""


@dataclass(frozen=True, eq=False)
class MeshBound:
    """Gaussians in the frames of a mesh's triangles (method: gaussian_avatars)."""

    rig: Rig
    """The mesh's vertices."""
    faces: Int[Tensor, "f 3"]
    face_index: Int[Tensor, " n"]
    """Index into `faces` for each Gaussian."""
    means: Float[Tensor, "n 3"]
    """Centres in the triangle's frame and units, like the scales and rotations in `attributes`."""
    attributes: Attributes
    sh_frame: Literal["world", "head"]
    """Frame of the view direction for spherical harmonics."""


@dataclass(frozen=True, eq=False)
class BlendSkinned:
    """Gaussians that each have their own blend directions and skinning weights (method: mono_gaussian_avatar)."""

    rig: Rig
    """The Gaussians' own centres."""
    attributes: Attributes
    scale_activation: Literal["exp", "sigmoid"] = "exp"
    scale_gain: float = 1.0
    """With `sigmoid`: scale = gain * sigmoid(raw) + offset, in metres."""
    scale_offset: float = 0.0
    colour_activation: Literal["sh", "sigmoid"] = "sh"
    """With `sigmoid`: the only SH coefficient is the logit of the colour."""
    bases: LinearBases | None = None
    network: AttributeNetwork | None = None


@dataclass(frozen=True, eq=False)
class Static:
    """Gaussians that do not move in the head frame (method: headgas)."""

    means: Float[Tensor, "n 3"]
    """Centres in the head frame, in metres."""
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
    """The rig's points in the head frame, in metres. Ignores `face.identity` and `face.vertex_offsets`."""
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
    """The Gaussians of some timesteps. Only expression, joints and head pose of `face` are used."""
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
    """Raw values of some timesteps: constants, plus linear bases, plus outputs of the network."""
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
