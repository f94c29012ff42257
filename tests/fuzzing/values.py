"""Single values that a reader must refuse, whatever the checksums say, by target: in json, and in arrays.

A row is the place of a value and the value; `GONE` takes it away. Files are edited with correct checksums around them.
In arrays, a value may be a function that returns another array."""

import itertools
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy

from damage import nested
from fuzzing.repairs import joined, repair_portable, repair_tensors, split, with_checksum

HUGE = 10**400
WRONG = (np.nan, np.inf, 3e38)
NOT_ONE_LINE = "a\nb"
GONE = object()


@dataclass(frozen=True)
class Of:
    """A value that is elsewhere in the same file."""

    part: str
    name: str
    alone: str = ""
    """Name under which it is the only entry."""


Row = tuple[str, Any]
Change = Callable[[np.ndarray], np.ndarray]


# Changes of an array. `new` puts zeros of a shape in the place of one, which need not exist.


def fill(value: float) -> Change:
    return lambda array: np.full_like(array, value)


def last(value: float) -> Change:
    return lambda array: np.concatenate([array.ravel()[:-1], [value]]).astype(array.dtype).reshape(array.shape)


def plus(value: float) -> Change:
    return lambda array: array + np.array(value).astype(array.dtype)


def times(value: float) -> Change:
    return lambda array: array * np.array(value).astype(array.dtype)


def typed(kind: Any) -> Change:
    return lambda array: array.astype(kind)


def first(count: int) -> Change:
    return lambda array: array[:count]


def new(*shape: int, kind: Any = np.float32) -> Change:
    return lambda array: np.zeros(shape, kind)


def rigid(**entries: float) -> list[list[float]]:
    """Return the matrix of a view with some entries changed: `a03` is that of the first row and the last column."""
    matrix = np.array([[0.8, -0.6, 0, 0.1], [0.6, 0.8, 0, 0.2], [0, 0, 1, 0.7], [0, 0, 0, 1]])
    for name, value in entries.items():
        matrix[int(name[1]), int(name[2])] = value
    return matrix.tolist()


MATRICES = (
    np.diag([2.0, 2, 2, 1]).tolist(), np.array(rigid()).T.tolist(), rigid(a01=0.3), rigid(a32=0.5), rigid(a22=-1),
    rigid()[:3], rigid(a03=np.nan),
)  # fmt: skip
"""Matrices that are no view: scaled, transposed, sheared, tilted, mirrored, too short, NaN."""
_TAIL = "protocols.self_reenactment_tail"
_STORE = "avatar.store"
VALUES: dict[str, tuple[Row, ...]] = {
    "capture.json": (
        ("timesteps", 10**9), ("timesteps", HUGE), ("timesteps", "5"), ("width", 10**9), ("width", HUGE),
        ("width+height", 30_000), ("fps", HUGE), ("fps", 1e-300), ("camera_ids", ["front", "front"]),
        ("camera_ids", ["../../../home"]), ("camera_ids", ["/etc"]), ("camera_ids", [NOT_ONE_LINE]),
        ("camera_ids", [3]), ("camera_ids", [None]), ("name", NOT_ONE_LINE), ("source", []),
        ("source", {"a": nested(900)}),
    ),
    "landmarks.safetensors": (
        ("landmarks", last(np.nan)), ("landmarks", last(np.inf)), ("landmarks", last(3e38)),
        ("timestamps", last(np.nan)), ("timestamps", last(1e300)), ("principal_point", last(np.inf)),
        ("+dtype landmarks", "F8_E5M2"),
    ),
    "tracking.safetensors": (
        ("camera_K", fill(3e38)), ("camera_K", times(-1)), ("camera_viewmats", times(2)),
        ("head_translation", fill(3e38)), ("expression", typed(np.float16)), ("neck_lines", typed(np.int64)),
        ("+dtype joints", "F8_E4M3"),
    ),
    "tracking.json": (
        ("cameras.0.width", 10**9), ("cameras.0.width", HUGE), ("cameras", {}), ("face_model", ["anny"]),
        ("settings", [1]), ("+settings.tracked_together", 3), ("looks", []),
    ),
    "scoring.json": (
        ("timesteps", 10**9), ("timesteps", HUGE), ("cameras", "1"), ("width", HUGE), ("height", 10**6),
        ("width", None),
    ),
    "crops.safetensors": tuple(
        ("crops", lambda array, crop=crop: np.tile(np.array(crop, np.int32), (5, 1, 1)))
        for crop in ([-1, 0, 8, 8], [0, 0, 33, 8], [2**31 - 1, 0, 2**31 - 1, 1], [0, 0, 0, 0], [4, 4, 0, 20])
    ),
    "config.json": (
        ("data.0.camera.K", "wide"),
        ("data", []), ("settings", [{"split": 1}]), ("data", GONE),
        *(("data.0.sequence", name) for name in ("../../../home", "/etc", NOT_ONE_LINE, 3, None)),
    ),
    "training.json": (("steps", "many"), ("seconds", HUGE)),
    "curves.safetensors": (
        ("loss", new(2, 2)), ("loss", GONE), ("psnr", GONE),
    ),
    "faces of a run": (("expression", fill(np.nan)), ("expression", new(5, 9))),
    "metrics.json": (
        ("protocols", []), (_TAIL, 3), (f"+protocols.{NOT_ONE_LINE}", Of("protocols", "self_reenactment_tail")),
        ("protocols", Of("protocols", "self_reenactment_tail", "novel")), ("training", GONE),
        ("training", {"gaussians": "many", "seconds": 1}),
        *((f"{_TAIL}.{place}", value) for place, value in (
            ("psnr", "high"), ("psnr", HUGE), ("ssim", [1]), ("head", None),
            ("split", {}), ("baselines", [1]),
            ("baselines.mesh", {"psnr": 1.0}), ("scored_on", ["clip"]), ("per_frame", GONE),
            ("per_frame.head_psnr", ["x"]), ("perceptual_backbone", [1]),
            ("seconds_per_frame", None),
        )),
    ),
    "checkpoints": (
        (f"{_STORE}.face_index", fill(10**6)), (f"{_STORE}.trained.means", fill(np.nan)),
        ("store.means:first", fill(np.inf)), ("store.means:first", new(3)), ("store.means:first", typed(np.int8)),
        ("+store.none:first+store.none:second", new(3)), ("step", fill(-1)), ("step", new(3)),
        ("gaussians", fill(10**12)), ("+density.seen", new(3)), ("density.pull", GONE), ("track.expression", new(9)),
        ("curves.loss", new()), ("curves.loss", GONE),
    ),
    "avatars": (
        (f"{_STORE}.face_index", fill(10**6)), (f"{_STORE}.face_index", fill(-1)),
        (f"{_STORE}.face_index", last(2**32)),
        (f"{_STORE}.face_index", last(-(2**63))), (f"{_STORE}.face_index", typed(np.float64)),
        (f"{_STORE}.trained.quats", lambda array: array[:, :3]), (f"{_STORE}.trained.quats", first(5)),
        (f"{_STORE}.trained.means", typed(np.float64)), (f"{_STORE}.trained.means", GONE), ("+avatar.more", new(3)),
        (f"{_STORE}.trained.log_scales", fill(1000)), ("subject.joints", GONE), ("+subject.more", new(3)),
        ("subject.expression", new(1, 9)), ("subject.head_rotation+subject.head_translation", first(0)),
        ("+subject.vertex_offsets", new(7, 3)), ("subject.identity", new(99)),
        ("*", last),
        ("config.sh_degree", 17), ("config.sh_degree", -1), ("config.sh_degree", "2"), ("config.sh_degree", HUGE),
        ("config.sh_frame", ["world"]), ("config.means_rate", {"kind": "Rate", "start": HUGE}), ("config.density", [1]),
        ("config.encoding_length", 0.0), *((f"config.{name}", 10**9) for name in (
            "hidden", "features", "encoding_bands", "attribute_width", "attribute_layers")),
        ("gaussians", 10**12), ("gaussians", HUGE),
        ("kind", "headgas or not"), ("kind", "headgas"), ("kind", "gaussian_avatars"), ("kind", "../../x"),
        ("kind", ["headgas"]), ("config", []), ("face_model", 3),
        ("version", 0), ("version", 2), ("tensors_sha256", GONE),
        ("config", GONE), ("config.photometric", GONE), ("+future", 1),
    ),
    "names in avatars": (("face_model", "../../../secret"), ("face_model+face_model_carried", "../x")),
    "face_model.safetensors": (
        ("faces", plus(10**6)), ("faces", plus(-1)), ("uv_faces", plus(10**6)), ("face_regions", plus(1)),
        ("template", fill(np.nan)), ("expression_basis", plus(3e38)), ("skinning_weights", first(5)),
        ("expression_bounds", first(1)), ("+pose_basis", new(5, 9, 3)), ("template", typed(np.float64)),
    ),
    "face_model.json": (
        ("joint_parents", ["-1", "0", "0"]), ("joint_parents", [-1, 2, 1]), ("joint_parents", [-1, 0, 7]),
        ("joint_parents", [-1]), ("joint_free", ["no", "yes", "no"]), ("joint_free", [True] * 4),
        ("expression_names", ["drop"]), ("expression_names", [1, 2]), ("joint_names", ["head", NOT_ONE_LINE, "jaw"]),
        ("joint_names+joint_parents+joint_free", []),
    ),
    "miens": (
        *((place, {"tensor": "camera.K"}) for place in (
            "about.name", "baked.network.input", "baked.kind", "camera.width", "baked.scale_gain")),
        ("camera.K", {"tensor": [1]}), ("baked", [1]), ("camera.width", 10**9), ("camera.width", HUGE),
        ("baked.rig.joint_parents", ["-1", "0", "0"]), ("baked.rig.joint_parents", [-1, 2, 1]),
        ("baked.rig.joint_parents", [-1, 0, HUGE]), ("baked.rig.joint_parents", [-1]),
        ("baked.rig.joint_free", [True] * 3), ("baked.scale_gain", 1e300), ("baked.network.outputs", ["sh", "sh"]),
        ("baked.network.outputs", ["means"]), ("+baked.network.weights+biases", []), ("about.name", "a\x1b[2Jb"),
        ("about.name", nested(400)), ("about.name", "x" * 1001),
        ("baked.attributes.log_scales", {"tensor": "baked.means"}), ("@camera.K", fill(3e38)),
        ("@camera.viewmat", fill(0)), ("@baked.faces", fill(2**31 - 1)), ("@baked.face_index", fill(-1)),
        ("@baked.attributes.log_scales", fill(1000)), ("@baked.attributes.sh", lambda array: array[:, [0, 0]]),
        ("@baked.means", typed(np.float64)), ("@baked.means", first(3)), ("@*", last),
    ),
    "gains": (
        ("gains", fill(np.nan)), ("gains", fill(0)), ("gains", fill(1e3)), ("gains", first(3)), ("gains", GONE),
        ("gains", typed(bool)), ("+dtype gains", "F8_E4M3"),
    ),
    "crops.json": tuple(("crops.0\\.png", box) for box in (
        [0, 0, HUGE, 4], [-HUGE, 0, 4, 4], [True, 0, 4, 4], [0, 0, 4.0, 4], [0, 0, 4, 10**7])),
    "cameras.json": (
        ("cameras.0.K.0.0", HUGE), ("cameras.0.K.0.0", None), ("cameras.0.K.0.0", 3e38),
        ("cameras.0.viewmat", [[3e38] * 4] * 4), ("cameras.0.height", "many"), ("cameras", [0] * 50_001),
        *(("cameras.0.viewmat", matrix) for matrix in MATRICES),
    ),
    "added face models": (
        ("landmarks.mediapipe.faces.0", "x"), ("landmarks.mediapipe.faces.0", 99_999),
        ("landmarks.mediapipe.barycentric.0", [1, 0]), ("landmarks.mediapipe.barycentric.0.0", 1e300),
        ("landmarks.mediapipe", []), ("topology_hash", 3),
    ),
    "points": (
        ("landmarks", fill(np.inf)), ("landmarks", fill(3e38)), ("landmarks", typed(bool)),
    ),
}  # fmt: skip
SANE: dict[str, Row] = {
    "capture.json": ("fps", 24.5), "landmarks.safetensors": ("landmarks", plus(1e-4)), "config.json": ("mien", "0.0"),
    "tracking.json": ("settings", {"edited": 1}), "tracking.safetensors": ("expression", plus(1e-4)),
    "scoring.json": ("+edited", 1), "crops.safetensors": ("crops", plus(1)), "analysis.json": ("mien", "0.0"),
    "folder's face model": ("name", "edited"), "metrics.json": ("training.seconds", 1.5),
    "curves.safetensors": ("loss", plus(1e-4)), "face_track.safetensors": ("expression", plus(1e-4)),
    "avatar.safetensors": (f"{_STORE}.trained.opacity_logits", plus(1e-4)),
    "face_model.safetensors": ("expression_basis", plus(1e-4)),
    "head.mien": ("@baked.attributes.opacity_logits", plus(1e-4)), "gains": ("gains", times(1.01)),
}  # fmt: skip
"""Edits that readers must accept, since everything around them is corrected; otherwise checksums would hide faults."""


def concrete(row: Row, file: Path) -> list[Row]:
    """Return the rows of a row for a file: one for each array of floats if its place is `*`, with numbers in turn."""
    where, value = row
    if not where.endswith("*"):
        return [row]
    if file.suffix not in (".safetensors", ".mien"):
        return []
    arrays = sorted(safetensors.numpy.load_file(file).items())
    names = [name for name, array in arrays if array.dtype.kind == "f" and array.size]
    return [(where.replace("*", name), value(number)) for name, number in zip(names, itertools.cycle(WRONG))]


def edit(file: Path, where: str, value: Any) -> bytes | None:
    """Return a file with a value at a place, or None if it has no such place. Its own checksum is correct."""
    data, portable = file.read_bytes(), file.suffix == ".mien"
    of_arrays = callable(value) or where.startswith(("@", "+dtype"))
    try:
        if file.suffix == ".safetensors" or (portable and of_arrays):
            data = _edit_arrays(data, where.removeprefix("@"), value)
            return repair_portable(data) if portable else repair_tensors(data)
        if of_arrays or file.suffix not in (".json", ".mien"):
            return None
        content = json.loads(split(data)[0]["__metadata__"]["mien"])["content"] if portable else json.loads(data)
        _edit_value(content, where, value)
        if portable:
            return repair_portable(data, content)
        return json.dumps(with_checksum(content) if "checksum" in content else content).encode()
    except (KeyError, IndexError, TypeError):
        return None


def _edit_value(content: Any, where: str, value: Any) -> None:
    parts = where.removeprefix("+").replace("\\.", "\0").split(".")
    *way, names = [part.replace("\0", ".") for part in parts]
    inner: Any = content
    for name in way:
        inner = inner[int(name) if isinstance(inner, list) else name]
    for name in names.split("+"):
        key: Any = int(name) if isinstance(inner, list) else name
        if not where.startswith("+") and inner[key] == value:
            raise KeyError(key)  # it has to be there, with another value
        if value is GONE:
            del inner[key]
        elif isinstance(value, Of):
            other = content[value.part][value.name]
            inner[key] = {value.alone: other} if value.alone else other
        else:
            inner[key] = False if name == "face_model_carried" else value


def _edit_arrays(data: bytes, where: str, value: Any) -> bytes:
    header, body = split(data)
    kept = {"__metadata__": header["__metadata__"]} if "__metadata__" in header else {}
    if where.startswith("+dtype "):
        header[where.removeprefix("+dtype ")]["dtype"] = value
        return joined(header, body)
    if value is not GONE and not callable(value):
        raise KeyError(where)
    arrays = safetensors.numpy.load(data)
    for name in where.removeprefix("+").split("+"):
        if value is GONE:
            del arrays[name]
        else:
            old = arrays.get(name, np.zeros(0)) if where.startswith("+") else arrays[name]
            arrays[name] = np.ascontiguousarray(value(old))
    header, body = split(safetensors.numpy.save(arrays))
    return joined({**kept, **header}, body)
