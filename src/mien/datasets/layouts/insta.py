"""INSTA's layout: the head at rest before a moving camera, RGBA pictures, posed meshes, and expressions.

With FLAME, the checkpoints of metrical-tracker are written as well, which INSTA's own release lacks.
"""

import math
import pickle
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mien.datasets.flame_poses import AXES, FRONT
from mien.datasets.layouts.filmed import Filmed, as_flame, lost_words, motion_between, padded
from mien.datasets.layouts.layout import Written
from mien.datasets.layouts.writing import write_plain_json
from mien.face.params import FaceParams
from mien.machine.progress import track_progress
from mien.media.picture_files import write_png
from mien.render.mesh import rasterize_mesh
from mien.rotation import matrix_from_axis_angle

_EXPRESSIONS, _SHAPES = 100, 300
_VALIDATED = 20  # number of pictures of the test at its end that val holds as well
_OPEN_RADIANS, _OPEN_SHARE = 0.2, 0.5
"""The mouth of canonical.obj: the angle of a jaw, or the coefficient of an expression that opens it."""
_MILLIMETRES = 1000


@torch.no_grad()
def write(folder: Path, filmed: Filmed) -> Written:
    """Write the files of a subject of INSTA."""
    face = filmed.face()
    rest, poses, told = _at_rest(folder, filmed, face)
    frames = []
    for number, timestep in enumerate(track_progress(filmed.timesteps, "write pictures", len(filmed.timesteps))):
        pixels = np.dstack([filmed.image(timestep), filmed.matte(timestep)])
        write_png(folder / "images" / f"{number:05d}.png", pixels)
        vertices = filmed.face_model(rest[number])[0]
        _write_obj(folder / "meshes" / f"{number:05d}.obj", vertices, filmed.face_model.faces)
        _write_depth(folder / "depth" / f"{number:05d}.png", filmed, face[number])
        values = padded(rest.expression[number].double().numpy(), _EXPRESSIONS)
        place = folder / "flame" / "exp" / f"{number:05d}.txt"
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text("".join(f"{each:.9g}\n" for each in values))
        frames.append(
            {
                "transform_matrix": np.linalg.inv(poses[number]).tolist(),
                "file_path": f"images/{number:05d}.png",
                "mesh_path": f"meshes/{number:05d}.obj",
                "exp_path": f"flame/exp/{number:05d}.txt",
                "depth_path": f"depth/{number:05d}.png",
            }
        )
    _write_obj(folder / "canonical.obj", filmed.face_model(_open(filmed, rest[:1]))[0], filmed.face_model.faces)
    numbers = {timestep: number for number, timestep in enumerate(filmed.timesteps)}
    train = [frames[numbers[timestep]] for timestep in filmed.trained]
    test = [frames[numbers[timestep]] for timestep in filmed.held_out]
    for part, listed in (("", frames), ("_train", train), ("_test", test), ("_val", test[-_VALIDATED:])):
        if listed:
            write_plain_json(folder / f"transforms{part}.json", {**_intrinsics(filmed), "frames": listed})
    names = {(timestep, 0): f"{numbers[timestep]:05d}" for timestep in filmed.held_out}
    return Written(names, (*_words(filmed, rest), *told))


def _words(filmed: Filmed, face: FaceParams) -> tuple[str, ...]:
    model = filmed.face_model
    return (
        "transforms_test.json lists the held-out frames, and transforms_val.json the last 20 of them once more.",
        f"flame/exp: the expression coefficients of {model.name}, then zeros"
        + ("." if model.flame_origin is not None else "; they are not FLAME's."),
        f"meshes, canonical.obj: the whole mesh of {model.name}, also jaw, eyes, neck and offsets, with the head at "
        "rest. Its number of vertices is not that of INSTA's own cut mesh. The face model's licence holds for it.",
        "depth: that of the mesh, in millimetres. Not written: seg_mask, matted and background.",
        *lost_words("expression", face.expression.numpy(), _EXPRESSIONS),
    )


def _at_rest(
    folder: Path, filmed: Filmed, face: FaceParams
) -> tuple[FaceParams, Float[np.ndarray, "t 4 4"], tuple[str, ...]]:
    """The faces with the head at rest, the world-to-camera matrices that it is seen by, and what is lost.

    The world is FLAME's with root and neck at rest, or the head frame of another model.
    """
    model = filmed.face_model
    origin = torch.zeros(3) if model.flame_origin is None else model.flame_origin
    still = torch.zeros_like(face.head_rotation)
    rest = replace(face, head_rotation=still, head_translation=origin.expand_as(still).contiguous())
    turns, shifts = motion_between(rest, face)
    poses = np.tile(np.eye(4), (len(face), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = AXES @ turns, shifts @ AXES
    if model.flame_origin is None:
        return rest, poses, (f"checkpoint: not written, because {model.name} is not FLAME.",)
    return rest, poses, _write_checkpoints(folder, filmed, face)


def _write_checkpoints(folder: Path, filmed: Filmed, face: FaceParams) -> tuple[str, ...]:
    # With neck and root at rest, the head itself is carried to its place.
    poses = "jaw_pose", "eyes_pose"
    whole, arrays, turns, shifts = as_flame(folder, filmed, face, poses, _SHAPES, _EXPRESSIONS)
    for number in range(len(face)):
        row = {"shape": arrays["shape"], **{name: arrays[name][number] for name in ("expr", "jaw_pose", "eyes_pose")}}
        view = (AXES @ turns[number], AXES @ shifts[number], filmed.K)
        _write_tracker_frame(folder / "checkpoint" / f"{number:05d}.frame", row, view, filmed.size, number)
    told = [
        "checkpoint: files of metrical-tracker with the face model's coefficients. They are right for other programs "
        "only if it is FLAME 2020. Lids are 0. Lost in them: the neck joint, texture and light."
    ]
    if whole["static_offset"].any():
        told.append("Lost in checkpoint, and not in meshes: the offsets of the mesh.")
    return (*told, *lost_words("identity", whole["shape"], _SHAPES))


def _intrinsics(filmed: Filmed) -> dict[str, Any]:
    K, (width, height) = filmed.K, filmed.size
    angles = [2 * math.atan(size / (2 * float(K[axis, axis]))) for axis, size in enumerate((width, height))]
    return {
        "w": width, "h": height, "fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": float(K[0, 2]),
        "cy": float(K[1, 2]), "camera_angle_x": angles[0], "camera_angle_y": angles[1],
        "x_fov": math.degrees(angles[0]), "y_fov": math.degrees(angles[1]), "integer_depth_scale": 1 / _MILLIMETRES,
    }  # fmt: skip


def _open(filmed: Filmed, rest: FaceParams) -> FaceParams:
    """The person's neutral face with an open mouth, as in canonical.obj."""
    model = filmed.face_model
    expression, joints = torch.zeros_like(rest.expression), torch.zeros_like(rest.joints)
    if "jaw" in model.free_joint_names:
        joints[:, model.free_joint_names.index("jaw"), 0] = _OPEN_RADIANS
    elif "jawOpen" in model.expression_names:
        expression[:, model.expression_names.index("jawOpen")] = _OPEN_SHARE
    return replace(rest, expression=expression, joints=joints)


def _write_depth(path: Path, filmed: Filmed, face: FaceParams) -> None:
    """Write the depth of the mesh as a picture of 16 bits, in whole millimetres; 0 beside the mesh."""
    front = replace(filmed.camera, viewmat=torch.from_numpy(FRONT).float())
    depth = rasterize_mesh(filmed.face_model(face)[0], filmed.face_model.faces, front).depth.numpy()
    whole = np.where(np.isfinite(depth), np.clip(depth * _MILLIMETRES, 0, 65535).round(), 0).astype(np.uint16)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(".png", whole)[1].tobytes())


def _write_obj(path: Path, vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [f"v {x:.7g} {y:.7g} {z:.7g}\n" for x, y, z in vertices.tolist()]
    path.write_text("".join(lines + [f"f {a} {b} {c}\n" for a, b, c in (faces + 1).tolist()]))


def _write_tracker_frame(
    path: Path, flame: Mapping[str, np.ndarray], view: tuple[np.ndarray, ...], size: tuple[int, int], number: int
) -> None:
    """Write a checkpoint of metrical-tracker: an archive of torch with a pickle of numpy arrays.

    FLAME's root and neck are at rest in it, and the camera moves.

    `flame` holds `shape` [300], `expr` [100], `jaw_pose` [3], and `eyes_pose` [6] (left, then right), axis-angles.
    `view` is the world-to-camera rotation and translation with OpenCV's axes, in metres, and intrinsics in pixels.
    """
    rotation, translation, K = view
    eyes = np.concatenate([_six(part) for part in np.split(flame["eyes_pose"], 2)], axis=1)
    content = {
        "flame": {
            "exp": _row(flame["expr"]), "shape": _row(flame["shape"]), "jaw": _float32(_six(flame["jaw_pose"])),
            "eyes": _float32(eyes), "eyelids": np.zeros((1, 2), np.float32),
        },
        "opencv": {"R": _row(rotation), "t": _row(translation), "K": _row(K)},
        "img_size": np.array([size[1], size[0]]), "frame_id": f"{number:05d}", "global_step": 0,
    }  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w") as archive:
        # Pickles look for numpy's arrays in `numpy._core`, which the old numpy of those programs does not have.
        pickled = pickle.dumps(content, protocol=2).replace(b"cnumpy._core.", b"cnumpy.core.")
        archive.writestr("archive/data.pkl", pickled)
        archive.writestr("archive/version", "3\n")


def _six(axis_angle: np.ndarray) -> np.ndarray:
    """The first two rows of a rotation, [1, 6]."""
    return matrix_from_axis_angle(torch.from_numpy(axis_angle).double()).numpy()[:2].reshape(1, 6)


def _row(array: np.ndarray) -> np.ndarray:
    return _float32(array[None])


def _float32(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(array, np.float32)
