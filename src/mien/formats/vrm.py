"""A .vrm file (VRM 1.0): the mesh of the .glb file, with the names and the bones that programs for avatars look for.

VRM is glTF with the extension VRMC_vrm: bones by role, expressions by name, what eyes do, and what is permitted. A head
has no body, so the bones that VRM demands below it are nodes that move nothing. docs/glb.md says what is in the file.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mien import runtime
from mien.formats.format import Content, NoOptions
from mien.formats.glb import TEXTURE_SIZE, Head, MeshModel, head_of
from mien.runtime.baked import PortableAvatar
from mien.runtime.named import GAZE_NAMES, LOOK_ANGLE, presets, visemes, within_lids

EXTENSION, SPEC_VERSION = "VRMC_vrm", "1.0"
LICENCE = "https://vrm.dev/licenses/1.0/"
PERMISSIONS = {
    "avatarPermission": "onlyAuthor", "commercialUsage": "personalNonProfit", "creditNotation": "required",
    "modification": "prohibited", "allowRedistribution": False, "allowExcessivelyViolentUsage": False,
    "allowExcessivelySexualUsage": False, "allowPoliticalOrReligiousUsage": False, "allowAntisocialOrHateUsage": False,
}  # fmt: skip
"""Permissions of the file: the least that VRM can say, because the head is that of a living person."""
BODY: dict[str, tuple[str | None, tuple[float, float, float]]] = {
    "hips": (None, (0, 0.92, 0)),
    "spine": ("hips", (0, 0.14, -0.01)),
    "leftUpperLeg": ("hips", (0.09, -0.05, 0)),
    "leftLowerLeg": ("leftUpperLeg", (0, -0.41, 0)),
    "leftFoot": ("leftLowerLeg", (0, -0.38, -0.02)),
    "leftUpperArm": ("spine", (0.17, 0.34, -0.02)),
    "leftLowerArm": ("leftUpperArm", (0.27, 0, 0)),
    "leftHand": ("leftLowerArm", (0.25, 0, 0)),
}
"""Bones that VRM demands beside the head: their parents, and their places from there in metres, in a T-pose. Those of
the right side mirror those of the left. A person of 1.7 m has about these lengths."""
_HEAD = ("spine", (0, 0.55, 0.01))
_EYES = {"leftEye": "left_eye", "rightEye": "right_eye"}
_EMOTIONS = {"happy": "smile", "angry": "anger", "sad": "sadness", "surprised": "surprise"}
"""VRM's emotions, and the presets of mien that they are."""
_RELAXED = {
    "mouthSmileLeft": 0.25, "mouthSmileRight": 0.25, "eyeBlinkLeft": 0.15, "eyeBlinkRight": 0.15, "browInnerUp": 0.1,
}  # fmt: skip
_MOUTHS = {"aa": "aa", "ih": "I", "ou": "U", "ee": "E", "oh": "O"}
"""VRM's five mouths, and the visemes that they are."""
_LOOKS = {
    "blink": ("eyeBlinkLeft", "eyeBlinkRight"),
    "blinkLeft": ("eyeBlinkLeft",),
    "blinkRight": ("eyeBlinkRight",),
    "lookUp": ("eyeLookUpLeft", "eyeLookUpRight"),
    "lookDown": ("eyeLookDownLeft", "eyeLookDownRight"),
    "lookLeft": ("eyeLookOutLeft", "eyeLookInRight"),
    "lookRight": ("eyeLookInLeft", "eyeLookOutRight"),
}


def write_vrm(
    path: Path, avatar: PortableAvatar, model: MeshModel, texture_size: int = TEXTURE_SIZE
) -> tuple[str, ...]:
    """Write an avatar as one .vrm file of VRM 1.0, which faces +z, in metres, and return the names of the expressions.

    The same input gives the same bytes.
    """
    head = head_of(path, avatar, model, texture_size)
    about, content = avatar.about, head.content
    bones = _add_body(content)
    person = runtime.Avatar(avatar).render(camera=avatar.camera.square(512), background=(1, 1, 1))[0]
    content["images"].append({"name": "thumbnail", **head.writer.jpeg(person.clip(0, 1), 90)})
    meta = {
        "name": about.name,
        "authors": [about.name],
        "licenseUrl": LICENCE,
        "thirdPartyLicenses": f"Face model {about.face_model}: {about.licence}",
        "thumbnailImage": 1,
        **PERMISSIONS,
    }
    content |= {
        "asset": {"version": "2.0", "generator": f"mien {about.mien}"},
        "scene": 0,
        "scenes": [{"name": about.name, "nodes": [0, bones["hips"]["node"]]}],
        "extensionsUsed": ["KHR_materials_unlit", EXTENSION],
        "extensions": {
            EXTENSION: {
                "specVersion": SPEC_VERSION,
                "meta": meta,
                "humanoid": {"humanBones": bones},
                "expressions": expressions(head.targets),
                **_look_at(head, bones),
            }
        },
    }
    head.writer.write(path, content)
    return head.targets


def expressions(targets: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """VRM's expressions by the morph targets of node 0: its presets, and each morph target by its own name."""
    faces: dict[str, Mapping[str, float]] = {name: presets()[preset] for name, preset in _EMOTIONS.items()}
    faces |= {"relaxed": _RELAXED, "neutral": {}}
    faces |= {name: visemes()[viseme] for name, viseme in _MOUTHS.items()}
    faces |= {name: dict.fromkeys(parts, 1.0) for name, parts in _LOOKS.items()}

    def expression(face: Mapping[str, float]) -> dict[str, Any]:
        binds = [{"node": 0, "index": targets.index(name), "weight": weight} for name, weight in face.items()]
        return {"morphTargetBinds": binds} if binds else {}

    return {
        "preset": {name: expression(face) for name, face in faces.items() if set(face) <= set(targets)},
        "custom": {name: expression({name: 1.0}) for name in targets},
    }


def _add_body(content: dict[str, Any]) -> dict[str, dict[str, int]]:
    """Add the bones that a head lacks, hang the skin's root on them, and return the nodes of all bones by role."""
    nodes, bones, roles = content["nodes"], {}, dict(BODY)
    for name, (parent, (x, y, z)) in BODY.items():
        if name.startswith("left"):
            right = (parent or "").replace("left", "right")
            roles["right" + name.removeprefix("left")] = (right, (-x, y, z))
    for name, (parent, place) in roles.items():
        bones[name] = len(nodes)
        nodes.append({"name": name, "translation": list(place)})
        if parent:
            nodes[bones[parent]].setdefault("children", []).append(bones[name])
    root = content["skins"][0]["skeleton"]
    parent, place = _HEAD
    nodes[root]["translation"] = list(place)
    nodes[bones[parent]].setdefault("children", []).append(root)
    names = {nodes[joint]["name"]: joint for joint in content["skins"][0]["joints"]}
    eyes = {role: names[joint] for role, joint in _EYES.items() if joint in names}
    return {name: {"node": node} for name, node in {**bones, "head": root, **eyes}.items()}


def _look_at(head: Head, bones: dict[str, dict[str, int]]) -> dict[str, Any]:
    """How eyes look at a point: by morph targets, with their lids. Nothing if the face model has none for that."""
    eyes = [head.content["nodes"][bones[role]["node"]]["translation"] for role in _EYES if role in bones]
    if not eyes or not set(GAZE_NAMES) <= set(head.targets):
        return {}

    def full_at(radians: float) -> dict[str, float]:
        return {"inputMaxValue": float(np.degrees(radians)), "outputScale": 1.0}

    up, down = (abs(float(within_lids(np.array([pitch, 0, 0], np.float32))[0])) for pitch in (-LOOK_ANGLE, LOOK_ANGLE))
    return {
        "lookAt": {
            "type": "expression",
            "offsetFromHeadBone": np.mean(eyes, axis=0).tolist(),
            "rangeMapHorizontalInner": full_at(LOOK_ANGLE),
            "rangeMapHorizontalOuter": full_at(LOOK_ANGLE),
            "rangeMapVerticalDown": full_at(down),
            "rangeMapVerticalUp": full_at(up),
        }
    }


def write(path: Path, content: Content, options: NoOptions) -> str:
    """Write the file, and return what is told of it."""
    mesh = content.mesh()
    targets = write_vrm(path, content.portable(), mesh)
    return f"a mesh with {len(targets)} expressions in VRM 1.0, {path.stat().st_size / 1e6:.1f} MB"
