"""The packed form of an avatar for web pages: arrays as integers of 8 or 16 bits, gzipped (docs/web.md).

A value is middle + integer * step. There is one middle and step for each index of the array's first axis, or for each
column, which is an index of all other axes together. `unpacked` gives the avatar as a page sees it, so that what is
lost can be measured.
"""

import json
import struct
import zlib
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, Literal, TypeVar

import numpy as np
from jaxtyping import Float32, Int

from mien.errors import UserError
from mien.runtime.baked import (
    BakedAvatar,
    BlendSkinned,
    ExpressionChanges,
    FeatureChanges,
    MeshBound,
    PortableAvatar,
    Static,
)
from mien.runtime.posing import Face
from mien.runtime.still import standing_still

Baked = TypeVar("Baked", bound=BakedAvatar)
FORMAT, VERSION = "mien.packed", 1


@dataclass(frozen=True, eq=False)
class Motion:
    """Face parameters of t timesteps that a page can play."""

    expression: Float32[np.ndarray, "t e"]
    joints: Float32[np.ndarray, "t j 3"]
    """Axis-angle vectors in radians."""
    head_rotation: Float32[np.ndarray, "t 3"]
    """Axis-angle vectors in radians."""
    head_translation: Float32[np.ndarray, "t 3"]
    """Positions in metres."""
    fps: float
    """Timesteps per second."""

    def __len__(self) -> int:
        """The number of timesteps, t."""
        return len(self.expression)

    def face(self, timestep: int) -> Face:
        """The face of one timestep."""
        arrays = (self.expression, self.joints, self.head_rotation, self.head_translation)
        return Face(*(array[timestep] for array in arrays))


@dataclass(frozen=True)
class _Code:
    bits: Literal[8, 16]
    axis: Literal["first", "columns"]
    signed: bool = False
    """Whether the middle is zero, so that zeros stay zeros."""
    levels: int | None = None
    """Largest integer, if it is smaller than that of the bits: fewer levels compress better."""


_CODES = {
    "avatar.baked.means": _Code(16, "columns", levels=2047),
    "avatar.baked.attributes.quats": _Code(8, "columns", signed=True, levels=63),
    "avatar.baked.attributes.log_scales": _Code(8, "columns"),
    "avatar.baked.attributes.opacity_logits": _Code(8, "columns"), "avatar.baked.attributes.sh": _Code(8, "columns"),
    "avatar.baked.changes.color": _Code(8, "columns", signed=True),
    "avatar.baked.changes.opacity_logits": _Code(8, "columns", signed=True),
    "avatar.baked.changes.means": _Code(8, "columns", signed=True, levels=63),
    "avatar.baked.changes.shares": _Code(8, "columns"), "avatar.baked.changes.features.neutral": _Code(8, "columns"),
    "avatar.baked.changes.features.basis": _Code(8, "columns", signed=True, levels=31),
    "avatar.baked.changes.features.own": _Code(8, "columns"),
    "avatar.baked.bases.means": _Code(16, "first", signed=True),
    "avatar.baked.bases.log_scales": _Code(8, "columns", signed=True),
    "avatar.baked.bases.opacity_logits": _Code(8, "columns", signed=True),
    "avatar.baked.bases.sh": _Code(8, "columns", signed=True), "avatar.baked.network.base": _Code(16, "columns"),
    "avatar.baked.network.along.basis": _Code(8, "columns", signed=True),
    "avatar.baked.still_weights": _Code(16, "columns", signed=True), "avatar.baked.rig.template": _Code(16, "columns"),
    "avatar.baked.rig.expression_basis": _Code(16, "first", signed=True, levels=1023),
    "avatar.baked.rig.pose_basis": _Code(8, "first", signed=True),
    "avatar.baked.rig.skinning_weights": _Code(16, "columns", signed=True), "motion.expression": _Code(16, "columns"),
    "motion.joints": _Code(16, "columns"), "motion.head_rotation": _Code(16, "columns"),
    "motion.head_translation": _Code(16, "columns"),
}  # fmt: skip
"""Arrays that are not named here are stored as they are; all of them are small."""
_BLOCKS = 6
"""zlib's memLevel, which decides how much of an array shares one Huffman code. 8, the default, makes packed avatars 2 %
larger, and 4 does, too."""
_LEAST_LOG_SCALE = -12.0
"""Smallest logarithm of a scale that is kept. Beside the dilation of 0.3 pixels^2, smaller ones are not visible."""
_OPACITY_LOGITS = (-6.5, 7.5)
"""Range of raw opacities that is kept: below 1/255, nothing is drawn; above 0.999, alpha is cut."""


def pack(avatar: PortableAvatar, motion: Motion | None = None) -> bytes:
    """The packed form of an avatar, with a motion or without. The same input gives the same bytes."""
    tensors: dict[str, dict[str, Any]] = {}
    pieces: list[bytes] = []
    content = _tree({"avatar": _prepared(avatar), "motion": motion}, "", tensors, pieces)
    header = {"format": FORMAT, "version": VERSION, "content": content, "tensors": tensors}
    text = json.dumps(header, allow_nan=False, separators=(",", ":")).encode()
    text += b" " * (-(4 + len(text)) % 4)
    return _gzipped([struct.pack("<I", len(text)) + text, *pieces])


def _gzipped(parts: list[bytes]) -> bytes:
    """A gzip file of all parts, each compressed with repetitions or by its bytes' frequencies alone, as is smaller.

    What is nearly noise, as rotations and offsets are, becomes larger by the repetitions that are found in it.
    """
    blocks = [min((_deflated(part, by) for by in (zlib.Z_FILTERED, zlib.Z_HUFFMAN_ONLY)), key=len) for part in parts]
    last = zlib.compressobj(wbits=-zlib.MAX_WBITS).flush()
    whole = b"".join(parts)
    checks = struct.pack("<II", zlib.crc32(whole), len(whole) % 2**32)
    return b"\x1f\x8b\x08" + bytes(5) + b"\x02\xff" + b"".join(blocks) + last + checks


def _deflated(part: bytes, strategy: int) -> bytes:
    """Whole blocks of a deflate stream, which refer to nothing before them."""
    compressor = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS, _BLOCKS, strategy)
    return compressor.compress(part) + compressor.flush(zlib.Z_SYNC_FLUSH)


def unpacked(avatar: PortableAvatar) -> PortableAvatar:
    """The avatar as a page reads it from its packed form."""
    return _coded(_prepared(avatar), "avatar")


def _prepared(avatar: PortableAvatar) -> PortableAvatar:
    """The same avatar as pages draw it: bound Gaussians in the order of their triangles, others as they are."""
    match avatar.baked:
        case MeshBound() as baked:
            return replace(avatar, baked=_ordered(baked))
        case Static() as baked if (bound := bound_features(avatar, baked)) is not None:
            return replace(avatar, baked=_ordered(bound))
        case BlendSkinned() | Static() as baked:
            _check_colors(baked, avatar.about.name)
            return avatar


def bound_features(avatar: PortableAvatar, baked: Static) -> MeshBound | None:
    """Static Gaussians with a network of features as features on one triangle that never moves. They look the same.

    GPUs run such networks of bound Gaussians; pages run those of others on the processor. None if their changes are not
    those of `FeatureChanges`: another network, linear bases, or colours that depend on the view.
    """
    network = baked.network
    if (
        network is None
        or network.along is None
        or baked.bases is not None
        or len(network.weights) != 2
        or network.activation != "leaky_relu"
        or network.outputs != ("sh", "opacity_logits")
        or baked.attributes.sh.shape[1] != 1
    ):
        return None
    along = network.along
    width = along.basis.shape[2]
    changes = ExpressionChanges(
        rest=along.rest,
        directions=along.directions,
        seen=np.empty((0, along.directions.shape[1]), np.float32),
        features=FeatureChanges(
            neutral=np.ascontiguousarray(network.base[:, :width]),
            basis=along.basis,
            own=np.ascontiguousarray(network.base[:, width:]),
            weights=network.weights,
            biases=network.biases,
        ),
    )
    return standing_still(baked.means, baked.attributes, avatar.expression_names, avatar.joint_names, changes)


def _ordered(baked: MeshBound) -> MeshBound:
    """The same Gaussians in the order of their triangles, with unit rotations, and without invisible differences."""
    order = np.argsort(baked.face_index, kind="stable")
    raw = baked.attributes
    lengths = np.maximum(np.linalg.norm(raw.quats, axis=1, keepdims=True), 1e-12)
    quats = raw.quats / lengths * np.where(raw.quats[:, :1] < 0, np.float32(-1), np.float32(1))
    opacity_logits = raw.opacity_logits
    if baked.changes is None:  # otherwise a change may lift a value back into the range
        opacity_logits = np.clip(opacity_logits, *_OPACITY_LOGITS, dtype=np.float32)
    log_scales = np.maximum(raw.log_scales, np.float32(_LEAST_LOG_SCALE))
    attributes = replace(raw, quats=quats.astype(np.float32), log_scales=log_scales, opacity_logits=opacity_logits)
    return with_rows(replace(baked, attributes=attributes), order)


def _check_colors(baked: BlendSkinned | Static, name: str) -> None:
    """Refuse colours that depend on face and view: pages change the first coefficient of colours with the face."""
    count = baked.attributes.sh.shape[1]
    bases, network = baked.bases, baked.network
    vary = (bases is not None and bases.sh is not None) or (network is not None and "sh" in network.outputs)
    if vary and count > 1:
        raise UserError(
            f"{name}: its colours depend on the face and on the view ({count} coefficients each), which a page cannot "
            "draw; train it with colours of degree 0, or export a .mien"
        )


def _quantise(array: np.ndarray, code: _Code) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Integers by group, an index of the first axis or of all others together, and each group's middle and step."""
    rows, most = array.astype(np.float64).reshape(len(array), -1), code.levels or 2 ** (code.bits - 1) - 1
    rows = rows if code.axis == "first" else rows.T
    low, high = rows.min(1, initial=np.inf), rows.max(1, initial=-np.inf)
    low, high = np.where(np.isfinite(low), low, 0.0), np.where(np.isfinite(high), high, 0.0)
    middle = np.zeros(len(rows)) if code.signed else (low + high) / 2
    half = np.maximum(np.abs(low), np.abs(high)) if code.signed else (high - low) / 2
    step = np.where(half > 0, half / most, 1.0)
    integers = np.rint((rows - middle[:, None]) / step[:, None]).clip(-most, most)
    return integers.astype(np.int8 if code.bits == 8 else np.int16), middle, step


def _tree(value: Any, path: str, tensors: dict[str, dict[str, Any]], pieces: list[bytes]) -> Any:
    """`value` as json. Arrays go to `pieces`, and what describes them to `tensors`, under their dotted paths."""
    if isinstance(value, np.ndarray):
        entry, data = _stored(value, _CODES.get(path))
        tensors[path] = {"shape": list(value.shape), **entry, "at": sum(map(len, pieces))}
        pieces.append(data + b"\0" * (-len(data) % 4))
        return {"tensor": path}
    if is_dataclass(value) and not isinstance(value, type):
        inside = {f.name: getattr(value, f.name) for f in fields(value)}
        return {"kind": type(value).__name__} | _tree(inside, path, tensors, pieces)
    if isinstance(value, dict):
        return {name: _tree(item, f"{path}.{name}".lstrip("."), tensors, pieces) for name, item in value.items()}
    if isinstance(value, tuple):
        return [_tree(item, f"{path}.{index}", tensors, pieces) for index, item in enumerate(value)]
    return value


def _stored(array: np.ndarray, code: _Code | None) -> tuple[dict[str, Any], bytes]:
    if code is not None:
        integers, middle, step = _quantise(array, code)
        return {
            "bits": code.bits, "axis": code.axis, "middle": middle.tolist(), "step": step.tolist(),
        }, _planes(integers)  # fmt: skip
    if array.dtype == np.int32:
        differences = np.diff(array.reshape(-1), prepend=np.int32(0))
        if not array.size or np.abs(differences).max() < 2**15:
            return {"bits": 16, "integers": True}, _planes(differences.astype(np.int16))
        return {"bits": 32, "integers": True}, array.astype("<i4").tobytes()
    return {"bits": 32}, array.astype("<f4").tobytes()


def _planes(integers: np.ndarray) -> bytes:
    """All low bytes, then all high bytes: that compresses better."""
    flat = np.ascontiguousarray(integers).reshape(-1)
    if flat.dtype == np.int8:
        return flat.tobytes()
    return (flat & 255).astype(np.uint8).tobytes() + (flat >> 8).astype(np.int8).tobytes()


def _coded(value: Any, path: str) -> Any:
    """`value` with each array as its integers give it back."""
    if isinstance(value, np.ndarray):
        code = _CODES.get(path)
        if code is None:
            return value
        integers, middle, step = _quantise(value, code)
        rows = (middle[:, None] + integers * step[:, None]).astype(np.float32)
        return np.ascontiguousarray(rows if code.axis == "first" else rows.T).reshape(value.shape)
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{f.name: _coded(getattr(value, f.name), f"{path}.{f.name}") for f in fields(value)})
    return value


def with_rows(baked: Baked, rows: Int[np.ndarray, " k"]) -> Baked:
    """A baked avatar with the Gaussians of these indices alone, in the order of the indices."""
    attributes = _rows(baked.attributes, rows, *(field.name for field in fields(baked.attributes)))
    match baked:
        case MeshBound():
            changes = _rows(baked.changes, rows, "color", "opacity_logits", "means")
            if changes is not None:
                changes = replace(changes, features=_rows(changes.features, rows, "neutral", "basis", "own"))
            face_index, means = baked.face_index[rows], baked.means[rows]
            return replace(baked, face_index=face_index, means=means, attributes=attributes, changes=changes)
        case Static():
            bases, network = _bases(baked, rows), _network(baked, rows)
            return replace(baked, means=baked.means[rows], attributes=attributes, bases=bases, network=network)
        case BlendSkinned():
            own = ("expression_basis", "pose_basis")
            rig = _rows(baked.rig, rows, "template", "skinning_weights", second=own)
            still = None if baked.still_weights is None else baked.still_weights[rows]
            bases, network = _bases(baked, rows), _network(baked, rows)
            return replace(baked, rig=rig, attributes=attributes, bases=bases, network=network, still_weights=still)


def _bases(baked: BlendSkinned | Static, rows: Int[np.ndarray, " k"]) -> Any:
    return _rows(baked.bases, rows, second=("means", "log_scales", "opacity_logits", "sh"))


def _network(baked: BlendSkinned | Static, rows: Int[np.ndarray, " k"]) -> Any:
    network = _rows(baked.network, rows, "base")
    return network if network is None else replace(network, along=_rows(network.along, rows, "basis"))


def _rows(record: Any, rows: Int[np.ndarray, " k"], *first: str, second: tuple[str, ...] = ()) -> Any:
    """A record, or None, with some rows of its arrays along their first or second axis. None stays None."""
    if record is None:
        return None
    axes = dict.fromkeys(first, 0) | dict.fromkeys(second, 1)
    found = {name: getattr(record, name) for name in axes}
    kept = {name: np.take(array, rows, axes[name]) for name, array in found.items() if array is not None}
    return replace(record, **kept)
