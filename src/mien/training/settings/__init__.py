"""Settings of a run that do not depend on the method, their presets, and those of the alignment. Needs no torch."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

from mien.avatar.methods import method_named
from mien.avatar.settings import Differences, MethodConfig
from mien.disk.config import COUNT, FRACTION, NOT_NEGATIVE, Range, check_ranges, overlay
from mien.disk.reading import MAX_SIDE
from mien.errors import UserError
from mien.machine.devices import DeviceName

Split = Literal["blocks", "tail", "none", "gaussian-avatars", "nersemble-benchmark", "dataset"]
"""Name of a split (`mien.training.settings.splits`)."""


@dataclass(frozen=True)
class TrainSettings:
    """Settings of a training run. Losses, rates and density control are settings of the method.

    The defaults are the preset `standard`.
    """

    steps: Annotated[int, Range(1, 1_000_000_000)] = 6_000
    """Number of training frames, one for each optimiser step. All schedules stretch with it. A method may use several
    frames in one optimiser step, which then counts as so many."""
    split: Split = "blocks"
    """What is held out (`mien.training.settings.splits`)."""
    background: Literal["white", "mixed", "random", "auto"] = "auto"
    """Background of the training pictures. A random colour in each step keeps Gaussians from imitating white, which can
    show as white dots and needles; it costs 0.2 to 0.6 dB. Mixed, random in one of ten steps, costs next to nothing.
    Auto: mixed where sides are filled (`--training.unseen`), else white."""
    edges: Literal["filmed", "cleaned", "auto"] = "auto"
    """Colours at soft edges of the matte, where a pixel holds some of the filmed background: as they are, which can
    show as slivers over other backgrounds (filmed), or those of the person alone, as estimated (cleaned). Auto: cleaned
    where sides are filled (`--training.unseen`), else filmed."""
    frame_order: Literal["even", "rare"] = "even"
    """How often frames are drawn: each equally often, or those with a rare expression up to four times as often as
    those with a common one."""
    camera_colors: Literal["none", "first", "mean"] = "none"
    """Whether a change of colours is learned for each camera, for rigs whose cameras differ in exposure or white
    balance. The avatar has the colours of the first camera (first), or those between all cameras (mean)."""
    light: Literal["steady", "changing", "auto"] = "auto"
    """Whether a gain of three numbers is learned for each timestep, for videos whose exposure, white balance or lamps
    change. The avatar has the mean light. Auto: changing if one camera filmed and the brightness of the face changes
    by a factor of more than 1.35, else steady."""
    unseen: Literal["trained", "filled", "auto"] = "auto"
    """Sides of the head that no training picture shows. Trained: they may help to explain pictures, and look broken
    from the side. Filled: they are a closed surface in completed colours, what is seen is kept flat on the mesh, and
    alpha is compared with the matte. Auto: filled if one camera filmed, trained if there are several. Methods that bind
    no Gaussians to triangles train all sides in either case."""
    mesh: Literal["tracked", "fitted", "auto"] = "auto"
    """The mesh that Gaussians are bound to: as tracking left it (tracked), or drawn into the mattes where it is outside
    of them (fitted). Auto: fitted where sides are filled (`--training.unseen`), else tracked."""
    side_weight: Annotated[float, NOT_NEGATIVE] = 0.1
    """Weight of the views from the side and of raised expressions, in which filled heads are compared with the
    completed mesh."""
    hair_rate: Annotated[float, Range(0, 0.01)] = 6e-4
    """Largest distance in metres by which the surface of the hair of a filled head moves in one correction. 0 keeps it
    at the height that was measured on mattes or guessed from it."""
    inside: Literal["free", "covered", "filled"] = "covered"
    """Eyeballs and the inside of the mouth. Free: they may help to explain lids, lips and cheeks that hide them, and
    are missing where eyes and mouth open. Covered: where the mesh hides them, they have another colour in each step, so
    that lids and lips become opaque. Filled: also, a mouth that is hardly ever seen gets a dark surface at half of the
    run, which can show as dark spots on cheeks from the side."""
    resolution: Annotated[int, Range(16, MAX_SIDE, or_zero=True)] = 0
    """Longer side of the training pictures, in pixels. 0 keeps the capture's own. Pictures are never enlarged."""
    coarse: Annotated[float | None, FRACTION] = None
    """Share of the run, from its start, that trains on pictures of half that size, which takes less time. Pictures
    whose longer side has fewer than 384 pixels are not halved. If it is not given, 0.4 where sides are filled
    (`--training.unseen`), else 0."""
    seed: Annotated[int, Range(-(2**63), 2**63 - 1)] = 0
    """Seed of all random numbers. The same seed, settings and data give the same bytes on a CPU."""
    device: DeviceName = "cpu"
    """Device that training runs on. On `cuda` (through gsplat), the same seed does not give the same bytes."""
    checkpoint_every: Annotated[int, Range(1, 1_000_000_000)] = 1_000
    """Number of steps between checkpoints."""
    record_every: Annotated[int, Range(1, 1_000_000_000)] = 10
    """Number of steps between entries of the curves."""
    held_out_sequences: tuple[str, ...] = ()
    """Names of whole sequences that are not trained on. The split divides the others."""
    held_out_cameras: tuple[str, ...] = ()
    """Ids of cameras that are not trained on, in any sequence."""

    def check(self) -> None:
        """Check that all numbers are in their ranges."""
        check_ranges(self, lambda name: ("--" if name in MAIN_SETTINGS else "--training.") + name.replace("_", "-"))

    @property
    def holds_out(self) -> bool:
        """Whether anything is held out for scoring."""
        return self.split != "none" or bool(self.held_out_sequences or self.held_out_cameras)


MAIN_SETTINGS = ("steps", "split", "background", "seed", "device", "held_out_sequences", "held_out_cameras")
"""Fields that have command-line options of their own; the others are `--training.NAME`."""


def check_held_out(names: Sequence[str], settings: TrainSettings) -> None:
    """Check that the held-out sequences belong to a run, and that others remain."""
    unknown = [name for name in settings.held_out_sequences if name not in names]
    if unknown:
        raise UserError(f"--hold-out {unknown[0]}: no such sequence in this run; there are: {', '.join(names)}")
    if set(names) <= set(settings.held_out_sequences):
        raise UserError(f"--hold-out {' '.join(settings.held_out_sequences)}: leaves no sequence to train on")


def doubly_held_out(settings: TrainSettings) -> str | None:
    """A warning if both the split and whole sequences withhold frames from training, or None."""
    if settings.split not in ("blocks", "tail") or not settings.held_out_sequences:
        return None
    return (
        f"--split {settings.split} holds out a fifth of each other sequence as well, beside --hold-out "
        f"{' '.join(settings.held_out_sequences)}; add --split none to train on all of them"
    )


_COARSE = 0.4
"""Share of a run with filled sides that trains on halved pictures: more of it blurs hair and skin (docs/log.md)."""


def resolved(settings: TrainSettings, *, filled: bool) -> TrainSettings:
    """The settings without `auto`: filled sides have mixed backgrounds and cleaned edges, others white and filmed."""
    if settings.coarse is None:
        settings = replace(settings, coarse=_COARSE if filled else 0.0)
    if settings.background == "auto":
        settings = replace(settings, background="mixed" if filled else "white")
    return replace(settings, edges="cleaned" if filled else "filmed") if settings.edges == "auto" else settings


@dataclass(frozen=True)
class Preset:
    """A named choice of settings of a run and its method, given as what differs from their defaults.

    The differences of each method are in the method's file.
    """

    name: str
    changes: Mapping[str, Any]
    """Settings of a run that differ from the defaults, by name, whatever the method is."""
    published: bool = False
    """Whether the preset repeats a paper, which knows nothing of what mien adds around its methods."""

    @property
    def settings(self) -> TrainSettings:
        """The settings of a run, for methods that change none of them."""
        return overlay(TrainSettings(), self.changes, f"preset {self.name}: settings", "a run")

    def settings_of(self, method: str) -> TrainSettings:
        """The settings of a method's run."""
        own = self._differences(method).get("settings", {})
        return overlay(self.settings, own, f"preset {self.name} of {method}: settings", "a run")

    def config(self, method: str) -> MethodConfig:
        """The settings of a method."""
        own = self._differences(method).get("method", {})
        return overlay(method_named(method).config(), own, f"preset {self.name} of {method}: method", method)

    def _differences(self, method: str) -> Differences:
        presets = method_named(method).presets
        if self.name not in presets:
            raise UserError(f"--preset {self.name}: {method} has no such preset; it has {' and '.join(presets)}")
        return presets[self.name]


_OPEN = {
    "background": "white",
    "edges": "filmed",
    "inside": "free",
    "light": "steady",
    "mesh": "tracked",
    "unseen": "trained",
}
"""Heads stay as they were filmed, as in the papers."""
PRESETS = {
    preset.name: preset
    for preset in (
        Preset("draft", {"steps": 4_000}),
        Preset("standard", {}),
        Preset("fine", {"steps": 12_000}),
        Preset("paper", _OPEN, published=True),
        Preset("paper-cpu", _OPEN, published=True),
    )
}
"""Presets by name. `standard` is the defaults. `fine` takes twice as many steps. `paper` repeats the method's paper,
and `paper-cpu` is the same in a size that a processor can train; not every method has them."""


@dataclass(frozen=True)
class AlignmentSettings:
    """Analysis by synthesis: a quick avatar is trained, and the face parameters of all frames are fitted to it."""

    when: Literal["auto", "always", "never"] = "auto"
    """Whether frames are aligned. Auto: if one camera filmed, the preset is not paper, and the run is not shorter than
    the training of the quick avatar. Several cameras agree on the face already, and the papers train on the tracking
    alone."""
    template_steps: Annotated[int, COUNT] = 3_000
    """Number of training steps of the quick avatar."""
    template_gaussians: Annotated[int, COUNT] = 20_000
    """Largest number of Gaussians of the quick avatar."""
    resolution: Annotated[int, Range(16, MAX_SIDE)] = 256
    """Longer side of the pictures, in pixels, for the quick avatar and for the alignment."""
    iterations: Annotated[int, COUNT] = 8
    """Number of optimiser steps for each frame."""

    def check(self) -> None:
        """Check that all numbers are in their ranges."""
        check_ranges(self, lambda name: f"--alignment.{name.replace('_', '-')}")
