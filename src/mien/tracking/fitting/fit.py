"""The state of a fit: the subject, its sequences, and what every fit agrees on."""

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mien.machine.progress import Advance, progress_bar
from mien.tracking.fitting.parameters import ParameterLayout
from mien.tracking.fitting.solver import Smoothness
from mien.tracking.fitting.views import CameraBatch
from mien.tracking.settings import SmoothnessSettings

HIDING_REGIONS = ("scalp", "neck", "mouth", "teeth", "tongue", "eye_sockets", "ears", "eyes", "irises")
"""Regions that take no part in the fit but hide what is behind them. Hair and collars cover them, or they move by
themselves."""


@dataclass(frozen=True, eq=False)
class Subject:
    """Parameters of a person that all sequences share."""

    identity: Float[Tensor, " i"]
    bias: Float[Tensor, "l 3"]
    """Offset of each landmark from the model's, at rest, in the head frame, in metres: detectors mark other points."""
    vertex_offsets: Float[Tensor, "v 3"] | None = None
    """Static offsets of the mesh, if it was fitted to pixels. The bias then includes their effect on the landmarks."""
    person: Float[Tensor, " k"] = field(default_factory=lambda: torch.zeros(0, dtype=torch.float64))
    """Coefficients of this person in `DetectorResponse.by_person`. Their offsets are part of the bias."""

    @property
    def shared(self) -> Float[Tensor, " s"]:
        """Identity, then person: the parameters that are fitted to all pictures together."""
        return torch.cat([self.identity, self.person])

    @property
    def columns_of_pixels(self) -> Int[Tensor, " _"]:
        """Indices, in `shared` and the log of the focal length, of what is fitted to pixels: all but `person`."""
        return torch.cat([torch.arange(len(self.identity)), torch.tensor([len(self.shared)])])


@dataclass(frozen=True, eq=False)
class SequenceFit:
    """Fit of one sequence: its cameras, and the parameters of the v timesteps in which a face was found."""

    cameras: CameraBatch
    state: Float[Tensor, "v p"]
    """Parameters in the order of the layout."""


@dataclass(frozen=True, eq=False)
class Fit:
    """The state of tracking: the subject's parameters, which all sequences share, and those of each sequence."""

    subject: Subject
    sequences: tuple[SequenceFit, ...]

    def tensors(self) -> dict[str, Tensor]:
        """The fit as tensors by name, for a file."""
        tensors = {"identity": self.subject.identity, "bias": self.subject.bias, "person": self.subject.person}
        if self.subject.vertex_offsets is not None:
            tensors["vertex_offsets"] = self.subject.vertex_offsets
        for index, own in enumerate(self.sequences):
            named = {"K": own.cameras.K, "viewmat": own.cameras.viewmat, "state": own.state}
            tensors |= {f"{name}_{index}": tensor for name, tensor in named.items()}
        return tensors


def fit_of(tensors: Mapping[str, Tensor]) -> Fit:
    """The fit made of tensors by name (`Fit.tensors`)."""
    subject = Subject(tensors["identity"], tensors["bias"], tensors.get("vertex_offsets"), tensors["person"])
    sequences: list[SequenceFit] = []
    while f"state_{len(sequences)}" in tensors:
        K, viewmat, state = (tensors[f"{name}_{len(sequences)}"] for name in ("K", "viewmat", "state"))
        sequences.append(SequenceFit(CameraBatch(K, viewmat), state))
    return Fit(subject, tuple(sequences))


def choose_keyframes(pose: Float[Tensor, "v 6"], count: int) -> Int[Tensor, " k"]:
    """Choose frames with head rotations as far apart as possible, starting from the one nearest to the median."""
    rotations = pose[:, :3]
    chosen = [int((rotations - rotations.median(0).values).norm(dim=1).argmin())]
    distance = (rotations - rotations[chosen[0]]).norm(dim=1)
    while len(chosen) < min(count, len(pose)):
        chosen.append(int(distance.argmax()))
        distance = torch.minimum(distance, (rotations - rotations[chosen[-1]]).norm(dim=1))
        distance[chosen] = -1
    return torch.tensor(sorted(chosen))


def smoothness_of(
    layout: ParameterLayout,
    valid: Bool[Tensor, " t"],
    fps: float,
    settings: SmoothnessSettings,
    cameras: CameraBatch | None = None,
) -> Smoothness:
    """The smoothness cost over timesteps with a face; gaps break the chain. Without `cameras`, one looks along z."""
    sigmas = torch.full((layout.size,), math.inf, dtype=torch.float64)
    sigmas[:3] = settings.rotation
    along_sight = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    if cameras is not None:
        along_sight = cameras.viewmat[0, 2, :3] ** 2 if len(cameras) == 1 else torch.zeros_like(along_sight)
    sigmas[3:6] = settings.translation + (settings.depth - settings.translation) * along_sight
    # Eyes and lids may jump.
    slow = torch.tensor(["eye" not in name.lower() for name in layout.names[6:]], dtype=torch.bool)
    sigmas[6:] = torch.where(slow, settings.expression * layout.units, torch.inf)
    frames = valid.nonzero()[:, 0]
    linked = torch.zeros(len(frames), dtype=torch.bool)
    if len(frames) > 2:
        linked[1:-1] = frames[2:] - frames[:-2] == 2
    return Smoothness((sigmas / fps**2) ** -2, linked)


def widen(pose: Float[Tensor, "v 6"], layout: ParameterLayout) -> Float[Tensor, "v p"]:
    """Head poses as complete parameter vectors, with everything else at rest."""
    return torch.cat([pose, pose.new_zeros(len(pose), layout.size - 6)], dim=1)


Callback = Callable[[str, float, Callable[[], object] | None], object]
"""Receives the stage that runs, the share of its work that is done, and, if the fit changed, a function that returns it
(a `Fit` or a `PhotometricFit`), which may be called later, or never."""


@dataclass(eq=False)
class Progress:
    """The progress of one kind of fit, reported to a progress bar and to a callback. Mutable."""

    name: str
    """Name of the fit, which begins the name of each stage."""
    total: int
    """Amount of work."""
    bar: Advance
    callback: Callback | None
    done: int = 0
    """Amount of work that is done."""

    def advance(self, amount: int = 1, status: str = "", current: Callable[[], object] | None = None) -> None:
        """Report that more work is done and which stage runs. `current` returns the fit, if it changed."""
        self.done += amount
        self.bar(amount, status=status)
        self.show(status, current)

    def show(self, status: str, current: Callable[[], object] | None = None) -> None:
        """Tell the callback which stage runs, and how to get the fit."""
        if self.callback is not None:
            self.callback(f"{self.name}, {status}", self.done / self.total, current)


@contextmanager
def show_progress(title: str, name: str, total: int, callback: Callback | None, done: int = 0) -> Iterator[Progress]:
    """Show a progress bar for a fit, and report to the callback."""
    with progress_bar(title, total, done) as bar:
        yield Progress(name, total, bar, callback, done)
