"""Posing without torch: the Gaussians of a baked avatar for one timestep. This is the reference for other runtimes."""

from dataclasses import dataclass, fields
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float32, Int32, Int64

from mien import _native
from mien.runtime.baked import (
    AttributeNetwork,
    Attributes,
    BakedAvatar,
    BlendSkinned,
    ExpressionChanges,
    FeatureChanges,
    FeatureDirections,
    LinearBases,
    MeshBound,
    Rig,
)

_MOST_LAYERS = 64
_POINT_OUTPUTS = ("log_scales", "quats", "opacity_logits", "sh")
SH_C0 = 0.28209479177387814
"""The constant spherical harmonic: colour = 0.5 + SH_C0 * coefficient."""


@dataclass(frozen=True, eq=False)
class Face:
    """Face parameters of one timestep."""

    expression: Float32[np.ndarray, " e"]
    joints: Float32[np.ndarray, "j 3"]
    """Axis-angle vectors of the free joints, in radians."""
    head_rotation: Float32[np.ndarray, " 3"]
    """Axis-angle vector of the head in world space, in radians."""
    head_translation: Float32[np.ndarray, " 3"]
    """Origin of the head frame in world space, in metres."""

    @property
    def T_world_head(self) -> Float32[np.ndarray, "4 4"]:
        """The pose of the head frame."""
        transform = np.empty((1, 4, 4), np.float32)
        _native.head_poses(_batch(self.head_rotation), _batch(self.head_translation), transform)
        return transform[0]


@dataclass(frozen=True, eq=False)
class Gaussians:
    """n activated Gaussians."""

    means: Float32[np.ndarray, "n 3"]
    """Centres in the local frame, in metres."""
    quats: Float32[np.ndarray, "n 4"]
    """Rotations as wxyz quaternions, not always of unit length."""
    scales: Float32[np.ndarray, "n 3"]
    """Standard deviations along the rotated axes, in metres."""
    opacities: Float32[np.ndarray, " n"]
    """Opacities, 0 to 1."""
    sh: Float32[np.ndarray, "n s 3"]
    """Real spherical-harmonics coefficients of the colour in the local frame."""
    T_world_local: Float32[np.ndarray, "4 4"] | None = None
    """Rigid pose of the local frame. None means that the local frame is the world's."""

    def __len__(self) -> int:
        """The number of Gaussians, n."""
        return len(self.means)


def pose(baked: BakedAvatar, face: Face) -> Gaussians:
    """The Gaussians of a face."""
    if isinstance(baked, MeshBound):
        return _pose_mesh_bound(baked, face)
    if isinstance(baked, BlendSkinned):
        return _pose_blend_skinned(baked, face)
    none = np.zeros_like(baked.means)
    raw = _raw_values(baked.attributes, baked.bases, baked.network, none, face)
    scales, opacities = np.exp(raw["log_scales"]), sigmoid(raw["opacity_logits"])
    return _contiguous(baked.means + raw["means"], raw["quats"], scales, opacities, raw["sh"], face.T_world_head)


def _pose_blend_skinned(baked: BlendSkinned, face: Face) -> Gaussians:
    shaped, centers = shaped_and_posed(baked.rig, face)
    if baked.still_weights is not None and baked.still_pose is not None:
        still = np.linalg.inv(face.T_world_head.astype(np.float64)) @ baked.still_pose
        transform = np.ascontiguousarray(still[:3], np.float32)
        _native.add_bone(shaped, _contiguous_row(baked.still_weights), transform, centers)
    if has_native_activations(baked):
        return _with_native_activations(baked, centers, face)
    raw = _raw_values(baked.attributes, baked.bases, baked.network, centers - baked.rig.template, face)
    if baked.scale_activation == "sigmoid":
        scales = baked.scale_gain * sigmoid(raw["log_scales"]) + baked.scale_offset
    else:
        scales = np.exp(raw["log_scales"])
    sh = (sigmoid(raw["sh"]) - 0.5) / SH_C0 if baked.color_activation == "sigmoid" else raw["sh"]
    return _contiguous(centers, raw["quats"], scales, sigmoid(raw["opacity_logits"]), sh, face.T_world_head)


def has_native_activations(baked: BlendSkinned) -> bool:
    """Whether all changes of attributes are those of one network of points, which the core activates."""
    network = baked.network
    return (
        network is not None
        and _has_native_layers(network)
        and network.outputs == _POINT_OUTPUTS
        and baked.bases is None
        and (baked.scale_activation, baked.color_activation) == ("sigmoid", "sigmoid")
        and baked.attributes.sh.shape[1] == 1
    )


def _with_native_activations(baked: BlendSkinned, centers: Float32[np.ndarray, "n 3"], face: Face) -> Gaussians:
    """The Gaussians of such an avatar, with the bits that numpy gives."""
    assert baked.network is not None
    changes = _run_layers(baked.network, centers - baked.rig.template)
    raw, n = baked.attributes, len(centers)
    own = (raw.log_scales, raw.quats, raw.opacity_logits, raw.sh[:, 0])
    out = tuple(np.empty(shape, np.float32) for shape in ((n, 3), (n, 4), (n,), (n, 1, 3)))
    _native.activate_points(
        _native.RawPoints(changes, *(_contiguous_row(part) for part in own)),
        baked.scale_gain,
        baked.scale_offset,
        _native.ActivatedPoints(*out),
    )
    scales, quats, opacities, sh = out
    return Gaussians(np.ascontiguousarray(centers), quats, scales, opacities, sh, face.T_world_head)


def rig_points(rig: Rig, face: Face, in_world: bool = False) -> Float32[np.ndarray, "m 3"]:
    """The rig's points in the head frame or in world space, in metres, by the same operation as in training."""
    return shaped_and_posed(rig, face, in_world)[1]


def shaped_and_posed(
    rig: Rig, face: Face, in_world: bool = False
) -> tuple[Float32[np.ndarray, "m 3"], Float32[np.ndarray, "m 3"]]:
    """The rig's points before skinning and after it."""
    compiled = _compiled.get(rig)
    if compiled is None:
        compiled = _compiled[rig] = _native.make_face_model(
            rig.expression_basis,
            rig.pose_basis,
            rig.joint_rotation_basis,
            rig.joint_translation_basis,
            rig.skinning_weights,
            parents=rig.joint_parents,
            is_free=rig.joint_free,
        )
    head = (_batch(face.head_rotation), _batch(face.head_translation)) if in_world else (None, None)
    shaped, points = (np.empty((1, *rig.template.shape), np.float32) for _ in range(2))
    arrays = _native.FaceArrays(rig.template, rig.joint_template, _batch(face.expression), _batch(face.joints), *head)
    _native.pose_face(compiled, arrays, shaped=shaped, vertices=points)
    return shaped[0], points[0]


_compiled: "WeakKeyDictionary[Rig, _native.FaceModelData]" = WeakKeyDictionary()


def _batch(values: np.ndarray) -> np.ndarray:
    """One timestep's parameters in the form that the core takes."""
    return np.ascontiguousarray(values[None], np.float32)


def _pose_mesh_bound(baked: MeshBound, face: Face) -> Gaussians:
    pose, raw = face.T_world_head, baked.attributes
    local_means, opacity_logits, sh = baked.means, raw.opacity_logits, raw.sh
    if baked.changes is not None:
        changes = expression_changes(baked.changes, face, baked.face_index)
        local_means = local_means + changes.get("means", np.float32(0))
        opacity_logits = opacity_logits + changes.get("opacity_logits", np.float32(0))
        if "color" in changes:
            sh = np.concatenate([sh[:, :1] + changes["color"][:, None], sh[:, 1:]], axis=1)
    in_head = baked.sh_frame == "head"
    vertices = rig_points(baked.rig, face, in_world=not in_head)
    n = len(raw.quats)
    frames = np.empty((1, len(baked.faces), _native.TRIANGLE_FRAME_FLOATS), np.float32)
    means, quats, scales = (np.empty((1, n, width), np.float32) for width in (3, 4, 3))
    _native.rig_forward(
        np.ascontiguousarray(vertices[None]),
        baked.faces.astype(np.int64),
        baked.face_index.astype(np.int64),
        _native.LocalShapes(local_means, raw.quats, raw.log_scales),
        frames=frames,
        world=_native.WorldShapes(means, quats, scales),
    )
    T_world_local = pose if in_head else None
    return _contiguous(means[0], quats[0], scales[0], sigmoid(opacity_logits), sh, T_world_local)


def expression_changes(
    changes: ExpressionChanges, face: Face, face_index: Int32[np.ndarray, " n"]
) -> dict[str, np.ndarray]:
    """Return the changes of the raw values, by the names of the parts: [n, 3], [n] and [n, 3]. None changes nothing."""
    table = activation_table(changes, face)
    rows = None if changes.shares is None else face_index.astype(np.int64)
    added = {}
    for name in ("color", "opacity_logits", "means"):
        basis = getattr(changes, name)
        if basis is not None:
            added[name] = np.empty(basis.shape[:-1], np.float32)
            _native.expression_change(np.ascontiguousarray(basis), table, rows, added[name])
    if changes.features is not None:
        color, opacity_logits = feature_changes(changes.features, table, rows)
        added["color"] = added.get("color", np.float32(0)) + color
        added["opacity_logits"] = added.get("opacity_logits", np.float32(0)) + opacity_logits
    return added


def activation_table(changes: ExpressionChanges | FeatureDirections, face: Face) -> Float32[np.ndarray, "_ a"]:
    """The activations of each triangle, or one row for all if the face is one region; the same in training."""
    known = _activations.get(changes)
    if known is None:
        known = _activations[changes] = face_activations(changes)
    out = np.empty(_native.activation_shape(known), np.float32)
    pose = _contiguous_row(face.head_rotation), _contiguous_row(face.head_translation)
    _native.activation_table(known, _contiguous_row(face.expression), _contiguous_row(face.joints), *pose, out)
    return out


def face_activations(changes: ExpressionChanges | FeatureDirections) -> _native.FaceActivations:
    """Return the activations' arrays in the form that the core takes."""
    seen = np.empty((0, changes.directions.shape[1]), np.float32)
    shares = head = None
    if isinstance(changes, ExpressionChanges):
        seen, shares, head = changes.seen, changes.shares, changes.head
    of_head = (None, None, None) if head is None else (head.rest, head.directions, head.seen)
    own = _contiguous_row(changes.rest), _contiguous_row(changes.directions), _contiguous_row(seen)
    shares, rest, directions, limits = (None if one is None else _contiguous_row(one) for one in (shares, *of_head))
    return _native.make_face_activations(*own, shares, rest, directions, limits)


_activations: "WeakKeyDictionary[ExpressionChanges | FeatureDirections, _native.FaceActivations]" = WeakKeyDictionary()


def feature_changes(
    features: FeatureChanges, activations: Float32[np.ndarray, "_ a"], rows: Int64[np.ndarray, " n"] | None
) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, " n"]]:
    """Changes of the first SH coefficient and of the raw opacity, by the same operation as in training.

    `rows` are the rows of the Gaussians' activations. None stands for the first.
    """
    layers = zip(features.weights, features.biases, strict=True)
    arrays = [features.neutral, features.own, *(array for layer in layers for array in layer)]
    network = _native.FeatureNetwork(*(np.ascontiguousarray(array) for array in arrays))
    color, opacity_logits = (np.empty((len(features.neutral), *shape), np.float32) for shape in ((3,), ()))
    bases = _native.FeatureBases(np.ascontiguousarray(features.basis), activations, rows)
    _native.feature_network(network, bases, None, color, opacity_logits)
    return color, opacity_logits


def _raw_values(
    attributes: Attributes,
    bases: LinearBases | None,
    network: AttributeNetwork | None,
    displacement: Float32[np.ndarray, "n 3"],
    face: Face,
) -> dict[str, np.ndarray]:
    """Constants, plus linear bases, plus outputs of the network."""
    raw = {f.name: getattr(attributes, f.name) for f in fields(Attributes)}
    raw["means"] = np.zeros_like(displacement)
    if bases is not None:
        for f in fields(LinearBases):
            basis = getattr(bases, f.name)
            if basis is not None:
                raw[f.name] = raw[f.name] + np.tensordot(face.expression, basis, 1)
    if network is not None and _has_native(network):
        outputs = _run_native(network, face)
        for name, values in zip(network.outputs, outputs, strict=True):
            values = values.reshape(raw[name].shape)
            values += raw[name]
            raw[name] = values
    elif network is not None:
        runs = _run_layers(network, displacement) if _has_native_layers(network) else None
        outputs, start = run_network(network, displacement, face) if runs is None else runs, 0
        for name in network.outputs:
            width = raw[name][0].size if len(raw[name]) else 0
            raw[name] = raw[name] + outputs[:, start : start + width].reshape(raw[name].shape)
            start += width
    return raw


def _has_native_layers(network: AttributeNetwork) -> bool:
    """Whether this is a network of `_native.point_network`: of the points' motion, with ReLU."""
    return network.input == "displacement" and network.activation == "relu" and len(network.weights) <= _MOST_LAYERS


def _run_layers(network: AttributeNetwork, displacement: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n _"]:
    """The outputs of such a network, by the same operation as in training."""
    layers = [
        _native.PointLayer(_contiguous_row(weight), _contiguous_row(bias), int(index + 1 < len(network.weights)), -1)
        for index, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True))
    ]
    width = network.base.shape[1]
    inputs = np.empty((len(displacement), width + 3), np.float32)
    inputs[:, :width], inputs[:, width:] = network.base, displacement
    outputs = np.empty((len(inputs), len(network.biases[-1])), np.float32)
    _native.point_network(layers, inputs, None, outputs)
    return outputs


def _has_native(network: AttributeNetwork) -> bool:
    """Whether this is the network of `_native.feature_network`: two layers on blended features."""
    return (
        network.input == "features"
        and len(network.weights) == 2
        and network.activation == "leaky_relu"
        and network.outputs == ("sh", "opacity_logits")
    )


def _run_native(network: AttributeNetwork, face: Face) -> tuple[np.ndarray, np.ndarray]:
    """The outputs of such a network, by the same operation as in training, as two arrays."""
    along = network.along
    assert along is not None
    prepared = _networks.get(network)
    if prepared is None:
        width = along.basis.shape[2]
        rows = [np.ascontiguousarray(part, np.float32) for part in (network.base[:, :width], network.base[:, width:])]
        layers = zip(network.weights, network.biases, strict=True)
        arrays = [np.ascontiguousarray(array, np.float32) for layer in layers for array in layer]
        prepared = _networks[network] = _native.FeatureNetwork(*rows, *arrays)
    bases = _native.FeatureBases(np.ascontiguousarray(along.basis), activation_table(along, face), None)
    n, outputs = len(network.base), len(network.biases[-1])
    sh, opacity_logits = np.empty((n, outputs - 1), np.float32), np.empty(n, np.float32)
    _native.feature_network(prepared, bases, None, sh, opacity_logits)
    return sh, opacity_logits


_networks: "WeakKeyDictionary[AttributeNetwork, _native.FeatureNetwork]" = WeakKeyDictionary()


def _contiguous_row(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, np.float32)


def run_network(
    network: AttributeNetwork, displacement: Float32[np.ndarray, "n 3"], face: Face
) -> Float32[np.ndarray, "n _"]:
    """The outputs of an attribute network, in numpy. This is the reference of `_native.feature_network`."""
    along = network.along
    if along is not None:
        blended = _combined(along.basis.swapaxes(0, 1), activation_table(along, face)[0])
        values = network.base.copy()
        values[:, : blended.shape[1]] += blended
    else:
        values = np.concatenate([network.base, displacement], axis=1)
    for index, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        values = values @ weight.T + bias
        if index + 1 < len(network.weights):
            values = _ACTIVATIONS[network.activation](values)
    return values


def _combined(basis: Float32[np.ndarray, "b n w"], coefficients: Float32[np.ndarray, " b"]) -> np.ndarray:
    """Sum of the basis rows weighted by coefficients. Rows with a coefficient of zero are not read."""
    used = np.flatnonzero(coefficients)
    flat = basis.reshape(len(basis), -1)
    total = np.zeros(flat.shape[1], np.float32)
    for row in used:
        total += coefficients[row] * flat[row]
    return total.reshape(basis.shape[1:])


def sigmoid(values: Float32[np.ndarray, "*s"]) -> Float32[np.ndarray, "*s"]:
    """1 / (1 + exp(-x)), by the same operation as in training."""
    out = np.empty(values.shape, np.float32)
    _native.sigmoid(np.ascontiguousarray(values, np.float32), out)
    return out


_ACTIVATIONS = {
    "relu": lambda values: np.maximum(values, 0),
    "leaky_relu": lambda values: np.maximum(values, np.float32(0.01) * values),
    "softplus": lambda values: np.logaddexp(values, np.float32(0)),
}


def _contiguous(*arrays: np.ndarray | None) -> Gaussians:
    return Gaussians(*(None if a is None else np.ascontiguousarray(a, np.float32) for a in arrays))  # pyright: ignore[reportArgumentType]
