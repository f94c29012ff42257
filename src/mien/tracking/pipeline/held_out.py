"""Held-out sequences tracked apart: what other sequences show of the person stays, and only the motion is fitted."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from mien.tracking.descent.fit import fit_by_descent
from mien.tracking.fitting.fit import Fit
from mien.tracking.fitting.sequence import SequenceData, explaining_singular
from mien.tracking.fitting.views import CameraBatch
from mien.tracking.landmarks.problem import Problem
from mien.tracking.landmarks.stages import follow_landmarks
from mien.tracking.pixels.outcome import turn_light
from mien.tracking.pixels.refine import refine_photometrically
from mien.tracking.pixels.texture import PhotometricFit, photometric_start


@dataclass(frozen=True, eq=False)
class StageFits:
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


def follow_held_out(problem: Problem, others: Sequence[SequenceData], known: StageFits) -> StageFits:
    """Fit the motion of held-out sequences, with everything else as the stages found it for `others`.

    Identity, offsets of landmarks and vertices, texture and light are those of the other sequences. The light is their
    mean. An unknown focal length is the assumed one, changed as theirs were on average.
    """

    def appearance(fit: Fit, shown: PhotometricFit) -> PhotometricFit:
        return photometric_start(fit, shown.texture, [mean_light(data, others, shown.lights) for data in problem.data])

    before = known.landmarks if known.pixels is None else known.pixels.fit
    with explaining_singular(problem.data):
        fit = landmarks = follow_landmarks(problem, before.subject, _cameras(problem.data, others, before))
    pixels, descent = None, None
    if known.pixels is not None:
        pixels = appearance(landmarks, known.pixels)
        if (pixels.texture.trust > 0).any():
            pixels = refine_photometrically(problem, pixels, known_person=True)
        fit = pixels.fit
    if known.descent is not None:
        cameras = _cameras(problem.data, others, known.descent.fit)
        moved = [replace(sequence, cameras=batch) for sequence, batch in zip(fit.sequences, cameras, strict=True)]
        fit = replace(fit, sequences=tuple(moved))
        descent = appearance(fit, known.descent)
        improved = [torch.ones_like(rows) for rows in descent.improved] if pixels is None else pixels.improved
        descent = fit_by_descent(problem, fit, replace(descent, improved=tuple(improved)), known.descent)
    return StageFits(landmarks, pixels, descent)


def _cameras(sequences: Sequence[SequenceData], others: Sequence[SequenceData], fit: Fit) -> list[CameraBatch]:
    """The cameras of the held-out sequences: calibrated, given, or with the focal length that the others suggest."""
    longer = [
        (sequence.cameras.K[0, 0, 0] / data.cameras.K[0, 0, 0]).log()
        for data, sequence in zip(others, fit.sequences, strict=True)
        if data.capture.calibration is None
    ]
    factor = float(torch.stack(longer).mean().exp()) if longer else 1.0
    return [data.cameras.with_focal(factor) if data.capture.calibration is None else data.cameras for data in sequences]


def mean_light(
    data: SequenceData, others: Sequence[SequenceData], lights: Sequence[Float[Tensor, "9 3"]]
) -> Float[Tensor, "9 3"]:
    """The mean light of the other sequences in this one's frame.

    The world of uncalibrated sequences is their camera's, so only sequences of the same kind count, if there are any.
    """
    pairs = list(zip(others, lights, strict=True))
    alike = [pair for pair in pairs if (pair[0].T_world_fit is None) == (data.T_world_fit is None)]
    in_world = [
        light if other.T_world_fit is None else turn_light(light, other.T_world_fit[:3, :3].to(light))
        for other, light in alike or pairs
    ]
    mean = torch.stack(in_world).mean(0)
    return mean if data.T_world_fit is None else turn_light(mean, data.T_world_fit[:3, :3].T.to(mean))
