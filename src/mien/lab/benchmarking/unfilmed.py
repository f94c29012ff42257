"""The protocol `unfilmed`: faces that a clip does not show, against true pictures of the person, by region.

An avatar is trained on the true tracking, so that coefficients mean the same in both, and what is measured is the
avatar alone: once after a clip of talk, and once after clips that show everything, which is as good as a method gets. A
third one is trained on the talk as mien tracks it, as people's avatars are. All are scored in front and at 20 degrees.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import fmean
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from mien.avatar.avatar import Avatar
from mien.camera import Camera
from mien.evaluation.scoring import PART_SIDE, ScoreSettings, as_8_bit, enlarged, perceptual_metric
from mien.face.params import FaceParams
from mien.lab.benchmarking.comparing import known, markdown
from mien.lab.synthetic.anatomy import BROWS_LOWER, BROWS_UPPER, LIPS_INNER, LIPS_OUTER, LOWER_LIDS, UPPER_LIDS
from mien.lab.synthetic.posing import head_pose
from mien.lab.synthetic.scene import SyntheticScene
from mien.lab.synthetic.truth import Truth
from mien.machine.parallel import stream_in_threads
from mien.machine.progress import track_progress
from mien.render import rasterize
from mien.render.mesh import rasterize_mesh
from mien.rotation import matrix_from_axis_angle

REGIONS = ("glasses", "teeth", "mouth", "lids", "brows", "cheeks", "rest")
"""The regions of a face. A pixel belongs to the first that it is in."""
# The face's outline as a contour. `mien.tracking.landmarks.groups.OVAL` has the same points without an order.
_OVAL = (10, 338, 297, 332, 284, 251, 389, 356, 454, 323, 361, 288, 397, 365, 379, 378, 400, 377,
         152, 148, 176, 149, 150, 136, 172, 58, 132, 93, 234, 127, 162, 21, 54, 103, 67, 109)  # fmt: skip
_CHEEKS = ((117, 118, 119, 120, 100, 142, 36, 205, 187, 123), (346, 347, 348, 349, 329, 371, 266, 425, 411, 352))
_MOVES = 2.0  # mean change of a region's true picture from the face at rest, in grey levels, from which it moves
_LEAST_PIXELS = 24  # of a region that is scored
_SHOWN = (
    "rest", "browDownLeft", "browInnerUp", "eyeBlinkLeft", "eyeWideLeft", "jawOpen", "mouthFunnel", "mouthPucker",
    "mouthSmileLeft", "noseSneerRight", "smile", "laugh", "surprise", "wink", "kiss", "anger", "sadness", "disgust",
    "open mouth, brows up", "smile, brows down",
)  # fmt: skip
"""Faces of the sheet."""
_TILE, _COLUMNS = 128, 10

Drawing = Callable[[FaceParams, Camera], Float[Tensor, "h w 3"]]
"""Draws one timestep."""
Figures = dict[str, dict[str, Any]]
"""`psnr`, `perceptual`, `faces` and `cross_talk` by region."""


@dataclass(frozen=True, eq=False)
class PosedPictures:
    """True pictures of faces by `posed_faces`, the first at rest."""

    names: tuple[str, ...]
    images: UInt8[np.ndarray, "t c h w 3"]
    truth: Truth
    glasses: tuple[Bool[np.ndarray, "h w"] | None, ...]
    """Masks of the glasses' frame as each camera sees it. Glasses do not move. None if there are none."""

    def target(self, timestep: int, camera: int) -> Float[Tensor, "h w 3"]:
        """A true picture."""
        return torch.from_numpy(np.array(self.images[timestep, camera])).float() / 255


@torch.no_grad()
def as_avatar_has_it(avatar: Avatar, pictures: PosedPictures) -> PosedPictures:
    """The pictures with the faces of an avatar that was trained on a tracking, and with cameras in its world.

    A face has the avatar's coefficients at rest and what the true one adds to its own. The head stays where the avatar
    has it at rest, and cameras see it as its landmarks at rest fit the true ones best in the front picture.
    """
    true, model, rest = pictures.truth.tracking, avatar.face_model, avatar.subject
    front, marks = true.cameras[0], model.landmark_positions(model.head_vertices(rest)[0], "mediapipe")
    turn, place = cv2.solvePnP(
        marks.double().numpy(), pictures.truth.landmarks[0, 0].astype(np.float64), front.K.double().numpy(), None,
    )[1:]  # fmt: skip
    seen = torch.eye(4, dtype=torch.float64)  # of the head in the front camera
    seen[:3, :3], seen[:3, 3] = matrix_from_axis_angle(torch.from_numpy(turn[:, 0])), torch.from_numpy(place[:, 0])
    to_world = front.viewmat.double().inverse() @ seen @ rest.T_world_head[0].double().inverse()
    cameras = tuple(replace(one, viewmat=(one.viewmat.double() @ to_world).float()) for one in true.cameras)
    still = rest[[0] * len(true.face)]
    low, high = model.expression_bounds.unbind(1)
    face = replace(
        still,
        expression=(still.expression + true.face.expression - true.face.expression[0]).clamp(low, high),
        joints=still.joints + true.face.joints - true.face.joints[0],
    )
    return replace(pictures, truth=replace(pictures.truth, tracking=replace(true, face=face, cameras=cameras)))


def score_unfilmed(
    avatar: Avatar, pictures: PosedPictures, settings: ScoreSettings
) -> tuple[Figures, UInt8[np.ndarray, "h w 3"]]:
    """Figures by region, and a sheet of some faces in front: true pictures above those of the avatar.

    A region is scored at the faces that move it. Its `cross_talk` is the mean change of the avatar's picture from rest
    at all other faces, relative to that at the faces that move it.
    """

    def draw(face: FaceParams, camera: Camera) -> Float[Tensor, "h w 3"]:
        return rasterize(avatar.pose(face).gaussians.timestep(0), camera, torch.ones(3)).image.clamp(0, 1)

    return score_drawings(draw, pictures, settings)


@torch.no_grad()
def score_drawings(
    draw: Drawing, pictures: PosedPictures, settings: ScoreSettings
) -> tuple[Figures, UInt8[np.ndarray, "h w 3"]]:
    """The same by what draws the avatar with a face, as a camera sees it, over white."""
    metric, cameras = perceptual_metric(settings), pictures.truth.tracking.cameras
    jobs = [(timestep, camera) for camera in range(len(cameras)) for timestep in range(len(pictures.names))]

    drawn: dict[tuple[int, int], Float[Tensor, "h w 3"]] = {}
    for timestep, camera in track_progress(jobs, "unfilmed faces", len(jobs)):
        drawn[timestep, camera] = as_8_bit(draw(pictures.truth.tracking.face[timestep], cameras[camera]))

    def score(job: tuple[int, int]) -> Iterator[tuple[str, bool, float, float, float | None]]:
        timestep, camera = job
        image, target = drawn[timestep, camera], pictures.target(timestep, camera)
        still, rest = drawn[0, camera], pictures.target(0, camera)
        for region, mask in _masks(pictures, timestep, camera).items():
            if mask.sum() < _LEAST_PIXELS:
                continue
            inside = torch.from_numpy(mask)
            moves = 255 * float((target - rest)[inside].abs().mean()) > _MOVES
            change = 255 * float((image - still)[inside].abs().mean())
            error = float((image - target)[inside].square().mean())
            distance = _distance(metric, image, target, mask) if moves and metric is not None else None
            yield region, moves, change, -10 * float(np.log10(max(error, 1e-10))), distance

    scored = [job for job in jobs if job[0]]
    rows = [row for each in stream_in_threads(lambda job: list(score(job)), scored, settings.threads or None)
            for row in each]  # fmt: skip
    return _figures(rows), _sheet(pictures, drawn)


def _figures(rows: Sequence[tuple[str, bool, float, float, float | None]]) -> Figures:
    figures: Figures = {}
    for region in REGIONS:
        moved = [row for row in rows if row[0] == region and row[1]]
        others = [row[2] for row in rows if row[0] == region and not row[1]]
        if not moved:
            continue
        distances = [row[4] for row in moved if row[4] is not None]
        own = fmean(row[2] for row in moved)
        figures[region] = {
            "psnr": fmean(row[3] for row in moved), "perceptual": fmean(distances) if distances else None,
            "faces": len(moved), "cross_talk": fmean(others) / own if others and own > 0 else None,
        }  # fmt: skip
    return figures


def glasses_masks(scene: SyntheticScene) -> tuple[Bool[np.ndarray, "h w"] | None, ...]:
    """Masks of the glasses' frame as each camera sees it, in a scene whose head does not move. None without glasses."""
    glasses = scene.subject.glasses
    if glasses is None:
        return (None,) * len(scene.cameras)
    pose = torch.from_numpy(head_pose(scene.face[0]))
    vertices, faces = torch.from_numpy(glasses.frame.vertices).float(), torch.from_numpy(glasses.frame.faces)
    seen = [rasterize_mesh(vertices, faces, camera.in_frame(pose)).face_index.numpy() >= 0 for camera in scene.cameras]
    return tuple(cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool) for mask in seen)


def unfilmed_table(name: str, key: str, figures: Mapping[str, Figures]) -> str:
    """A table of the regions, with a column for each run."""
    heads = [f"{name} (`{key}`)", *(f"{run}: PSNR / ST-LPIPS, cross-talk" for run in figures)]
    rows = []
    for region in [one for one in REGIONS if any(one in own for own in figures.values())]:
        cells = [
            f"{own[region]['psnr']:.2f} / {known(own[region]['perceptual'])}, {known(own[region]['cross_talk'])}"
            for own in figures.values()
        ]
        rows.append((region, *cells))
    over = [means(own) for own in figures.values()]
    rows.append(("mean", *(f"{one['psnr']:.2f} / {known(one['perceptual'])}" for one in over)))
    return markdown(heads, rows)


def means(figures: Figures) -> dict[str, float | None]:
    """The means of PSNR and ST-LPIPS over the regions."""
    known = [own["perceptual"] for own in figures.values() if own["perceptual"] is not None]
    return {"psnr": fmean(own["psnr"] for own in figures.values()), "perceptual": fmean(known) if known else None}


def _distance(metric: Any, image: Tensor, target: Tensor, mask: Bool[np.ndarray, "h w"]) -> float:
    """ST-LPIPS of a region: pixels outside are those of the target."""
    left, top, width, height = cv2.boundingRect(mask.astype(np.uint8))
    box = (slice(top, top + height), slice(left, left + width))
    mixed = torch.where(torch.from_numpy(mask)[..., None], image, target)
    one, other = (metric.features(enlarged(each[box].contiguous(), PART_SIDE)) for each in (mixed, target))
    return metric.between(one, other)


def _masks(pictures: PosedPictures, timestep: int, camera: int) -> Mapping[str, Bool[np.ndarray, "h w"]]:
    """Masks of the regions, at the face and at rest together, since what is left behind counts as well."""
    size = pictures.images.shape[2:4]
    marks = [pictures.truth.landmarks[moment, camera] for moment in (0, timestep)]
    eye = float(np.linalg.norm(marks[0][33] - marks[0][133]))
    areas: dict[str, Bool[np.ndarray, "h w"]] = {}
    taken = np.zeros(size, bool)
    glasses = pictures.glasses[camera]
    if glasses is not None:
        areas["glasses"] = glasses
        taken |= glasses
    sides = ("right", "left")
    outlines: dict[str, tuple[list[tuple[int, ...]], float]] = {
        "teeth": ([LIPS_INNER], 0.0),
        "mouth": ([LIPS_OUTER], 0.2),
        "lids": ([UPPER_LIDS[side] + LOWER_LIDS[side][::-1] for side in sides], 0.25),
        "brows": ([BROWS_UPPER[side] + BROWS_LOWER[side][::-1] for side in sides], 0.2),
        "cheeks": ([*_CHEEKS], 0.0),
        "rest": ([_OVAL], 0.0),
    }
    for name, (polygons, margin) in outlines.items():
        area = np.zeros(size, np.uint8)
        for points in marks:
            for polygon in polygons:
                cv2.fillPoly(area, [np.round(points[list(polygon)] * 16).astype(np.int32)], 1, cv2.LINE_8, 4)
        if margin:
            width = 2 * max(1, round(margin * eye)) + 1
            area = cv2.dilate(area, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width)))
        areas[name] = area.astype(bool) & ~taken
        taken |= areas[name]
    return areas


def _sheet(pictures: PosedPictures, drawn: Mapping[tuple[int, int], Tensor]) -> np.ndarray:
    """True faces above the avatar's, in front."""
    oval = pictures.truth.landmarks[0, 0][list(_OVAL)]
    middle, half = oval.mean(0), 0.62 * float(np.ptp(oval[:, 1]))
    rows, columns = (slice(max(int(c - half), 0), int(c + half)) for c in middle[::-1])

    def tile(image: Tensor) -> np.ndarray:
        return cv2.resize((255 * image[rows, columns]).byte().numpy(), (_TILE, _TILE), interpolation=cv2.INTER_AREA)

    shown = [pictures.names.index(name) for name in _SHOWN if name in pictures.names]
    tiles = [np.concatenate([tile(pictures.target(timestep, 0)), tile(drawn[timestep, 0])]) for timestep in shown]
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % _COLUMNS)
    return np.concatenate([np.concatenate(tiles[at : at + _COLUMNS], 1) for at in range(0, len(tiles), _COLUMNS)])
