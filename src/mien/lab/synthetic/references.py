"""Reference captures: fixed, named recipes for figures that everybody can reproduce."""

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from mien.errors import UserError
from mien.lab.synthetic.captures import scene_key, write_scene
from mien.lab.synthetic.recipe import Segment, SyntheticRecipe
from mien.lab.synthetic.scene import SyntheticScene


@dataclass(frozen=True)
class SideViews:
    """True pictures of one sequence from the cameras of `SIDES`, at some of its timesteps. Training never sees them."""

    sequence: str
    """Name of the sequence. Its own pictures are those of the front camera."""
    every: int
    """Every n-th timestep has views."""
    first: int = 0
    """The first timestep that has views."""

    @property
    def name(self) -> str:
        """Name of the drawn folder."""
        return f"{self.sequence}-views"


@dataclass(frozen=True)
class ReferenceCapture:
    """One synthetic person in one or several sequences, and how methods are trained on it for comparison."""

    name: str
    description: str
    """Description in one line, for tables."""
    seed: int
    """Seed of the person."""
    sequences: tuple[SyntheticRecipe, ...]
    """Recipes of the sequences; their names are the sequences' names."""
    held_out_sequences: tuple[str, ...] = ()
    held_out_cameras: tuple[str, ...] = ()
    steps: int = 2_000
    """Optimiser steps of `mien bench quality`."""
    by_default: bool = True
    """Whether `mien bench quality` without names includes it."""
    views: SideViews | None = None
    """True pictures from the side for the protocol `unseen_view`. None if there are none."""

    def scenes(self) -> list[SyntheticScene]:
        """Return the sequences and the side views, not yet drawn. They share the person but not the motion."""
        scenes: list[SyntheticScene] = []
        for index, recipe in enumerate(self.sequences):
            scenes.append(SyntheticScene(recipe, self.seed, 1000 * self.seed + index, scenes[0] if scenes else None))
        for of in [scene for scene in scenes if self.views and scene.recipe.name == self.views.sequence]:
            assert self.views is not None
            seen = replace(of.recipe, name=self.views.name, cameras="sides")
            moments = range(self.views.first, of.recipe.timesteps, self.views.every)
            scenes.append(SyntheticScene(seen, self.seed, of.motion_seed, scenes[0], moments))
        return scenes

    def write(self, folder: Path) -> str:
        """Draw every sequence into FOLDER/NAME, unless it exists already, and return the key of the whole reference."""
        return _combined([write_scene(scene, folder / scene.recipe.name) for scene in self.scenes()])

    def key(self) -> str:
        """Return the key that is quoted with figures on this reference (`scene_key`)."""
        return _combined([scene_key(scene) for scene in self.scenes()])


def _combined(keys: list[str]) -> str:
    """Return the key of a single sequence, or a hash of several keys."""
    return keys[0] if len(keys) == 1 else hashlib.sha256(" ".join(keys).encode()).hexdigest()[:16]


def reference_named(name: str) -> ReferenceCapture:
    """Return a reference capture by its name."""
    if name not in REFERENCES:
        raise UserError(f"there is no reference capture {name!r}; choose one of: {', '.join(REFERENCES)}")
    return REFERENCES[name]


def _script(*parts: tuple[str, float]) -> tuple[Segment, ...]:
    return tuple(Segment(kind, seconds) for kind, seconds in parts)  # type: ignore[arg-type]


_PERSON = SyntheticRecipe(glasses=False, turns=(35.0, 16.0), rotation=(20.0, 10.0, 7.0))
_BRIEF = replace(
    _PERSON, width=384, height=384, fps=20.0,
    script=_script(("still", 1.0), ("free", 5.0), ("turns", 4.0), ("still", 1.0)),
)  # fmt: skip
_RING = replace(
    _PERSON, width=256, height=256, fps=10.0, cameras="ring", translation=(0.012, 0.008, 0.02),
    rotation=(8.0, 5.0, 4.0), turns=(30.0, 14.0),
)  # fmt: skip
_SIDES = replace(_PERSON, width=320, height=320, fps=15.0)
_SIDES_TRAINED = replace(
    _SIDES, name="front", turns=(25.0, 12.0), rotation=(12.0, 8.0, 5.0),
    script=_script(("still", 0.6), ("turns", 3.6), ("free", 5.8)),
)  # fmt: skip
_SIDES_SCORED = replace(
    _SIDES, name="aside", rotation=(6.0, 4.0, 3.0), translation=(0.01, 0.006, 0.02),
    script=_script(("free", 1.8), ("expressions", 3.6)),
)  # fmt: skip
_LARGE_RING = replace(_RING, width=550, height=802)
"""The size of the pictures that GaussianAvatars was trained on (section A of its supplement)."""


def _one(name: str, description: str, seed: int, recipe: SyntheticRecipe, steps: int = 2_000) -> ReferenceCapture:
    return ReferenceCapture(name, description, seed, (replace(recipe, name=name),), steps=steps)


def _sides(name: str, description: str, seed: int, hair: Literal["short", "long"]) -> ReferenceCapture:
    """A person trained from the front, and scored from all sides at expressions like and unlike those of training."""
    return ReferenceCapture(
        name, description, seed,
        (replace(_SIDES_TRAINED, hair=hair), replace(_SIDES_SCORED, hair=hair)),
        held_out_sequences=("aside",), steps=4_000, views=SideViews("aside", every=6, first=3),
    )  # fmt: skip


REFERENCES = {
    reference.name: reference
    for reference in (
        _one(
            "mono-short", "20 s of one camera, 512x512, 25 fps", 2,
            replace(_PERSON, script=_script(
                ("still", 1.5), ("free", 6.0), ("speech", 4.0), ("turns", 5.0), ("free", 2.0), ("still", 1.5)
            )),
        ),
        _one(
            "mono-long", "2 minutes of one camera, 384x384, 15 fps: speech, posed expressions, wide turns", 14,
            replace(_PERSON, width=384, height=384, fps=15.0, turns=(58.0, 24.0), script=_script(
                ("still", 2.0), ("speech", 40.0), ("expressions", 34.0), ("turns", 24.0), ("still", 2.0),
                ("free", 16.0), ("still", 2.0),
            )),
            steps=3_000,
        ),
        ReferenceCapture(
            "ring-16", "16 calibrated cameras, 256x256, 10 fps: turns, expressions, speech (held out)", 8,
            (
                replace(_RING, name="turns", script=_script(("still", 0.6), ("turns", 2.4))),
                replace(_RING, name="expressions", script=_script(("expressions", 4.0))),
                replace(_RING, name="speech", script=_script(("speech", 2.4), ("still", 0.6))),
            ),
            held_out_sequences=("speech",), held_out_cameras=("08",),
        ),
        ReferenceCapture(
            "ring-16-large", "16 calibrated cameras, 550x802, 10 fps: turns, expressions, speech (held out)", 9,
            (
                replace(_LARGE_RING, name="turns", script=_script(("still", 0.6), ("turns", 3.4))),
                replace(_LARGE_RING, name="expressions", script=_script(("expressions", 4.8))),
                replace(_LARGE_RING, name="speech", script=_script(("speech", 2.6), ("still", 0.6))),
            ),
            held_out_sequences=("speech",), held_out_cameras=("08",), steps=15_000, by_default=False,
        ),
        _one("beard", "a full beard, 384x384", 3, replace(_BRIEF, beard=0.014)),
        _one("long-hair", "hair to the shoulders, 384x384", 6, replace(_BRIEF, hair="long")),
        _one("glasses", "glasses, 384x384", 11, replace(_BRIEF, glasses=True)),
        _one("off-model", "shape and expressions beyond the face model, 384x384", 7, replace(_BRIEF, off_model=1.0)),
        _sides("mono-sides", "one front camera, 320x320, 15 fps; scored from 13 cameras all around", 21, "short"),
        _sides("mono-sides-long-hair", "the same for a person with hair to the shoulders", 22, "long"),
    )
}  # fmt: skip
"""Reference captures by name."""
