"""Self-reenactment on held-out frames: the avatar and both baselines, on the same frames, by the same metrics."""

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from statistics import fmean
from typing import Any, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from mien.evaluation.baselines import Baselines, make_baselines
from mien.evaluation.experiment import Experiment, Frame, avatar_image, target_image
from mien.evaluation.metrics import Box, crop_to, l1, psnr, ssim
from mien.evaluation.perceptual import MINIMUM_SIZE, Backbone, PerceptualDistance, load_perceptual
from mien.progress import progress_bar

AVATAR, AS_TRACKED, MEAN_FRAME, MESH = "avatar", "as_tracked", "mean_frame", "mesh"
METRICS = ("psnr", "ssim", "l1", "perceptual")
_TRAINING_FRAMES = 200
_MASK = "frozen scoring mask: matte cut below the neck line, over white"
_CROP = "frozen head box of each frame"
_SSIM = "11x11 Gaussian window, sigma 1.5, zeros beyond the border"

Item = TypeVar("Item")
Result = TypeVar("Result")
Scores = Mapping[str, float]
"""`psnr`, `ssim`, `l1`, `perceptual` and the same with `head_` in front."""


@dataclass(frozen=True)
class EvaluationSettings:
    """How to evaluate; the figures do not depend on `threads`."""

    perceptual: bool = True
    """Whether to compute ST-LPIPS, which takes most of the time."""
    perceptual_frames: int = 32
    """ST-LPIPS is computed on at most this many held-out frames, evenly spread: 3 s each at 512x512; 0 for all."""
    baselines: bool = True
    """Also score the mean training picture and the coloured mesh."""
    threads: int = 2
    """Frames scored at a time."""
    backbone: Backbone = "st-lpips-alex"
    """Network of the perceptual metric."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Every figure of every held-out frame."""

    frames: tuple[Frame, ...]
    scores: dict[str, tuple[Scores, ...]]
    """By what was scored: `avatar`; if its faces are not as tracked, `as_tracked` with those; and with baselines
    `mean_frame` and `mesh`; one entry a frame."""
    seconds_per_frame: float
    """Posing and rendering the avatar, the median."""
    baselines: Baselines | None
    training_psnr: dict[Frame, tuple[float, float]]
    """Whole frame and head crop of some training frames, evenly spread: how much worse the held-out ones are."""

    def mean(self, subject: str, name: str) -> float:
        """The mean of one figure over the frames that have it."""
        return fmean(entry[name] for entry in self.scores[subject] if name in entry)

    def ranked(self) -> list[int]:
        """Indices into `frames` from the worst PSNR of the avatar on the head crop to the best."""
        figures = [entry["head_psnr"] for entry in self.scores[AVATAR]]
        return sorted(range(len(figures)), key=figures.__getitem__)


def evaluate_frames(experiment: Experiment, settings: EvaluationSettings) -> Evaluation:
    """Score every held-out frame. Rendering is done here, one frame after the other; scoring in `settings.threads`."""
    assert experiment.held_out_frames, "nothing is held out"
    metric = load_perceptual(settings.backbone) if settings.perceptual else None
    baselines = make_baselines(experiment) if settings.baselines else None
    as_tracked = None if experiment.face_source == "as_tracked" else _as_tracked(experiment)
    seconds: list[float] = []
    frames = experiment.held_out_frames
    judged = _evenly_spread(frames, settings.perceptual_frames)

    def pictures(frame: Frame) -> dict[str, Tensor]:
        start = time.perf_counter()
        drawn = {AVATAR: avatar_image(experiment, frame)}
        seconds.append(time.perf_counter() - start)
        if as_tracked is not None:
            drawn[AS_TRACKED] = avatar_image(as_tracked, frame)
        if baselines is not None:
            drawn[MEAN_FRAME] = baselines.mean_frame_image(experiment, frame)
            drawn[MESH] = baselines.mesh_image(experiment, frame)
        return drawn

    def score(job: tuple[Frame, dict[str, Tensor]]) -> dict[str, Scores]:
        frame, drawn = job
        return score_pictures(
            drawn, target_image(experiment, frame), experiment.crop(frame), metric if frame in judged else None
        )

    rows: list[dict[str, Scores]] = []
    with progress_bar("evaluate", len(frames)) as advance:
        jobs = ((frame, pictures(frame)) for frame in frames)
        for row in _in_threads(score, jobs, settings.threads):
            rows.append(row)
            advance(status=f"PSNR {fmean(r[AVATAR]['psnr'] for r in rows):.2f}")
    scores = {subject: tuple(row[subject] for row in rows) for subject in rows[0]}
    seen = _training_psnr(experiment)
    return Evaluation(frames, scores, sorted(seconds)[len(seconds) // 2], baselines, seen)


def _as_tracked(experiment: Experiment) -> Experiment:
    """The same with the faces that the tracker left."""
    return replace(experiment, faces=tuple(sequence.tracking.face for sequence in experiment.sequences))


def _training_psnr(experiment: Experiment) -> dict[Frame, tuple[float, float]]:
    """PSNR on the whole frame and on the head crop of at most `_TRAINING_FRAMES` frames that were trained on."""
    figures = {}
    for frame in sorted(_evenly_spread(experiment.training_frames, _TRAINING_FRAMES)):
        image, target = avatar_image(experiment, frame), target_image(experiment, frame)
        figures[frame] = (psnr(image, target), psnr(image, target, experiment.crop(frame)))
    return figures


@torch.no_grad()
def score_pictures(
    pictures: Mapping[str, Float[Tensor, "h w 3"]],
    target: Float[Tensor, "h w 3"],
    crop: Box,
    metric: PerceptualDistance | None,
) -> dict[str, Scores]:
    """The figures of several pictures against one target, on the whole frame and on the head crop."""
    rows: dict[str, dict[str, float]] = {name: {} for name in pictures}
    for prefix, box in (("", None), ("head_", crop)):
        cut = crop_to(target, box)
        small = min(cut.shape[:2]) < MINIMUM_SIZE
        reference = metric.features(cut) if metric is not None and not small else None
        for name, picture in pictures.items():
            image, row = crop_to(picture, box), rows[name]
            row[f"{prefix}psnr"], row[f"{prefix}ssim"] = psnr(image, cut), ssim(image, cut)
            row[f"{prefix}l1"] = l1(image, cut)
            if metric is not None and reference is not None:
                row[f"{prefix}perceptual"] = metric.between(metric.features(image), reference)
    return dict(rows)


def protocol_content(experiment: Experiment, evaluation: Evaluation, settings: EvaluationSettings) -> dict[str, Any]:
    """The protocol's entry of metrics.json: means over frames, how they were made, and every frame's figures."""
    own_rows = evaluation.scores[AVATAR]
    return {
        **_means(evaluation, AVATAR),
        "perceptual_backbone": settings.backbone if settings.perceptual else None,
        "perceptual_frames": sum("perceptual" in row for row in own_rows),
        "split": experiment.split,
        "mask": _MASK,
        "crop": _CROP,
        "ssim_window": _SSIM,
        "face_params": experiment.face_source,
        "frames": len(evaluation.frames),
        "seconds_per_frame": evaluation.seconds_per_frame,
        "training_frames": _training_means(evaluation),
        "baselines": {name: _means(evaluation, name) for name in (MEAN_FRAME, MESH) if name in evaluation.scores},
        "as_tracked": _means(evaluation, AS_TRACKED if AS_TRACKED in evaluation.scores else AVATAR),
        "per_frame": {
            "sequence": [experiment.sequences[frame.sequence].name for frame in evaluation.frames],
            "timestep": [frame.timestep for frame in evaluation.frames],
            "camera_id": [experiment.camera_id(frame) for frame in evaluation.frames],
            **{name: [_rounded(row.get(name)) for row in own_rows] for name in own_rows[0]},
        },
    }


def _training_means(evaluation: Evaluation) -> dict[str, Any]:
    """What the avatar reaches on frames that it was trained on: the gap to the protocol's figures is generalisation."""
    whole, head = zip(*evaluation.training_psnr.values(), strict=True)
    return {"psnr": fmean(whole), "head": {"psnr": fmean(head)}, "frames": len(whole)}


def _means(evaluation: Evaluation, subject: str) -> dict[str, Any]:
    """Mean figures; None for a metric that was left out."""
    known = set().union(*evaluation.scores[subject])

    def means(prefix: str) -> dict[str, float | None]:
        names = {name: prefix + name for name in METRICS}
        return {name: evaluation.mean(subject, key) if key in known else None for name, key in names.items()}

    return {**means(""), "head": means("head_")}


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 5)


def _evenly_spread(frames: tuple[Frame, ...], most: int) -> set[Frame]:
    """At most `most` of the frames, the first always among them; 0 for all."""
    step = max(1, -(-len(frames) // most)) if most else 1
    return set(frames[::step])


def _in_threads(function: Callable[[Item], Result], items: Iterable[Item], threads: int) -> Iterator[Result]:
    """Results in order; at most two items a thread are prepared ahead, so that memory stays small."""
    with ThreadPoolExecutor(threads) as pool:
        waiting: deque[Future[Result]] = deque()
        for item in items:
            waiting.append(pool.submit(function, item))
            if len(waiting) >= 2 * threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
