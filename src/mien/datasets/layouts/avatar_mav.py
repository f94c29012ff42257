"""AvatarMAV's layout: numbered pictures with masks, and pose, scale and expression of each, before one far camera."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from mien.datasets.flame_poses import AXES, axis_angles
from mien.datasets.layouts.filmed import Filmed, vectors
from mien.datasets.layouts.layout import Written
from mien.datasets.layouts.writing import write_jpg
from mien.errors import UserError
from mien.machine.progress import track_progress

_NUMBERS = 32
_FOCAL = 2500 / 256  # focal length of the program's camera, relative to the picture's side
_DISTANCE = 4.0  # distance of that camera from the world's origin, along +z
_LOW, _HIGH = np.array([-1.2, -1.1, -1.8]), np.array([1.2, 1.6, 0.9])  # box of a head in the program's own frame
_FILLED = 0.85  # share of that box which the mesh may fill, so that hair has room


def write(folder: Path, filmed: Filmed) -> Written:
    """Write the files of a person of AvatarMAV: one video to train on, and one that is held out."""
    width, height = filmed.size
    if width != height:
        raise UserError(
            f"{filmed.sequence.name}: has pictures of {width}x{height}, and the layout avatar-mav holds square ones; "
            "use --format nerface, or capture the video again"
        )
    origin, unit = _frame(filmed)
    poses, scales, error = _seen_from_afar(filmed, origin, unit)
    values, told = vectors(filmed, _NUMBERS)
    rows = {timestep: index for index, timestep in enumerate(filmed.timesteps)}
    for part, timesteps in (("train", filmed.trained), ("test", filmed.held_out)):
        (folder / part / "params").mkdir(parents=True, exist_ok=True)
        for number, timestep in enumerate(track_progress(timesteps, f"write {part}", len(timesteps))):
            write_jpg(folder / part / f"images/img_{number:05d}.jpg", filmed.image(timestep))
            write_jpg(folder / part / f"images/mask_{number:05d}.jpg", filmed.matte(timestep))
            row = slice(rows[timestep], rows[timestep] + 1)
            arrays = {"pose": poses[row], "scale": scales[row], "exp_coeff": values[row]}
            whole = {name: array.astype(np.float32) for name, array in arrays.items()}
            np.savez(folder / part / f"params/params_{number:05d}.npz", **whole)  # pyright: ignore
    names = {(timestep, 0): f"img_{number:05d}" for number, timestep in enumerate(filmed.held_out)}
    return Written(
        names,
        (
            "In its settings, dataroot is this folder and video_name is train; test is held out.",
            f"A head's own unit is {unit:.9g} m, and its origin at {', '.join(f'{each:.9g}' for each in origin)} m.",
            "Lost: perspective, because the program's camera is far away. The front of the mesh is seen up to "
            f"{error:.1f} pixels beside its place. Also lost: the last digits of pixels and mattes, in .jpg.",
            *told,
        ),
    )


def _frame(filmed: Filmed) -> tuple[Float[np.ndarray, " 3"], float]:
    """The origin in the head frame and the unit, in metres, with which the neutral mesh fits into the program's box."""
    mesh = filmed.face_model.template.double().numpy()
    low, high = mesh.min(0), mesh.max(0)
    unit = float(((high - low) / (_FILLED * (_HIGH - _LOW))).max())
    return (low + high) / 2 - unit * (_LOW + _HIGH) / 2, unit


def _seen_from_afar(
    filmed: Filmed, origin: Float[np.ndarray, " 3"], unit: float
) -> tuple[Float[np.ndarray, "t 6"], Float[np.ndarray, " t"], float]:
    """Poses and scales with which heads look as they were filmed, and the largest error of the mesh in pixels.

    The box's middle has its place in the picture and is seen from the same side; the half of the mesh that is nearer
    has its size, and the error is that of this half. A pose is an axis-angle and a translation: a head's point p is at
    scale * R p + t in the world.
    """
    K, side, heads = filmed.K, filmed.size[0], filmed.head_to_camera()
    middle = origin + unit * (_LOW + _HIGH) / 2
    before = heads[:, :3, :3] @ middle + heads[:, :3, 3]
    pixels = before @ K.T
    after = np.ones_like(before)
    after[:, :2] = (pixels[:, :2] / pixels[:, 2:] / side - 0.5) / _FOCAL
    turns = _turn_between(before, after) @ heads[:, :3, :3]
    mesh, scales, shifts, errors = filmed.face_model.template.double().numpy(), [], [], []
    for head, turn, place, ahead in zip(heads, turns, before, after, strict=True):
        true = (mesh @ head[:3, :3].T + head[:3, 3]) @ K.T
        near = true[:, 2] < place[2]
        depth = true[near, 2].mean()
        scales.append(unit * (K[0, 0] + K[1, 1]) / 2 / depth * _DISTANCE / (_FOCAL * side))
        # From the middle of the box to the origin of the program's frame.
        shifts.append(_DISTANCE * place[2] / depth * ahead - scales[-1] * (turn @ ((middle - origin) / unit)))
        seen = scales[-1] * ((mesh - origin) / unit) @ turn.T + shifts[-1]
        drawn = side * (_FOCAL * seen[:, :2] / seen[:, 2:] + 0.5)
        errors.append(np.linalg.norm(drawn - true[:, :2] / true[:, 2:], axis=1)[near].max())
    world = np.concatenate([axis_angles(AXES @ turns), (np.array(shifts) - [0, 0, _DISTANCE]) @ AXES], axis=1)
    return world, np.array(scales), float(max(errors))


def _turn_between(first: Float[np.ndarray, "t 3"], second: Float[np.ndarray, "t 3"]) -> Float[np.ndarray, "t 3 3"]:
    """The smallest rotations that carry directions into others, which are less than a right angle away."""
    first, second = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in (first, second))
    x, y, z = np.cross(first, second).T
    skew = np.stack([0 * x, -z, y, z, 0 * x, -x, -y, x, 0 * x], axis=1).reshape(-1, 3, 3)
    cosine = (first * second).sum(1)[:, None, None]
    return np.eye(3) + skew + skew @ skew / (1 + cosine)
