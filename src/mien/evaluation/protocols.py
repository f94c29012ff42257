"""Protocols with true pictures: the avatar and both baselines on the same held-out frames, by the same metrics."""

import contextlib
import json
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any, Literal

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mien import _native
from mien.avatar.avatar import frozen
from mien.avatar.settings import FaceTuning, Progress
from mien.disk.config import Range
from mien.disk.files import write_atomically
from mien.disk.reading import open_to_append, parse_json, read_bytes
from mien.evaluation.baselines import Baselines, look_at_trained, make_baselines
from mien.evaluation.dataset_protocols import dataset_protocol
from mien.evaluation.experiment import (
    DARK,
    WHITE,
    Edges,
    Experiment,
    avatar_image,
    drawn_image,
    moved,
    posed_avatar,
    scored_on,
    target_image,
    target_images,
)
from mien.evaluation.metrics import Border
from mien.evaluation.scoring import (
    PART_SIDE,
    PIXELS,
    SSIM_WINDOWS,
    Scores,
    ScoreSettings,
    as_8_bit,
    lpips_metric,
    mean_scores,
    perceptual_metric,
    score_pictures,
    worker_threads,
)
from mien.face.params import FaceParams
from mien.machine.devices import DeviceName, choose_device, like_on
from mien.machine.parallel import stream_in_threads
from mien.machine.progress import progress_bar
from mien.perceptual.lpips import load_lpips
from mien.render import rasterize
from mien.training.adam import Adam
from mien.training.footage.face_track import FaceTrack
from mien.training.footage.frames import Frame, spread_frames
from mien.training.losses import photometric_loss

AVATAR, AS_TRACKED, FITTED, MEAN_FRAME, MESH = "avatar", "as_tracked", "fitted", "mean_frame", "mesh"
OPENED, UNCLOTHED, OVER_DARK = "opened", "without_clothes", "over_dark"
_MAX_TRAINING_FRAMES = 200
_ALWAYS = {f"{part}{metric}" for part in ("", "head_") for metric in ("psnr", "ssim", "l1")}
"""Figures that every frame has."""
_MASKS = {
    "plane": "frozen scoring mask: matte cut at the neck, over white",
    "line": "frozen scoring mask: matte above the neck line of each picture, over white",
    "none": "frozen scoring mask: matte of the whole person, over white",
}
_MATTES = "the dataset's mattes, whole, over white"
_CROP = "frozen head box of each frame"
_PART_CROPS = f"boxes of the tracked mesh; enlarged to {PART_SIDE} pixels for ST-LPIPS if a side is shorter"
_FIT_LOSS = "mean absolute difference of colours over the whole picture"
_FIT_RATES = FaceTuning(within_bounds=True)
"""Learning rates for every method alike: those with which training corrects the tracking by default."""


@dataclass(frozen=True)
class EvaluationSettings(ScoreSettings):
    """Settings of a run's evaluation."""

    baselines: bool = True
    """Whether to score the mean training picture and the coloured mesh as well."""
    perceptual_of: Literal["all", "avatar"] = "all"
    """Whether ST-LPIPS and LPIPS judge baselines and faces as tracked as well, or the avatar alone, in less than half
    of the time."""
    video_frames: int = 600
    """Largest number of frames in each side-by-side video. 0 makes no videos."""
    pictures: bool = False
    """Whether to write every scored picture and its truth as png as well."""
    edges: Edges = "cleaned"
    """Colours of the truth at soft edges of the matte: cleaned of the background, or as filmed."""
    protocol: str | None = None
    """Name of the dataset protocol that counts (`DATASET_PROTOCOLS`). None for mien's scoring masks."""
    fit_faces: bool = False
    """Whether to score the avatar a third time, with expression and pose fitted to each held-out frame's picture."""
    fit_steps: Annotated[int, Range(1, 10_000)] = 20
    """Number of optimiser steps of that fit, for each timestep."""
    device: DeviceName = "cpu"
    """Device that draws the avatar."""

    @property
    def opened(self) -> bool:
        """Whether drawings are scored eroded and dilated as well, and without clothes."""
        return self.protocol is not None and dataset_protocol(self.protocol).opened

    def over_dark(self, experiment: Experiment) -> bool:
        """Whether the avatar is scored over a dark background as well. Datasets have none, and holes close over white.

        Only the colours of the person alone can be shown over another background than the filmed one.
        """
        return self.protocol is None and experiment.edges == "cleaned" and not experiment.avatar.extras.closing

    @property
    def border(self) -> Border:
        """Windows of SSIM at the border of a picture."""
        return "zeros" if self.protocol is None else dataset_protocol(self.protocol).border


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Every figure of every held-out frame."""

    frames: tuple[Frame, ...]
    scores: dict[str, tuple[Scores, ...]]
    """Figures by subject, with one entry per frame: `avatar`; `as_tracked`, if the avatar's faces are corrected;
    `fitted`, if asked for; `over_dark`, the avatar over dark blue; `opened` and `without_clothes`, if the protocol has
    them; and, with baselines, `mean_frame` and `mesh`."""
    seconds_per_frame: float
    """Median time to pose and render the avatar."""
    baselines: Baselines | None
    training_psnr: dict[Frame, tuple[float, float]]
    """PSNR on the whole frame and on the head crop of some training frames, evenly spread, for comparison."""

    def ranked(self) -> list[int]:
        """Indices into `frames`, from the worst PSNR of the avatar on the head crop to the best."""
        figures = [entry["head_psnr"] for entry in self.scores[AVATAR]]
        return sorted(range(len(figures)), key=figures.__getitem__)


Scored = tuple[dict[str, Scores], float]
"""A frame's figures by the scored subject, and the seconds that rendering the avatar took."""


@dataclass(frozen=True)
class PartialScores:
    """A file with one line per scored frame, after a first line with the fingerprint of the evaluation."""

    path: Path
    fingerprint: str
    """Identity of the evaluation. Figures of any other evaluation are dropped."""

    def read(self) -> dict[Frame, Scored]:
        """The frames that were scored before. Empty if the file is of another run or other settings, or is damaged.

        Cuts the file back to its good lines, because a killed process may leave half a line. Creates the file if
        needed.
        """
        good: list[str] = [json.dumps({"scores_of": self.fingerprint})]
        found: dict[Frame, Scored] = {}
        with contextlib.suppress(OSError, ValueError, LookupError, TypeError, AttributeError):
            first, *lines = read_bytes(self.path, 256 << 20).decode("utf-8", "replace").split("\n")
            for line in lines if first == good[0] else ():
                content = parse_json(line)
                rows: dict[str, Scores] = {
                    name: {key: float(row[key]) for key in row} for name, row in content["scores"].items()
                }
                found[Frame(*content["frame"])] = (rows, float(content["seconds"]))
                good.append(line)
        text = "\n".join(good) + "\n"
        write_atomically(self.path, lambda aside: aside.write_text(text, encoding="utf-8"))
        return found

    def add(self, frame: Frame, scores: Mapping[str, Scores], seconds: float) -> None:
        """Append one more frame."""
        line = json.dumps({"frame": list(frame), "scores": dict(scores), "seconds": seconds})
        with open_to_append(self.path) as file:
            file.write(line + "\n")

    def remove(self) -> None:
        """Delete the file, because the figures are in metrics.json now."""
        self.path.unlink(missing_ok=True)


def evaluate_frames(
    experiment: Experiment, settings: EvaluationSettings, partial: PartialScores | None = None, title: str = "evaluate"
) -> Evaluation:
    """Score every held-out frame. Rendering runs here, frame by frame; scoring runs in threads.

    `partial` has the figures that an interrupted evaluation has computed, and takes new ones.
    """
    assert experiment.held_out_frames, "nothing is held out"
    frames = experiment.held_out_frames
    subjects = {AVATAR} | ({AS_TRACKED} if experiment.face_source != "as_tracked" else set())
    subjects |= {FITTED} if settings.fit_faces else set()
    subjects |= {MEAN_FRAME, MESH} if settings.baselines else set()
    subjects |= {OPENED} if settings.opened else set()
    subjects |= {OVER_DARK} if settings.over_dark(experiment) else set()
    kept = partial.read() if partial is not None else {}
    done = {  # with all subjects, and every figure that each frame must have
        frame: scored
        for frame, scored in kept.items()
        if scored[0].keys() - {UNCLOTHED} == subjects and all(row.keys() >= _ALWAYS for row in scored[0].values())
    }
    metric, lpips = perceptual_metric(settings), lpips_metric(settings)
    perceptual_frames = set(spread_frames(frames, settings.perceptual_frames))
    threads = worker_threads(settings.threads)
    means, training_psnr = look_at_trained(experiment, _MAX_TRAINING_FRAMES, threads, mean=settings.baselines)
    baselines = make_baselines(experiment, threads, means) if settings.baselines else None
    fit_steps = settings.fit_steps if settings.fit_faces else 0

    def score(job: tuple[Frame, dict[str, Tensor], float]) -> tuple[Frame, dict[str, Scores], float]:
        frame, drawn, seconds = job
        pictures = {name: as_8_bit(picture) for name, picture in drawn.items()}
        dark = pictures.pop(OVER_DARK, None)
        truth, *over_dark = target_images(experiment, frame, (WHITE,) if dark is None else (WHITE, DARK))
        crop = experiment.crop(frame)
        judges = (metric, lpips) if frame in perceptual_frames else (None, None)
        parts, border = experiment.parts(frame), settings.border
        clothes = experiment.clothes_of(frame) if OPENED in pictures else None
        compared = None if settings.perceptual_of == "all" else (AVATAR,)
        scores = score_pictures(pictures, truth, crop, judges[0], parts, judges[1], border, compared)
        if dark is not None:
            scores |= score_pictures({OVER_DARK: dark}, over_dark[0], crop, None)
        if clothes is not None:
            bare = {UNCLOTHED: without(pictures[OPENED], clothes)}
            scores |= score_pictures(bare, without(truth, clothes), crop, judges[0], parts, judges[1], border)
        if frame in perceptual_frames:
            _native.release_memory()  # Maps of features leave holes, which would add up over the frames.
        return frame, scores, seconds

    with progress_bar(title, len(frames), len(done)) as advance:
        drawing = experiment if settings.device == "cpu" else moved(experiment, like_on(choose_device(settings.device)))
        jobs = drawn_frames(drawing, [frame for frame in frames if frame not in done], subjects, baselines, fit_steps)
        for frame, row, seconds in stream_in_threads(score, jobs, threads):
            done[frame] = row, seconds
            if partial is not None:
                partial.add(frame, row, seconds)
            advance(status=f"PSNR {fmean(r[AVATAR]['psnr'] for r, _ in done.values()):.2f}")
    rows = [done[frame][0] for frame in frames]
    # Sequences without masks of clothes have no figures without clothes.
    scores = {subject: tuple(row[subject] for row in rows if subject in row) for subject in _figure_names(rows)}
    seconds = sorted(done[frame][1] for frame in frames)
    return Evaluation(frames, scores, seconds[len(seconds) // 2], baselines, training_psnr)


def drawn_frames(
    experiment: Experiment,
    frames: list[Frame],
    subjects: set[str],
    baselines: Baselines | None,
    fit_steps: int,
) -> Iterator[tuple[Frame, dict[str, Tensor], float]]:
    """Yield each frame with its pictures to score, by name, and the seconds to pose and render the avatar.

    With `fit_steps`, the face of each timestep is also fitted to all of its held-out pictures, in so many steps.
    """
    fitted: dict[tuple[int, int], FaceParams] = {}
    as_tracked = None if experiment.face_source == "as_tracked" else _as_tracked(experiment)
    for frame in frames:
        start = time.perf_counter()
        posed = posed_avatar(experiment, frame)
        drawn = {AVATAR: drawn_image(experiment, frame, posed)}
        seconds = time.perf_counter() - start
        if as_tracked is not None:
            drawn[AS_TRACKED] = avatar_image(as_tracked, frame)
        if fit_steps:
            key = frame.sequence, frame.timestep
            if key not in fitted:
                together = [each for each in experiment.held_out_frames if (each.sequence, each.timestep) == key]
                fitted[key] = fit_face(experiment, together, fit_steps)
            drawn[FITTED] = avatar_image(experiment, frame, fitted[key])
        if OVER_DARK in subjects:
            drawn[OVER_DARK] = drawn_image(experiment, frame, posed, DARK)
        if OPENED in subjects:
            drawn[OPENED] = opened(drawn[FITTED if fit_steps else AVATAR])
        if baselines is not None:
            drawn[MEAN_FRAME] = baselines.mean_frame_image(experiment, frame)
            drawn[MESH] = baselines.mesh_image(experiment, frame)
        yield frame, drawn, seconds


def fit_face(experiment: Experiment, frames: list[Frame], steps: int) -> FaceParams:
    """Expression, joints, head rotation and head translation of one timestep, after some steps of Adam.

    MonoGaussianAvatar (Chen et al. 2024, supplement B.4) is scored in this way. The figure shows what the avatar can
    draw if its tracking is right. It uses the pixels that are scored, so it is no figure of a prediction.

    `frames` are those of one timestep, from different cameras, and are fitted together. The start are the face
    parameters of the headline. The loss is the mean absolute difference of colours, summed over the frames. Expression
    coefficients stay within the bounds of the face model, or where the tracking left them.
    """
    avatar = experiment.avatar
    targets = [(frame, target_image(experiment, frame)) for frame in frames]
    track = FaceTrack(experiment.face(frames[0]), _FIT_RATES, bounds=avatar.face_model.expression_bounds)
    adam = Adam()
    with torch.enable_grad(), frozen(avatar):
        for step in range(steps):
            gaussians = avatar.pose(track.face(0)).gaussians.timestep(0)
            white = torch.ones(3).to(gaussians.means)
            drawn = [(frame, rasterize(gaussians, experiment.camera(frame), white)) for frame, _ in targets]
            images = [experiment.lit(picture, white, frame).image for frame, picture in drawn]
            losses = [
                photometric_loss(image, target, l1_weight=1.0, ssim_weight=0.0)
                for image, (_, target) in zip(images, targets, strict=True)
            ]
            torch.autograd.backward(losses)
            adam.step(track.parameter_groups(0), Progress(step, steps))
            track.confine(0)
    return track.face(0).detach()


def opened(picture: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """The picture eroded and then dilated by 3x3 pixels, each channel by itself, as MonoGaussianAvatar scores it."""
    return torch.from_numpy(cv2.morphologyEx(picture.numpy(), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)))


def without(picture: Float[Tensor, "h w 3"], clothes: Bool[np.ndarray, "h w"]) -> Float[Tensor, "h w 3"]:
    """The picture with clothes painted white."""
    return torch.where(torch.from_numpy(clothes)[..., None], 1.0, picture)


def _as_tracked(experiment: Experiment) -> Experiment:
    """The experiment with the motion as the tracker left it. Identity and offsets stay those of training."""
    tracked = (
        replace(sequence.tracking.face, identity=used.identity, vertex_offsets=used.vertex_offsets)
        for sequence, used in zip(experiment.sequences, experiment.faces, strict=True)
    )
    return replace(experiment, faces=tuple(tracked))


def protocol_content(experiment: Experiment, evaluation: Evaluation, settings: EvaluationSettings) -> dict[str, Any]:
    """The protocol's entry of metrics.json: means over frames, how they were computed, and every frame's figures."""
    scores, frames = evaluation.scores, evaluation.frames
    own_rows = scores[AVATAR]
    cuts = sorted({_MASKS[experiment.scorings[frame.sequence].cut] for frame in frames})
    clear = [sequence.clear() for sequence in experiment.sequences]
    covered = sum(not clear[frame.sequence][frame.timestep, frame.camera] for frame in frames)
    trained, trained_head = zip(*evaluation.training_psnr.values(), strict=True)
    further: dict[str, Any] = {name: mean_scores(scores[name]) for name in (OVER_DARK, FITTED) if name in scores}
    if OVER_DARK in further:
        further[OVER_DARK]["color"] = list(DARK)
    if FITTED in further:
        further[FITTED]["fit"] = {"steps": settings.fit_steps, "loss": _FIT_LOSS}
    for name in (OPENED, UNCLOTHED):
        if name in scores:
            further[name] = {**mean_scores(scores[name]), "frames": len(scores[name])}
    return {
        **mean_scores(own_rows),
        "perceptual_backbone": settings.backbone if settings.perceptual else None,
        "perceptual_frames": sum("perceptual" in row for row in own_rows),
        **({} if settings.lpips_weights is None else {"lpips_backbone": load_lpips(settings.lpips_weights).backbone}),
        "split": experiment.split,
        "mask": _MATTES if experiment.whole_mattes else "; ".join(cuts),
        **({} if settings.protocol is None else {"dataset_protocol": settings.protocol}),
        "edges": experiment.edges,
        "crop": _CROP,
        "part_crops": _PART_CROPS,
        "ssim_window": SSIM_WINDOWS[settings.border],
        "pixels": PIXELS,
        "face_params": experiment.face_source,
        "frames": len(frames),
        **({"covered_frames": covered} if covered else {}),
        "sequences": sorted({experiment.sequences[frame.sequence].name for frame in frames}),
        "camera_ids": sorted({experiment.camera_id(frame) for frame in frames}),
        "scored_on": scored_on(experiment, frames),
        "seconds_per_frame": evaluation.seconds_per_frame,
        "training_frames": {"psnr": fmean(trained), "head": {"psnr": fmean(trained_head)}, "frames": len(trained)},
        "baselines": {name: mean_scores(scores[name]) for name in (MEAN_FRAME, MESH) if name in scores},
        "as_tracked": mean_scores(scores.get(AS_TRACKED, own_rows)),
        **further,
        "per_frame": {
            "sequence": [experiment.sequences[frame.sequence].name for frame in frames],
            "timestep": [frame.timestep for frame in frames],
            "camera_id": [experiment.camera_id(frame) for frame in frames],
            **{
                name: [round(row[name], 5) if name in row else None for row in own_rows]
                for name in _figure_names(own_rows)
            },
        },
    }


def _figure_names(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The names of all figures that any frame has. A frame in which the eyes are not seen has no figures of them."""
    return list(dict.fromkeys(name for row in rows for name in row))
