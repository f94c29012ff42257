"""Writers of other programs' layouts, made from the description of each. They call nothing of the importers."""

import io
import json
import pickle
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from dataset_scene import SIDE, Scene, draw, head_view, projected
from mien.media.video import write_video
from mien.rotation import matrix_from_axis_angle
from recordings import live_link_face

OFF_CENTRE = np.array([[155.0, 0, 66.3], [0, 155.0, 61.9], [0, 0, 1]])
"""Intrinsics with square pixels, whose principal point is off the centre in both axes."""
UNEQUAL = np.array([[159.0, 0, 66.3], [0, 151.0, 61.9], [0, 0, 1]])
MIRROR = np.diag([1.0, -1.0, -1.0])
"""The rotation between OpenCV's axes and OpenGL's."""


def write_picture(path: Path, image: np.ndarray, matte: np.ndarray | None = None) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = image[..., ::-1] if matte is None else np.concatenate([image[..., ::-1], matte[..., None]], axis=-1)
    assert cv2.imwrite(str(path), pixels)


def rotation_of(axis_angle: np.ndarray) -> np.ndarray:
    return matrix_from_axis_angle(torch.from_numpy(axis_angle)).numpy()


def rigid(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    return np.vstack([np.column_stack([rotation, translation]), [0, 0, 0, 1]])


def tripled(matte: np.ndarray) -> np.ndarray:
    """Return a matte [h, w] with three channels."""
    return np.repeat(matte[..., None], 3, -1)


def tracker_frame(scene: Scene, timestep: int, K: np.ndarray) -> dict[str, Any]:
    """Return the dictionary of a checkpoint of metrical-tracker: root and neck are at rest."""
    rotation, translation = head_view(timestep)
    # Rotations are their first two rows.
    jaw, *eyes = (rotation_of(angles)[:2].reshape(1, 6) for angles in scene.pose[timestep, 2:])
    arrays = {
        "flame": {
            "exp": scene.expr[timestep][None], "shape": scene.shape[None], "jaw": jaw,
            "eyes": np.concatenate(eyes, axis=1), "eyelids": np.array([[0.1, 0.4]]),
        },
        "opencv": {"R": rotation[None], "t": translation[None], "K": K[None]},
    }  # fmt: skip
    exact = {
        part: {name: np.ascontiguousarray(array, np.float32) for name, array in content.items()}
        for part, content in arrays.items()
    }
    return {**exact, "img_size": np.array([SIDE, SIDE]), "frame_id": f"{timestep:05d}", "global_step": 7}


def write_frame(path: Path, content: dict[str, Any]) -> None:
    """Write a checkpoint as torch does: a zip with a pickle of protocol 2."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", pickle.dumps(content, protocol=2))
        archive.writestr("archive/version", "3\n")


def seen_by_tracker(scene: Scene, timestep: int, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return draw(scene, scene.vertices(timestep, root=False, neck=False), K, *head_view(timestep))


def write_insta(folder: Path, scene: Scene, checkpoints: bool = True, held_out: int = 0) -> Path:
    """Write a subject of INSTA, with a gap in the numbers of the frames. Its test split has the last ones."""
    frames = []
    for timestep in range(len(scene)):
        number = timestep + (timestep > 2)
        image, matte = seen_by_tracker(scene, timestep, OFF_CENTRE)
        write_picture(folder / f"images/{number:05d}.png", image, matte)
        if checkpoints:
            write_frame(folder / f"checkpoint/{number:05d}.frame", tracker_frame(scene, timestep, OFF_CENTRE))
        pose = np.linalg.inv(rigid(*head_view(timestep))).tolist()
        frames.append({
            "transform_matrix": pose, "file_path": f"images/{number:05d}.png",
            "exp_path": f"flame/exp/{number:05d}.txt", "mesh_path": f"meshes/{number:05d}.obj",
        })  # fmt: skip
    content = {"w": SIDE, "h": SIDE, "fl_x": OFF_CENTRE[0, 0], "fl_y": OFF_CENTRE[1, 1], "cx": OFF_CENTRE[0, 2],
               "cy": OFF_CENTRE[1, 2], "integer_depth_scale": 0.001, "frames": frames}  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps(content))
    if held_out:
        (folder / "transforms_test.json").write_text(json.dumps({**content, "frames": frames[-held_out:]}))
    return folder


def write_flash_avatar(root: Path, scene: Scene) -> Path:
    """Write FlashAvatar's folders: the number of a picture is that of its checkpoint plus one."""
    for timestep in range(len(scene)):
        image, matte = seen_by_tracker(scene, timestep, OFF_CENTRE)
        write_picture(root / f"dataset/me/imgs/{timestep + 1:05d}.png", image)
        write_picture(root / f"dataset/me/alpha/{timestep + 1:05d}.png", tripled(matte))
        place = root / f"metrical-tracker/output/me/checkpoint/{timestep:05d}.frame"
        write_frame(place, tracker_frame(scene, timestep, OFF_CENTRE))
    return root


IMAVATAR_PLACE = np.array([0.03, -0.02, -3.7])
"""Place of FLAME's origin before the camera, in units of a quarter of a metre, with OpenGL's axes."""


def imavatar_classes(matte: np.ndarray) -> np.ndarray:
    """Return the classes of a picture of IMavatar: a necklace and cloth in the lower rows, skin above them."""
    classes = np.where(matte > 127, 1, 0).astype(np.uint8)
    rows = np.arange(len(matte))[:, None]
    classes[(rows > 0.62 * SIDE) & (matte > 127)] = 16
    classes[(rows > 0.58 * SIDE) & (classes == 1)] = 15
    return classes


def write_imavatar(folder: Path, scene: Scene, clips: tuple[str, ...] = ("MVI_1810", "MVI_1812")) -> Path:
    """Write a subject of IMavatar, whose frames are divided among the clips. Rays go through whole pixels."""
    share = len(scene) // len(clips)
    for index, clip in enumerate(clips):
        place, frames = folder / folder.name / clip, []
        for number in range(share):
            timestep = index * share + number
            vertices = scene.vertices(timestep) - scene.translation[timestep]
            image, matte = draw(scene, vertices, UNEQUAL, MIRROR, MIRROR @ IMAVATAR_PLACE / 4)
            write_picture(place / f"image/{number + 1}.png", image)
            write_picture(place / f"mask/{number + 1}.png", tripled(matte))
            write_picture(place / f"semantic/{number + 1}.png", imavatar_classes(matte)[..., None])
            frames.append({
                "file_path": f"./image/{number + 1}",
                "world_mat": np.concatenate([np.eye(3), IMAVATAR_PLACE[:, None]], axis=1).tolist(),
                "expression": scene.expr[timestep, :50].tolist(), "pose": scene.pose[timestep].ravel().tolist(),
                "bbox": [-0.5, -0.5, 0.5, 0.5], "flame_keypoints": np.zeros((70, 2)).tolist(),
            })  # fmt: skip
        fx, fy, cx, cy = UNEQUAL[0, 0], UNEQUAL[1, 1], UNEQUAL[0, 2] - 0.5, UNEQUAL[1, 2] - 0.5
        content = {"intrinsics": [-fx / SIDE, fy / SIDE, cx / SIDE, cy / SIDE],
                   "shape_params": scene.shape[:100].tolist(), "frames": frames}  # fmt: skip
        (place / "flame_params.json").write_text(json.dumps(content))
    return folder


def npz(arrays: dict[str, Any]) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def write_vhap(
    folder: Path, scene: Scene, from_below: bool = False, cameras: tuple[str, ...] = ("222200036", "222200037"),
) -> Path:  # fmt: skip
    """Write an export of VHAP with calibrated cameras. The last camera and the last timesteps are not trained on."""
    frames, size = [], (SIDE, SIDE + SIDE // 16)
    held = -(-7 * len(scene) // 10)
    for timestep in range(len(scene)):
        row = {
            "translation": scene.translation[timestep][None], "rotation": scene.pose[timestep, 0][None],
            "neck_pose": scene.pose[timestep, 1][None], "jaw_pose": scene.pose[timestep, 2][None],
            "eyes_pose": scene.pose[timestep, 3:].reshape(1, 6), "shape": scene.shape,
            "expr": scene.expr[timestep][None],
        }  # fmt: skip
        file = folder / f"flame_param/{timestep:05d}.npz"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(npz({name: array.astype(np.float32) for name, array in row.items()}))
        for index, camera in enumerate(cameras):
            rotation, translation = head_view(2 + index, 1.0)
            image, matte = draw(scene, scene.vertices(timestep), UNEQUAL, rotation, translation, size)
            name = f"{timestep:05d}_{index:02d}.png"
            write_picture(folder / f"images/{name}", image)
            write_picture(folder / f"fg_masks/{name}", matte[..., None])
            to_world = np.linalg.inv(rigid(rotation, translation)) @ rigid(MIRROR, np.zeros(3))
            cy = size[1] - UNEQUAL[1, 2] if from_below else UNEQUAL[1, 2]
            frames.append({
                "timestep_index": timestep, "camera_index": index, "camera_id": camera, "fl_x": UNEQUAL[0, 0],
                "fl_y": UNEQUAL[1, 1], "cx": UNEQUAL[0, 2], "cy": cy, "w": size[0], "h": size[1],
                "transform_matrix": to_world.tolist(),
                "file_path": f"images/{name}", "fg_mask_path": f"fg_masks/{name}",
                "flame_param_path": f"flame_param/{timestep:05d}.npz",
            })  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))
    trained = [frame for frame in frames if frame["timestep_index"] < held and frame["camera_id"] != cameras[-1]]
    (folder / "transforms_train.json").write_text(json.dumps({"frames": trained or frames[: held * len(cameras)]}))
    return folder


def nerface_landmarks(scene: Scene, images: np.ndarray) -> np.ndarray:
    """Return the landmarks of the pictures of a clip of `write_nerface` with `detected`, in place of a detector's."""
    marks = [
        projected(scene.marks(scene.vertices(timestep, root=False, neck=False)), UNEQUAL, *head_view(timestep))
        for timestep in (range(4) if len(images) == 4 else [5])
    ]
    return np.stack(marks)[:, None].astype(np.float32)


def write_nerface(folder: Path, scene: Scene, scale: float = 0.6, detected: bool = False) -> Path:
    """Write a person of NeRFace: training pictures in a shuffled order, a mirrored world, fx below 0.

    The neck is at rest if landmarks are those of the drawn head (`detected`), as that of a rigid pose.

    A ray of the file through the whole pixel (u, v) has the direction R ((u - cx) / fx, -(v - cy) / fy, -1)."""
    order = [2, 0, 3, 1]  # number of each training picture in the clip
    index = np.stack([np.arange(5.0), [*np.argsort(order), -1]], axis=1)
    mirror = np.diag([-1.0, 1.0, 1.0])
    for part, timesteps in (("train", order), ("val", [4]), ("test", [5])):
        frames = []
        for number, timestep in enumerate(timesteps):
            rotation, translation = head_view(timestep)
            vertices = scene.vertices(timestep, root=False, neck=not detected)
            image, _ = draw(scene, vertices, UNEQUAL, rotation, translation)
            write_picture(folder / f"{part}/f_{number:04d}.png", image)
            pose = rigid(-mirror @ rotation.T, mirror @ (-rotation.T @ translation) * scale)
            frames.append({"file_path": f"./{part}/f_{number:04d}", "transform_matrix": pose.tolist(),
                           "expression": [timestep, *[0.5] * 75], "bbox": [0, 1, 0, 1]})  # fmt: skip
        intrinsics = [-UNEQUAL[0, 0], UNEQUAL[1, 1], (UNEQUAL[0, 2] - 0.5) / SIDE, (UNEQUAL[1, 2] - 0.5) / SIDE]
        content = {"camera_angle_x": -0.8, "frames": frames, "intrinsics": intrinsics}
        (folder / f"transforms_{part}.json").write_text(json.dumps(content))
    np.save(folder / "index_map.npy", index)
    write_picture(folder / "bg/00050.png", np.full((SIDE, SIDE, 3), 255, np.uint8))
    return folder


def write_nerf_blendshape(folder: Path, scene: Scene, scale: float = 1.0, detected: bool = False) -> Path:
    """Write a person of NeRFBlendShape, from picture 7 on and with a gap, in a world of another scale.
    Landmarks are made up, or those of the drawn head (`detected`), whose neck is then at rest as that of a rigid pose.
    """
    frames = []
    for timestep in range(len(scene)):
        number = 7 + timestep + (timestep > 2)
        rotation, translation = head_view(timestep)
        vertices = scene.vertices(timestep, root=False, neck=not detected)
        image, matte = draw(scene, vertices, UNEQUAL, rotation, translation)
        write_picture(folder / f"ori_imgs/{number}.jpg", image)
        classes = np.zeros((SIDE, SIDE, 3), np.uint8)
        classes[matte > 127] = (0, 0, 255)
        classes[:4] = (0, 255, 0)
        write_picture(folder / f"parsing/{number}.png", classes)
        points = np.stack([np.arange(478) % SIDE, np.full(478, timestep + 0.25)], axis=1)
        if detected:
            points = projected(scene.marks(vertices), UNEQUAL, rotation, translation)
        (folder / f"ori_imgs/{number}.lms").write_text("\n".join(f"{x} {y}" for x, y in points))
        pose = np.linalg.inv(rigid(rotation, translation * scale)) @ rigid(MIRROR, np.zeros(3))
        frames.insert(0, {"img_id": number, "transform_matrix": pose.tolist(), "exp_ori": [timestep / 10] * 46})
    content = {"h": SIDE, "w": SIDE, "fx": UNEQUAL[0, 0], "fy": UNEQUAL[1, 1], "cx": UNEQUAL[0, 2] - 0.5,
               "cy": UNEQUAL[1, 2] - 0.5, "frames": frames}  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


BENCHMARK_SCALE = 1.07
FRONTAL = "222200037"


def turn_of(angles: np.ndarray) -> np.ndarray:
    """Return the benchmark's rotation by Euler angles: about x, y and z."""
    return np.linalg.multi_dot([rotation_of(axis * angle) for axis, angle in zip(np.eye(3), angles, strict=True)])


def benchmark_vertices(scene: Scene, timestep: int, angles: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Return the vertices of the benchmark's forward pass: scaled, turned and shifted about the model's origin."""
    return BENCHMARK_SCALE * scene.vertices(timestep, root=False) @ turn_of(angles).T + shift


def write_benchmark(
    folder: Path, scene: Scene, serials: tuple[str, ...] = (FRONTAL,), tracked: bool = True,
    clips: tuple[str, ...] = ("EXP-2-eyes",),
) -> Path:  # fmt: skip
    """Write a person of the NeRSemble benchmark. The frames are divided among the clips.
    If it is tracked, FREE is a test sequence that has a tracking only."""
    random = np.random.default_rng(8)
    angles, shifts = random.uniform(-0.3, 0.3, (len(scene), 3)), random.uniform(-0.03, 0.03, (len(scene), 3))
    poses, share = {}, len(scene) // len(clips)
    parts = {clip: slice(index * share, (index + 1) * share) for index, clip in enumerate(clips)}
    for index, serial in enumerate(serials):
        rotation, translation = head_view(2 + index, 1.0)
        poses[serial] = rigid(rotation, translation).tolist()
        drawn = [
            draw(scene, benchmark_vertices(scene, t, angles[t], shifts[t]), UNEQUAL, rotation, translation)
            for t in range(len(scene))
        ]
        mattes = [tripled(matte) for _, matte in drawn]
        for clip, part in parts.items():
            place = folder / "sequences" / clip
            write_video(place / f"images/cam_{serial}.mp4", iter([image for image, _ in drawn[part]]), 24.3, crf=1)
            write_video(place / f"alpha_maps/cam_{serial}.mp4", iter(mattes[part]), 24.3, crf=1)
    calibration = {"world_2_cam": poses, "intrinsics": dict.fromkeys(poses, UNEQUAL.tolist())}
    (folder / "calibration").mkdir()
    (folder / "calibration/camera_params.json").write_text(json.dumps(calibration))
    turns = np.stack([turn_of(each) for each in angles])
    for name, part in {**parts, "FREE": slice(None)}.items() if tracked else ():
        arrays = {
            "expression": scene.expr[part], "rotation": angles[part], "rotation_matrices": turns[part],
            "translation": shifts[part], "jaw": scene.pose[part, 2], "neck": scene.pose[part, 1],
            "eyes": scene.pose[part, 3:].reshape(-1, 6), "frames": np.arange(len(scene))[part],
            "shape": scene.shape[None], "scale": np.array([[BENCHMARK_SCALE]]),
        }  # fmt: skip
        file = folder / f"sequences/{name}/tracking/flame2023_tracking_v2.npz"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(npz({key: array.astype(np.float32) for key, array in arrays.items()}))
    np.savez(folder / "truth.npz", angles=angles, shifts=shifts)
    return folder


def _nothing(path: Path, serial: str = "") -> None:
    path.write_bytes(b"0")


def write_nersemble(
    folder: Path, serials: tuple[str, ...] = ("222200036", FRONTAL), film: Callable[[Path, str], None] = _nothing,
    colors: Mapping[str, np.ndarray] | None = None,
) -> Path:  # fmt: skip
    """Write a person of NeRSemble's raw recordings. `film` writes the video of a camera, instead of empty files.
    `colors` has the correction [3, n] of each camera's colours."""
    (folder / "calibration").mkdir(parents=True)
    K = [[8000.0, 0, 1100], [0, 8000, 1604], [0, 0, 1]]
    content = {"world_2_cam": dict.fromkeys(serials, np.eye(4).tolist()), "intrinsics": K}
    (folder / "calibration/camera_params.json").write_text(json.dumps(content))
    if colors is not None:
        content = {serial: matrix.tolist() for serial, matrix in colors.items()}
        (folder / "calibration/color_calibration.json").write_text(json.dumps(content))
    for serial in serials:
        for name in (f"EMO-1-shout+laugh/images/cam_{serial}.mp4", f"BACKGROUND/image_{serial}.jpg"):
            place = folder / "sequences" / name
            place.parent.mkdir(parents=True, exist_ok=True)
            (film if place.suffix == ".mp4" else _nothing)(place, serial)
    return folder


def write_take(folder: Path, film: Callable[[Path, str], None] = _nothing) -> Path:
    """Write a take of Live Link Face: a table of coefficients, and a video that `film` writes."""
    folder.mkdir(parents=True, exist_ok=True)
    table = live_link_face(folder, [{"jawOpen": 0.1 * index, "eyeBlinkLeft": 0.5} for index in range(6)])
    table.rename(folder / "Me_3_iPhone_cal.csv")
    film(folder / "Me_3_iPhone.mov", "")
    (folder / "take.json").write_text(json.dumps({"slate": "Me", "takeNumber": 3, "rate": [60, 1.5]}))
    (folder / "frame_log.csv").write_text("V,0,12:00:00:00.451\nV,1,12:00:00:02.451\n")
    return folder
