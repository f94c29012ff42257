"""Held-out sequences tracked apart: what other sequences show of the person stays, and only the motion is fitted."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from mien.tracking.descent.schedule import follow_by_descent
from mien.tracking.fitting.fit import Fit, Watch
from mien.tracking.fitting.resume import StageCache
from mien.tracking.fitting.shot import Shot, explaining_singular
from mien.tracking.fitting.views import CameraBatch
from mien.tracking.landmarks.model import LandmarkModel
from mien.tracking.landmarks.stages import follow_landmarks
from mien.tracking.pixels.outcome import turn_light
from mien.tracking.pixels.refine import follow_photometrically
from mien.tracking.pixels.texture import PhotometricFit
from mien.tracking.settings import TrackingSettings


@dataclass(frozen=True, eq=False)
class Stages:
    """What a fit found after each of its stages."""

    landmarks: Fit
    pixels: PhotometricFit | None
    """After the fit to pixels of the schedule `fast`. None if the schedule has no such stage."""
    descent: PhotometricFit | None
    """After the descent of the schedule `paper`. None if the schedule has no such stage."""

    @property
    def refined(self) -> PhotometricFit | None:
        """The fit to pixels at the end; None if the schedule uses landmarks alone."""
        return self.pixels if self.descent is None else self.descent

    @property
    def fit(self) -> Fit:
        """The fit at the end."""
        return self.landmarks if self.refined is None else self.refined.fit


def follow_held_out(
    model: LandmarkModel,
    shots: Sequence[Shot],
    others: Sequence[Shot],
    found: Stages,
    settings: TrackingSettings,
    cache: StageCache,
    watch: Watch,
) -> Stages:
    """Fit the motion of held-out sequences, with everything else as the other sequences show it.

    Identity, offsets of landmarks and vertices, texture and light are those of the other sequences. The light is their
    mean. An unknown focal length is the assumed one, changed as theirs were on average.

    Args:
        model: The face model reduced to its landmarks.
        shots: The held-out sequences.
        others: The sequences that show the person.
        found: What the stages found for `others`.
        settings: Settings of the whole tracking.
        cache: Keeps the pieces from which an interrupted fit of the same input resumes.
        watch: Receives the progress.
    """
    before = found.landmarks if found.pixels is None else found.pixels.fit
    cameras = _cameras(shots, others, before)
    with explaining_singular(shots):
        landmarks = follow_landmarks(model, shots, cameras, before.subject, settings, cache, watch)
    pixels, descent = None, None
    if found.pixels is not None:
        pixels = _start(shots, others, landmarks, found.pixels)
        if (pixels.texture.trust > 0).any():
            pixels = follow_photometrically(model, shots, pixels, settings, cache, watch)
    if found.descent is not None:
        fit = landmarks if pixels is None else pixels.fit
        own = zip(fit.sequences, _cameras(shots, others, found.descent.fit), strict=True)
        fit = replace(fit, sequences=tuple(replace(one, cameras=now) for one, now in own))
        descent = _start(shots, others, fit, found.descent)
        if pixels is None:
            descent = replace(descent, improved=tuple(torch.ones_like(own) for own in descent.improved))
        else:
            descent = replace(descent, improved=pixels.improved)
        if (descent.texture.trust > 0).any():
            descent = follow_by_descent(model, shots, descent, found.descent, settings, cache, watch)
    return Stages(landmarks, pixels, descent)


def _start(shots: Sequence[Shot], others: Sequence[Shot], fit: Fit, shown: PhotometricFit) -> PhotometricFit:
    """A fit of the held-out sequences, with the texture and the mean light that the others show."""
    return PhotometricFit(
        fit, shown.texture, tuple(mean_light(shot, others, shown) for shot in shots),
        tuple(torch.zeros(len(own.state), dtype=torch.bool) for own in fit.sequences),
    )  # fmt: skip


def _cameras(shots: Sequence[Shot], others: Sequence[Shot], fit: Fit) -> list[CameraBatch]:
    """The cameras of the held-out sequences: calibrated, given, or with the focal length that the others suggest."""
    longer = [
        (own.cameras.K[0, 0, 0] / shot.cameras.K[0, 0, 0]).log()
        for shot, own in zip(others, fit.sequences, strict=True)
        if shot.capture.calibration is None
    ]
    factor = float(torch.stack(longer).mean().exp()) if longer else 1.0
    return [shot.cameras.with_focal(factor) if shot.capture.calibration is None else shot.cameras for shot in shots]


def mean_light(shot: Shot, others: Sequence[Shot], shown: PhotometricFit) -> Float[Tensor, "9 3"]:
    """The mean light of the other sequences in this one's frame.

    The world of uncalibrated sequences is their camera's, so only sequences of the same kind count, if there are any.
    """
    pairs = list(zip(others, shown.lights, strict=True))
    alike = [pair for pair in pairs if (pair[0].T_world_fit is None) == (shot.T_world_fit is None)]
    lights = []
    for other, light in alike or pairs:
        if other.T_world_fit is not None:
            light = turn_light(light, other.T_world_fit[:3, :3].to(light))
        lights.append(light)
    mean = torch.stack(lights).mean(0)
    return mean if shot.T_world_fit is None else turn_light(mean, shot.T_world_fit[:3, :3].T.to(mean))
