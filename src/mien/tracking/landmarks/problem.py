"""The problem that the fits of tracking solve: the sequences of one person, and how they are fitted."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from mien.capture.capture import Capture
from mien.tracking.fitting.fit import Callback, Fit, SequenceFit, smoothness_of
from mien.tracking.fitting.resume import StageCache
from mien.tracking.fitting.sequence import SequenceData
from mien.tracking.fitting.solver import Smoothness
from mien.tracking.landmarks.model import LandmarkModel
from mien.tracking.landmarks.term import LandmarkTerm, all_landmarks
from mien.tracking.settings import TrackingSettings


@dataclass(frozen=True, eq=False)
class Problem:
    """The sequences of one person that are fitted together, with everything that all stages of the fit need."""

    model: LandmarkModel
    data: Sequence[SequenceData]
    """The input of each sequence."""
    lenses: Sequence[int | None]
    """Index of each sequence's unknown focal length (`lenses_of`). Sequences with the same index share it, up to the
    size of their pictures. None is a known focal length, which is kept."""
    settings: TrackingSettings
    cache: StageCache = field(default_factory=StageCache)
    """Keeps the pieces from which an interrupted fit of the same input resumes."""
    callback: Callback | None = None
    """Receives the progress."""

    @property
    def frames(self) -> int:
        """The number of timesteps with a face, over all sequences."""
        return sum(int(data.valid.sum()) for data in self.data)

    def pairs(self, fit: Fit) -> list[tuple[SequenceData, SequenceFit]]:
        """The input of each sequence with its fit."""
        return list(zip(self.data, fit.sequences, strict=True))

    def landmark_terms(self, fit: Fit) -> list[LandmarkTerm]:
        """The cost of all landmarks of each sequence, at the depth of a fit."""
        return [all_landmarks(self.model, data.views, own, self.settings) for data, own in self.pairs(fit)]

    def smoothness(self, fit: Fit) -> list[Smoothness]:
        """The smoothness cost of each sequence."""
        layout, settings = self.model.layout, self.settings.smoothness
        return [
            smoothness_of(layout, data.valid, data.capture.fps, settings, own.cameras) for data, own in self.pairs(fit)
        ]


def lenses_of(captures: Sequence[Capture], settings: TrackingSettings) -> list[int | None]:
    """The index of the unknown focal length of each capture; None if the focal length is known."""
    unknown = [capture.calibration is None and settings.focal is None for capture in captures]
    indices = [0 if settings.same_camera else sum(unknown[:number]) for number in range(len(unknown))]
    return [index if free else None for index, free in zip(indices, unknown, strict=True)]
