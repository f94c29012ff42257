"""The protocol `unseen_view`: an avatar of one front camera against true pictures of the person from all sides."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from mien.camera import Box, Camera
from mien.capture.capture import Capture
from mien.evaluation.experiment import Experiment
from mien.evaluation.metrics import crop_to
from mien.evaluation.scoring import Scores, ScoreSettings, as_8_bit, mean_scores, perceptual_metric, score_pictures
from mien.lab.synthetic.recipe import SIDES
from mien.lab.synthetic.truth import Truth
from mien.machine.parallel import stream_in_threads
from mien.machine.progress import track_progress
from mien.pages.pages import Axes, Series, write_chart
from mien.render import rasterize
from mien.render.mesh import render_mesh
from mien.tracking.neck_cut import NeckParts
from mien.tracking.scoring import head_crop, head_cutter
from mien.training.footage.coverage import measure_coverage
from mien.training.footage.foreground import foreground_colors
from mien.training.footage.frames import Footage
from mien.training.footage.sequence import composite
from mien.training.whole_head.completion import complete_colors, vertex_means

AVATAR, MESH = "avatar", "mesh"
Figures = dict[str, dict[str, Any]]
"""Mean figures (`mean_scores`) by angle and by what is scored."""


@dataclass(frozen=True, eq=False)
class SidePictures:
    """True pictures of one sequence from the front and from `SIDES`, at some of its timesteps."""

    capture: Capture
    """The pictures and exact mattes of all cameras; the first one is in front."""
    truth: Truth
    timesteps: tuple[int, ...]
    """The timestep of the sequence that each picture shows."""


_Job = tuple[dict[str, Tensor], Tensor, Box]
"""Pictures to score, the truth, and the head crop."""


def angle_names() -> list[str]:
    """The name of each camera's row, the front camera's first, such as `15` for both cameras 15 degrees to the side."""
    names = ["front"]
    for azimuth, elevation in SIDES.values():
        upright = "above" if elevation > 0 else "below"
        names.append(f"{abs(azimuth):g}" if elevation == 0 else f"{upright} {abs(elevation):g}")
    return names


@dataclass(frozen=True, eq=False)
class Front:
    """The front camera at one moment, as it truly is and as the tracking has it, and the head in front of both."""

    true: Camera
    tracked: Camera
    true_middle: Float[np.ndarray, " 3"]
    """Middle of the true face or head in the true world, in metres."""
    tracked_middle: Float[np.ndarray, " 3"]
    """Middle of the tracked face or head in the tracking's world, in its metres."""

    @property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """The rotation from the true world to that of the tracking: both cameras look the same way."""
        true, own = (one.viewmat[:3, :3].double().numpy() for one in (self.true, self.tracked))
        return own.T @ true

    @property
    def scale(self) -> float:
        """Size of the tracking's metres in the front picture, as a share of that of true metres."""
        true, own = (
            one.K[0, 0].item() / _before(one, middle)[2]
            for one, middle in ((self.true, self.true_middle), (self.tracked, self.tracked_middle))
        )
        return own / true

    def behind(self, ahead: Float[np.ndarray, " 3"]) -> "Front":
        """Return this front camera with both middles moved from that of the face to that of the head, 8 cm behind.

        The true head looks `ahead` in the true world.
        """
        back = -0.08 * ahead
        return replace(
            self,
            true_middle=self.true_middle + back,
            tracked_middle=self.tracked_middle + self.rotation @ back / self.scale,
        )


def camera_beside(camera: Camera, front: Front) -> Camera:
    """A true camera in the world of a tracking, which sees the avatar as it sees the person.

    Cameras stand beside each other as they truly do: their rotations relative to the front camera are exact. The front
    camera itself becomes the tracking's own, so that the avatar is seen from the front as it was trained. The middle of
    the head therefore has the tracked place and size in the front picture, and a camera aside has the same distance
    from it relative to the front camera's. Focal lengths and principal points differ from the true ones as the front
    camera's do.

    A similarity that aligns the tracked vertices with the true ones would do for a perfect shape. But vertices that are
    off by a millimetre along the skin make it half a percent too large or small, and shift it by a quarter of a pixel.
    """
    side, true = (one.viewmat.double().numpy() for one in (camera, front.true))
    lens, true_lens, tracked_lens = (one.K.double().numpy() for one in (camera, front.true, front.tracked))
    near, far = _before(front.tracked, front.tracked_middle), _before(front.true, front.true_middle)
    # The point at the true distance that the true front camera sees where the tracking sees the head.
    pixel = tracked_lens @ near / near[2]
    point = true[:3, :3].T @ (np.linalg.solve(true_lens, pixel) * far[2] - true[:3, 3])
    own_lens = lens.copy()
    own_lens[[0, 1], [0, 1]] *= (tracked_lens.diagonal() / true_lens.diagonal())[:2]
    own_lens[:2, 2] += (tracked_lens - true_lens)[:2, 2]
    place = np.linalg.solve(own_lens, lens @ _before(camera, point)) * near[2] / far[2]
    moved = np.eye(4)
    moved[:3, :3] = side[:3, :3] @ front.rotation.T
    moved[:3, 3] = place - moved[:3, :3] @ front.tracked_middle
    view = torch.from_numpy(moved).to(camera.viewmat)
    return replace(camera, K=torch.from_numpy(own_lens).to(camera.K), viewmat=view)


def _before(camera: Camera, point: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """A point of the world in a camera's frame."""
    view = camera.viewmat.double().numpy()
    return view[:3, :3] @ point + view[:3, 3]


@torch.no_grad()
def score_side_views(
    experiment: Experiment, sequence: str, pictures: SidePictures, settings: ScoreSettings
) -> tuple[Figures, Float[np.ndarray, "h w 3"]]:
    """Figures by angle for the avatar and the mesh in completed colours, and a sheet: truth, avatar, mesh by angle.

    The pictures show a sequence of the experiment. They are cut and cropped as in every other protocol: over white,
    above the cut at the neck of the posed head. An avatar is posed as in `experiment`, and seen by the true cameras as
    they stand beside the front camera (`camera_beside`). ST-LPIPS is computed for one of `settings.perceptual_frames`
    moments per camera.
    """
    moments, threads = len(pictures.timesteps), settings.threads or None
    index = [one.name for one in experiment.sequences].index(sequence)
    colors, neck = _completed_colors(experiment, threads), NeckParts.of(experiment.avatar.face_model)
    metric = perceptual_metric(settings)
    # The moments for which ST-LPIPS is computed: evenly spread; all with 0.
    judged = range(0, moments, max(1, -(-moments // settings.perceptual_frames)) if settings.perceptual_frames else 1)
    shown: list[np.ndarray] = []

    def jobs() -> Iterator[tuple[int, int, _Job]]:
        views = [(camera, moment) for camera in range(len(SIDES) + 1) for moment in range(moments)]
        for camera, moment in track_progress(views, "unseen views", len(views)):
            job = _job(experiment, index, pictures, (colors, neck), camera, moment)
            if moment == moments // 2:
                tiles = [in_white_square(crop_to(image, job[2]), 160) for image in (job[1], *job[0].values())]
                shown.append(np.concatenate(tiles, 0))
            yield camera, moment, job

    def score(job: tuple[int, int, _Job]) -> tuple[str, dict[str, Scores]]:
        camera, moment, (images, target, crop) = job
        eight = {name: as_8_bit(image) for name, image in images.items()}
        return angle_names()[camera], score_pictures(eight, target, crop, metric if moment in judged else None)

    rows: dict[str, list[dict[str, Scores]]] = {}
    for angle, scores in stream_in_threads(score, jobs(), threads):
        rows.setdefault(angle, []).append(scores)
    figures = {
        angle: {name: mean_scores([row[name] for row in own]) for name in (AVATAR, MESH)} for angle, own in rows.items()
    }
    return figures, np.concatenate(shown, 1)


def _job(
    experiment: Experiment, index: int, pictures: SidePictures, shared: tuple[Float[Tensor, "v 3"], NeckParts],
    camera: int, moment: int,
) -> _Job:  # fmt: skip
    """Draw the avatar and the mesh of a sequence as a camera sees them at a moment, beside the true picture.

    All jobs share the completed colours of the mesh and the parts of its neck.
    """
    colors, neck = shared
    model, truth, timestep = experiment.avatar.face_model, pictures.truth, pictures.timesteps[moment]
    tracking, used = experiment.sequences[index].tracking, experiment.faces[index][timestep]
    points = model(tracking.face[timestep])[0].numpy()[truth.vertex_index].astype(np.float64)
    cameras = truth.tracking.cameras
    true_points = truth.vertices_world[moment].astype(np.float64)
    face = Front(cameras[0], tracking.cameras[0], true_points.mean(0), points.mean(0))
    ahead = truth.tracking.face[moment].T_world_head[0, :3, 2].double().numpy()
    view = camera_beside(cameras[camera], face.behind(ahead))
    matte, white = np.asarray(pictures.capture.mattes[moment, camera]), np.full(3, 255, np.uint8)
    mask = head_cutter(model, neck, used)(matte, view)
    colors_of_person = foreground_colors(np.asarray(pictures.capture.images[moment, camera]), matte)
    target = torch.from_numpy(composite(colors_of_person, mask, white)).float() / 255
    gaussians = experiment.avatar.pose(used).gaussians.timestep(0)
    images = {
        AVATAR: rasterize(gaussians, view, torch.ones(3)).image.clamp(0, 1),
        MESH: render_mesh(model(used)[0], model.faces, view, colors, supersample=2)[0].clamp(0, 1),
    }
    left, top, width, height = (int(value) for value in head_crop(mask))
    return images, target, (left, top, width, height)


def _completed_colors(experiment: Experiment, threads: int | None) -> Float[Tensor, "v 3"]:
    """Colours of the mesh from the training pictures, completed where they show none."""
    model = experiment.avatar.face_model
    found = measure_coverage(
        Footage(model, experiment.sequences, experiment.faces, experiment.training_frames), threads
    )
    neutral = model.head_vertices(experiment.avatar.subject)[0]
    return vertex_means(model, complete_colors(model, neutral, found.seen, found.colors))


def write_unseen_chart(path: Path, figures: Figures) -> None:
    """Write a .svg of the head crop's PSNR over the angle to the side."""
    level = {
        0 if label == "front" else int(label): row
        for label, row in figures.items()
        if label.isdigit() or label == "front"
    }
    angles = np.array(list(level), np.float64)
    series = [
        Series(subject, angles, np.array([row[subject]["head"]["psnr"] for row in level.values()]), style)
        for subject, style in ((AVATAR, "main"), (MESH, "second"))
    ]
    axes = Axes("degrees from the front camera", "dB")
    write_chart(path, [("Unseen views: PSNR of the head crop, dB", series, axes)])


def in_white_square(image: Float[Tensor, "h w 3"], side: int) -> UInt8[np.ndarray, "s s 3"]:
    """The picture in 8 bits, scaled into a white square of `side` pixels."""
    scale = side / max(image.shape[:2])
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    square = np.full((side, side, 3), 255, np.uint8)
    scaled = cv2.resize(np.asarray(image), size, interpolation=cv2.INTER_AREA)
    square[: size[1], : size[0]] = np.clip(np.rint(scaled * 255), 0, 255).astype(np.uint8)
    return square
