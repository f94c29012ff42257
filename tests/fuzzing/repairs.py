"""Correct checksums and hashes after a fault, as an attacker would.

This module uses none of mien's functions, since a change of theirs would silently change what is fuzzed. A test repairs
one harmless edit of each format and reads it. Files that are too faulty to be repaired stay as they are."""

import contextlib
import hashlib
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import safetensors.numpy

_GEOMETRY = (
    "template", "faces", "identity_basis", "expression_basis", "joint_template", "joint_identity_basis",
    "joint_rotation_basis", "joint_translation_basis", "skinning_weights", "pose_basis",
)  # fmt: skip
_FACE = ("identity", "expression", "joints", "head_rotation", "head_translation", "vertex_offsets")


def split(data: bytes) -> tuple[dict[str, Any], bytes]:
    size = int.from_bytes(data[:8], "little")
    return json.loads(data[8 : 8 + size]), data[8 + size :]


def joined(header: Any, body: bytes) -> bytes:
    """Return a safetensors file with this header, as a value or as text."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + body


def _canonical(content: Any) -> bytes:
    return json.dumps(content, sort_keys=True, separators=(",", ":")).encode()


def with_checksum(content: Any) -> Any:
    """Return a json value with a correct checksum, if it can have one."""
    if isinstance(content, dict):
        content = {name: value for name, value in content.items() if name != "checksum"}
        with contextlib.suppress(Exception):
            return {**content, "checksum": hashlib.sha256(_canonical(content)).hexdigest()[:32]}
    return content


def repair_tensors(data: bytes) -> bytes:
    """Return a safetensors file with a correct checksum of header and body, if it has one."""
    with contextlib.suppress(Exception):
        header, body = split(data)
        metadata = header.pop("__metadata__")
        if "checksum" in metadata:
            metadata["checksum"] = hashlib.sha256(_canonical(header) + body).hexdigest()
            return joined({"__metadata__": metadata, **header}, body)
    return data


def repair_portable(data: bytes, content: Any = None) -> bytes:
    """Return a .mien file with a correct hash over content and arrays, and with other content if some is given."""
    with contextlib.suppress(Exception):
        header, body = split(data)
        entry = json.loads(header["__metadata__"]["mien"])
        entry["content"] = entry["content"] if content is None else content
        entry["sha256"] = _portable_digest(entry["content"], safetensors.numpy.load(data))
        header["__metadata__"]["mien"] = json.dumps(entry, sort_keys=True)
        return repair_tensors(joined(header, body))
    return repair_tensors(data)


def repair_glb(data: bytes) -> bytes:
    """Return a .glb file with a correct hash over the avatar's content and arrays, if it has one."""
    with contextlib.suppress(Exception):
        length = int.from_bytes(data[12:16], "little")
        content, buffer = json.loads(data[20 : 20 + length]), data[28 + length :]
        extension = content["extensions"]["MIEN_gaussian_avatar"]
        arrays = {}
        for name, described in extension["tensors"].items():
            view = content["bufferViews"][described["bufferView"]] if "bufferView" in described else {"byteLength": 0}
            start = view.get("byteOffset", 0)
            numbers = np.frombuffer(buffer[start : start + view["byteLength"]], described["dtype"])
            arrays[name] = numbers.reshape(described["shape"])
        found = _portable_digest(extension["avatar"]["content"], arrays)
        return data.replace(extension["avatar"]["sha256"].encode(), found.encode(), 1)
    return data


def _portable_digest(content: Any, arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode())
    for name, array in sorted(arrays.items()):
        digest.update(name.encode() + str(array.dtype).encode() + struct.pack(f"<{array.ndim}q", *array.shape))
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def edit_json(path: Path, **values: Any) -> None:
    """Change entries of a json file, and correct its checksum."""
    path.write_text(json.dumps(with_checksum({**json.loads(path.read_text()), **values})))


def repair_around(file: Path) -> None:
    """Correct what the files beside `file` say about it. Files that are too faulty stay as they are."""
    for repair in _AROUND.get(file.name, ()):
        with contextlib.suppress(Exception):
            repair(file.parent)


def _digest_beside(name: str) -> Callable[[Path], None]:
    """Return what writes the digest of the tensors into the json file of the same name."""
    return lambda folder: edit_json(
        folder / f"{name}.json",
        tensors_sha256=hashlib.sha256((folder / f"{name}.safetensors").read_bytes()).hexdigest(),
    )


def _run_of_tracking(folder: Path) -> None:
    """Return the digest of a tracking that its runs store."""
    arrays = safetensors.numpy.load_file(folder / "tracking.safetensors")
    digest = hashlib.sha256()
    for name in sorted(set(_FACE) & arrays.keys()):
        digest.update(name.encode() + arrays[name].tobytes())
    for K, viewmat in zip(arrays["camera_K"], arrays["camera_viewmats"], strict=True):
        digest.update(K.tobytes() + viewmat.tobytes())
    for config in folder.parent.parent.parent.glob("runs/*/config.json"):
        data = json.loads(config.read_text())["data"]
        data[0]["tracking"] = digest.hexdigest()[:16]
        edit_json(config, data=data)


def _face_model(folder: Path) -> None:
    content = json.loads((folder / "face_model.json").read_text())
    arrays = safetensors.numpy.load_file(folder / "face_model.safetensors")
    digest = hashlib.sha256()
    for name in _GEOMETRY:
        if name in arrays:
            array = arrays[name] if arrays[name].dtype.kind == "f" else arrays[name].astype(np.int64)
            digest.update(name.encode() + str(tuple(array.shape)).encode() + np.ascontiguousarray(array).tobytes())
    digest.update("|".join((*content["expression_names"], *content["joint_names"])).encode())
    found = digest.hexdigest()[:16]
    edit_json(folder / "face_model.json", content_hash=found)
    if (folder / "avatar.json").is_file():
        edit_json(folder / "avatar.json", face_model_hash=found)


def _capture(folder: Path) -> None:
    content = json.loads((folder / "capture.json").read_text())
    arrays = safetensors.numpy.load_file(folder / "landmarks.safetensors")
    picked = (tuple(content["camera_ids"]), float(content["fps"]), content["height"], content["width"])
    digest = hashlib.sha256(repr(picked).encode())
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.shape};".encode() + np.ascontiguousarray(array).tobytes())
    for file in (folder / "capture.json", folder / "cache" / "stamp.json"):
        if file.is_file():
            edit_json(file, capture_hash=digest.hexdigest())


def _scoring(folder: Path) -> None:
    content = json.loads((folder / "scoring.json").read_text())
    digest = hashlib.sha256()
    for timestep, camera in np.ndindex(content["timesteps"], content["cameras"]):
        mask = cv2.imread(str(folder / f"masks/{camera:02d}/{timestep:06d}.png"), cv2.IMREAD_GRAYSCALE)
        digest.update(mask.tobytes())  # type: ignore[union-attr]
    crops = safetensors.numpy.load_file(folder / "crops.safetensors")["crops"]
    digest.update(crops.astype(np.int32).tobytes())
    edit_json(folder / "scoring.json", sha256=digest.hexdigest())


_AROUND: dict[str, tuple[Callable[[Path], None], ...]] = {
    "tracking.safetensors": (_digest_beside("tracking"), _run_of_tracking),
    "avatar.safetensors": (_digest_beside("avatar"),),
    "face_model.safetensors": (_face_model,), "face_model.json": (_face_model,),
    "capture.json": (_capture,), "landmarks.safetensors": (_capture,), "crops.safetensors": (_scoring,),
}  # fmt: skip
