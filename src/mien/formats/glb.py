"""One .glb file with an avatar: a textured mesh that engines animate, and the Gaussians of the person at rest.

The mesh has a morph target for each expression and a skin with the face model's joints. docs/glb.md says what is in the
file, and what is left out.
"""

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int

from mien import runtime
from mien.disk.files import check_writable
from mien.driving.motion import ARKIT_NAMES
from mien.errors import UserError
from mien.formats.format import Content, NoOptions
from mien.formats.shared.glb_file import INDICES, VERTICES, Glb, GlbWriter, read_glb
from mien.formats.shared.splats import unit_quats
from mien.machine import exact
from mien.runtime.baked import MeshBound, PortableAvatar, Rig
from mien.runtime.file import content_digest, from_arrays, to_arrays
from mien.runtime.named import GAZE_NAMES, is_gaze, turned_eyes
from mien.runtime.posing import SH_C0, Face, Gaussians, rig_points
from mien.runtime.rotation import matrix_from_axis_angle

EXTENSION, VERSION = "MIEN_gaussian_avatar", 1
_NAMES = (EXTENSION, "EXT_gaussian_avatar")
TEXTURE_SIZE = 1024
"""Side of the texture in texels."""
_SPLATS = "KHR_gaussian_splatting"
_ANIMATES = (
    "Morph targets and skin move the mesh. The Gaussians show the person at rest and do not move in programs that do "
    f"not know {EXTENSION}, which has what moves them."
)
_KINDS = {"float32": np.dtype("<f4"), "int32": np.dtype("<i4")}
_JOINTS = 4
"""Number of joints of a vertex, which is what every engine supports."""
_JAW, _LOOK, _HIDDEN = 0.7, 0.4, 0.01
"""Pose that shows what is hidden at rest: jawOpen, and eyes to each side in radians; and the weight of its pictures."""
_MOVED = 1e-6
"""Distance in metres below which a morph target does not move a vertex."""
_REMEDY = "write it again with `mien export DIR --out me.glb`"


@dataclass(frozen=True)
class GlbOptions(NoOptions):
    """Options of .glb files."""

    mesh_only: bool = False
    """Write only the mesh that engines animate, 1 to 2 MB: without Gaussians, and without what mien reads back."""


@dataclass(frozen=True, eq=False)
class MeshModel:
    """The mesh of an avatar, with texture coordinates."""

    rig: Rig
    faces: Int[np.ndarray, "f 3"]
    uv: Float32[np.ndarray, "u 2"]
    """Texture coordinates, 0..1, v upwards."""
    uv_faces: Int[np.ndarray, "f 3"]
    """Indices into `uv`."""


def write_glb(
    path: Path, avatar: PortableAvatar, model: MeshModel, texture_size: int = TEXTURE_SIZE, *, mesh_only: bool = False
) -> tuple[str, ...]:
    """Write an avatar as one .glb file, in the head frame, in metres, and return the names of the morph targets.

    The same input gives the same bytes.
    """
    head = head_of(path, avatar, model, texture_size)
    writer, content = head.writer, head.content
    about = {**vars(avatar.about), "format": "mien.glb", "version": 1}
    scenes: list[dict[str, Any]] = [{"name": "mesh", "nodes": [0, 1]}]
    used = ["KHR_materials_unlit"]
    if not mesh_only:
        _add_splats(writer, content, avatar, head.gaussians)
        about["animates"] = _ANIMATES
        scenes.append({"name": "gaussians", "nodes": [len(content["nodes"]) - 1]})
        used += [_SPLATS, EXTENSION]
    content["asset"] = {"version": "2.0", "generator": f"mien {avatar.about.mien}", "extras": {"mien": about}}
    content |= {"scene": 0, "scenes": scenes, "extensionsUsed": used}
    if not mesh_only:
        content["extensions"] = {EXTENSION: _avatar_extension(path, writer, avatar)}
    writer.write(path, content)
    return head.targets


@dataclass(frozen=True, eq=False)
class Head:
    """The head of a person as the part of a .glb file that engines animate."""

    writer: GlbWriter
    content: dict[str, Any]
    """The json so far: node 0 is the mesh; from node 1 on come the joints of its skin, the root first."""
    targets: tuple[str, ...]
    """Names of the morph targets."""
    gaussians: Gaussians
    """The Gaussians of the person at rest, in the head frame."""


def head_of(path: Path, avatar: PortableAvatar, model: MeshModel, texture_size: int) -> Head:
    """The mesh of the person at rest with morph targets, skin and texture, in the head frame, in metres."""
    check_writable(path)
    zero = np.zeros(3, np.float32)
    face = Face(avatar.neutral.expression, avatar.neutral.joints, zero, zero)
    vertices = rig_points(model.rig, face)
    gaussians = runtime.pose(avatar.baked, face)
    for name, array in (("mesh", vertices), ("Gaussians", gaussians.means), ("Gaussians", gaussians.scales)):
        if not np.isfinite(array).all():
            raise UserError(f"{path}: the avatar's {name} hold NaN or infinity; train it again")
    targets = morph_targets(avatar, model.rig, face)
    writer = GlbWriter()
    content = _mesh_content(writer, model, vertices, targets)
    skin = _skin(writer, model.rig, face, first_node=1)
    content["nodes"] = [{"name": avatar.about.name, "mesh": 0, "skin": 0}, *skin.pop("nodes")]
    content["skins"] = [skin]
    _add_texture(writer, content, _texture(avatar, model, face, texture_size))
    return Head(writer, content, tuple(targets), gaussians)


def morph_targets(avatar: PortableAvatar, rig: Rig, face: Face) -> dict[str, Float32[np.ndarray, "m 3"]]:
    """What each expression that has an effect adds to the points at rest, in metres, per unit of its coefficient.

    A jaw that follows an expression and lids that follow the eyes are in it. Of ARKit's names, eyeLook turns the eyes.
    """
    rest, found = rig_points(rig, face), {}
    for index, name in enumerate(avatar.expression_names):
        expression = face.expression.copy()
        expression[index] += 1
        moved = rig_points(rig, replace(face, expression=expression)) - rest
        if avatar.expression_bounds[index, 0] < avatar.expression_bounds[index, 1]:
            found[name] = moved
    if any(name in ARKIT_NAMES for name in avatar.expression_names):
        for name in GAZE_NAMES:
            if name not in found and is_gaze(name, avatar.joint_names):
                joints = turned_eyes(face.joints, avatar.joint_names, {name: 1.0})
                found[name] = rig_points(rig, replace(face, joints=joints)) - rest
    known = [name for name in ARKIT_NAMES if name in found]
    ordered = [*known, *(name for name in found if name not in known)]
    return {name: np.where(np.abs(found[name]) > _MOVED, found[name], np.float32(0)) for name in ordered}


def joint_positions(rig: Rig, face: Face) -> Float[np.ndarray, "k 3"]:
    """Positions of the joints of a posed rig in the head frame, in metres."""
    expression = face.expression.astype(np.float64)
    derived = np.einsum("e,eki->ki", expression, rig.joint_rotation_basis.astype(np.float64))
    shift = np.einsum("e,eki->ki", expression, rig.joint_translation_basis.astype(np.float64))
    free = iter(face.joints)
    turns = [next(free) if is_free else derived[k] for k, is_free in enumerate(rig.joint_free)]
    rotations, positions = np.zeros((len(turns), 3, 3)), rig.joint_template.astype(np.float64)
    for k, parent in enumerate(rig.joint_parents):
        local = matrix_from_axis_angle(np.asarray(turns[k])[None])[0]
        if parent < 0:
            rotations[k] = local
            continue
        offset = rig.joint_template[k].astype(np.float64) - rig.joint_template[parent] + shift[k]
        positions[k] = positions[parent] + rotations[parent] @ offset
        rotations[k] = rotations[parent] @ local
    return positions


def _texture(avatar: PortableAvatar, model: MeshModel, face: Face, size: int) -> Float32[np.ndarray, "s s 3"]:
    """The texture, seen at rest, and with an open mouth and eyes to each side."""
    import torch

    from mien.formats.shared.texture import FRONT_VIEWS, Shot, Surface, bake_texture

    faces, uv_faces = (torch.from_numpy(np.asarray(each, np.int64)) for each in (model.faces, model.uv_faces))

    def shot(posed: Face, **how: Any) -> Shot:
        return Shot(torch.from_numpy(rig_points(model.rig, posed)), runtime.pose(avatar.baked, posed), **how)

    shots, names = [shot(face)], avatar.expression_names
    if "jawOpen" in names:
        for side in (-_LOOK, _LOOK):
            expression, joints = face.expression.copy(), face.joints.copy()
            expression[names.index("jawOpen")] += _JAW
            for eye in ("left_eye", "right_eye"):
                if eye in avatar.joint_names:
                    joints[avatar.joint_names.index(eye), 1] += side
            posed = replace(face, expression=expression, joints=joints)
            shots.append(shot(posed, views=FRONT_VIEWS, weight=_HIDDEN))
    return bake_texture(Surface(faces, torch.from_numpy(model.uv), uv_faces), shots, size)


def _mesh_content(
    writer: GlbWriter, model: MeshModel, vertices: Float32[np.ndarray, "m 3"], targets: dict[str, np.ndarray]
) -> dict[str, Any]:
    """Meshes and their arrays. Vertices that have several texture coordinates become several vertices."""
    pairs = np.stack([model.faces.reshape(-1), model.uv_faces.reshape(-1)], axis=1)
    corners, index = np.unique(pairs, axis=0, return_inverse=True)
    points, coordinates = corners[:, 0], corners[:, 1]
    uv = model.uv[coordinates] * np.array([1, -1], np.float32) + np.array([0, 1], np.float32)
    normals = exact.vertex_normals(vertices, model.faces)
    normals[(normals == 0).all(1)] = (0, 0, 1)  # a vertex whose triangles have no area
    joints, weights = _skinning(model.rig.skinning_weights)
    attributes = {
        "POSITION": writer.accessor(vertices[points], VERTICES, bounds=True),
        "NORMAL": writer.accessor(normals[points], VERTICES),
        "TEXCOORD_0": writer.accessor(uv.astype(np.float32), VERTICES),
        "JOINTS_0": writer.accessor(joints[points], VERTICES),
        "WEIGHTS_0": writer.accessor(weights[points], VERTICES),
    }
    primitive = {
        "attributes": attributes, "indices": writer.accessor(index.reshape(-1).astype("<u4"), INDICES), "material": 0,
        "targets": [{"POSITION": writer.sparse(moved[points])} for moved in targets.values()],
    }  # fmt: skip
    mesh = {"name": "head", "primitives": [primitive], "extras": {"targetNames": list(targets)}}
    if targets:
        mesh["weights"] = [0.0] * len(targets)
    else:
        del primitive["targets"]
    return {"meshes": [mesh]}


def _skinning(weights: Float32[np.ndarray, "m k"]) -> tuple[np.ndarray, Float32[np.ndarray, "m 4"]]:
    """The joints of each vertex with the largest weights, as bytes, and these weights, which sum to 1."""
    count = min(_JOINTS, weights.shape[1])
    joints = np.zeros((len(weights), _JOINTS), np.uint8)
    chosen = np.zeros((len(weights), _JOINTS), np.float32)
    order = np.argsort(-weights, axis=1, kind="stable")[:, :count]
    chosen[:, :count] = np.maximum(np.take_along_axis(weights, order, 1), 0)
    chosen /= np.maximum(chosen.sum(1, keepdims=True), 1e-12)
    joints[:, :count] = np.where(chosen[:, :count] > 0, order, 0)  # a joint without weight has to be 0
    return joints, chosen


def _skin(writer: GlbWriter, rig: Rig, face: Face, first_node: int) -> dict[str, Any]:
    """The skin, and its joints as `nodes`: without rotations, so that their axes are those of the head."""
    positions = joint_positions(rig, face)
    nodes: list[dict[str, Any]] = []
    for k, (name, parent) in enumerate(zip(rig.joint_names, rig.joint_parents, strict=True)):
        origin = positions[parent] if parent >= 0 else np.zeros(3)
        nodes.append({"name": name, "translation": (positions[k] - origin).tolist()})
        if parent >= 0:
            nodes[parent].setdefault("children", []).append(first_node + k)
    inverse = np.tile(np.eye(4, dtype=np.float32), (len(positions), 1, 1))
    inverse[:, 3, :3] = -positions  # column by column
    return {
        "inverseBindMatrices": writer.accessor(inverse.reshape(-1, 16)),
        "joints": list(range(first_node, first_node + len(nodes))), "skeleton": first_node, "nodes": nodes,
    }  # fmt: skip


def _add_texture(writer: GlbWriter, content: dict[str, Any], texture: Float32[np.ndarray, "s s 3"]) -> None:
    content["images"] = [writer.jpeg(texture, 92)]
    content["samplers"] = [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}]
    content["textures"] = [{"source": 0, "sampler": 0}]
    surface = {"baseColorTexture": {"index": 0}, "metallicFactor": 0.0, "roughnessFactor": 1.0}
    # The light is in the texture already. Mouths and eye sockets are seen from inside.
    content["materials"] = [
        {
            "name": "skin",
            "pbrMetallicRoughness": surface,
            "doubleSided": True,
            "extensions": {"KHR_materials_unlit": {}},
        }
    ]


def _add_splats(writer: GlbWriter, content: dict[str, Any], avatar: PortableAvatar, gaussians: Gaussians) -> None:
    """Add the Gaussians at rest as a second mesh, with a node of its own as the last one."""
    colors = np.clip(0.5 + SH_C0 * gaussians.sh[:, 0], 0, 1)
    linear = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)  # from sRGB
    shown = np.concatenate([linear, gaussians.opacities[:, None]], axis=1)
    attributes = {
        "POSITION": writer.accessor(gaussians.means, VERTICES, bounds=True),
        "COLOR_0": writer.accessor((shown * 255 + 0.5).astype(np.uint8), VERTICES, normalized=True),
        f"{_SPLATS}:ROTATION": writer.accessor(unit_quats(gaussians.quats)[:, [1, 2, 3, 0]], VERTICES),
        f"{_SPLATS}:SCALE": writer.accessor(gaussians.scales, VERTICES),
        f"{_SPLATS}:OPACITY": writer.accessor(gaussians.opacities, VERTICES),
    }
    for degree in range(round(gaussians.sh.shape[1] ** 0.5)):
        for k in range(2 * degree + 1):
            coefficients = gaussians.sh[:, degree * degree + k].astype(np.float32)
            attributes[f"{_SPLATS}:SH_DEGREE_{degree}_COEF_{k}"] = writer.accessor(coefficients, VERTICES)
    if isinstance(avatar.baked, MeshBound):
        attributes["_TRIANGLE"] = writer.accessor(avatar.baked.face_index.astype(np.float32), VERTICES)
    extension = {_SPLATS: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}}
    primitive = {"mode": 0, "attributes": attributes, "extensions": extension}
    content["meshes"].append({"name": "gaussians", "primitives": [primitive], "extras": {"animates": _ANIMATES}})
    content["nodes"].append({"name": "gaussians", "mesh": 1})


def _avatar_extension(path: Path, writer: GlbWriter, avatar: PortableAvatar) -> dict[str, Any]:
    """Add the arrays of an avatar to a file, and return the extension that refers to them."""
    header, arrays = to_arrays(path, avatar)
    tensors = {}
    for name, array in sorted(arrays.items()):
        kind = _KINDS[array.dtype.name]
        tensors[name] = {"dtype": array.dtype.name, "shape": list(array.shape)}
        if array.size:  # a buffer view has at least one byte
            tensors[name]["bufferView"] = writer.view(np.ascontiguousarray(array, kind).tobytes())
    return {"version": VERSION, "avatar": header, "tensors": tensors}


def read_glb_avatar(path: Path) -> PortableAvatar:
    """Read the avatar in a .glb file: equal to that of the .mien file, array by array."""
    header, arrays, faults = _read_arrays(path)
    if faults:
        raise UserError(f"{path}: is damaged ({faults[0]}); {_REMEDY}")
    return from_arrays(path, header, arrays)


def glb_faults(path: Path) -> list[str]:
    """The mistakes of the avatar in a .glb file, as docs/spec describes it: of its arrays, then of what they mean.

    Where arrays are wrong, their meaning is not looked at. Of the meaning, the first mistake is told.
    """
    header, arrays, faults = _read_arrays(path)
    if faults:
        return faults
    for read in (header, header | {"sha256": content_digest(header.get("content"), arrays)}):
        try:
            from_arrays(path, read, arrays)
        except UserError as error:
            faults.append(str(error).removeprefix(f"{path}: "))
    return list(dict.fromkeys(faults))


def _read_arrays(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray], list[str]]:
    """The header and the arrays of the avatar in a .glb file, and their mistakes."""
    glb = read_glb(path)
    extensions = glb.content.get("extensions")
    named = [extensions[name] for name in _NAMES if name in extensions] if isinstance(extensions, dict) else []
    if not named or not isinstance(named[0], dict):
        raise UserError(f"{path}: has no avatar of mien ({EXTENSION}); {_REMEDY}")
    found, arrays, faults = named[0], {}, []
    tensors, header = found.get("tensors"), found.get("avatar")
    if found.get("version") != VERSION:
        faults.append(f"version is {found.get('version')!r:.80}; {VERSION} is expected")
    if not isinstance(tensors, dict) or not isinstance(header, dict) or "format" not in header:
        return {}, {}, [*faults, "tensors, avatar or its format is missing, or is no object"]
    taken = set()  # several arrays must not share a view, as a small file would otherwise fill the memory
    for name, described in tensors.items():
        try:
            view = described.get("bufferView")
            if view is not None and view in taken:
                raise ValueError(f"bufferView {view} belongs to another array")
            taken.add(view)
            arrays[name] = _tensor(glb, described)
        except (ValueError, KeyError, TypeError, AttributeError, IndexError, OverflowError) as error:
            faults.append(f"tensors.{name:.200}: {' '.join(str(error).split()):.200}")
    uses = Counter(_named(header.get("content")))
    faults += [f"avatar names the array {name:.200}, which tensors lacks" for name in uses if name not in tensors]
    faults += [f"tensors.{name:.200}: avatar names it {uses[name]} times" for name in tensors if uses[name] != 1]
    return header, arrays, faults


def _named(node: Any) -> Iterator[str]:
    """The names of arrays in a tree of json."""
    if isinstance(node, dict) and isinstance(node.get("tensor"), str):
        yield node["tensor"]
    elif isinstance(node, dict | list):
        for part in node.values() if isinstance(node, dict) else node:
            yield from _named(part)


def _tensor(glb: Glb, described: dict[str, Any]) -> np.ndarray:
    shape, kind = described.get("shape"), described.get("dtype")
    if not isinstance(kind, str) or kind not in _KINDS:
        raise ValueError(f"dtype is {kind!r:.80}; float32 or int32 is expected")
    if not isinstance(shape, list) or not all(type(size) is int and size >= 0 for size in shape):
        raise ValueError(f"shape is {shape!r:.80}; a list of integers from 0 is expected")
    data = glb.bytes_of(described["bufferView"]) if "bufferView" in described else b""
    if len(data) != 4 * math.prod(shape):
        raise ValueError(f"its shape {shape} needs {4 * math.prod(shape)} bytes, and its bufferView has {len(data)}")
    return np.frombuffer(data, _KINDS[kind]).reshape(shape).copy()


def write(path: Path, content: Content, options: GlbOptions) -> str:
    """Write the file, and return what is told of it."""
    mesh = content.mesh()
    targets = write_glb(path, content.portable(), mesh, mesh_only=options.mesh_only)
    splats = "" if options.mesh_only else f"{content.count:,} Gaussians at rest, "
    joints = len(mesh.rig.joint_names)
    return f"a mesh with {len(targets)} morph targets and {joints} joints, {splats}{path.stat().st_size / 1e6:.1f} MB"
