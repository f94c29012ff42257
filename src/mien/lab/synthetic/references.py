"""Reference captures: fixed, named recipes for figures that everybody can reproduce."""

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mien.errors import UserError
from mien.lab.synthetic.captures import scene_key, write_scene
from mien.lab.synthetic.posed_faces import posed_faces
from mien.lab.synthetic.recipe import PEOPLE, Segment, SyntheticRecipe
from mien.lab.synthetic.scene import SyntheticScene

TALK, FACES = "talk", "faces"
"""The sequence of talk of an `unfilmed` reference, and the folder of the true pictures of its faces."""


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
    unfilmed: bool = False
    """Whether the protocol `unfilmed` scores it: true pictures of `posed_faces`, which the sequence TALK lacks."""

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
        if self.unfilmed:
            first = scenes[0]
            seen = replace(first.recipe, name=FACES, cameras="oblique")
            faces = [*posed_faces(first.model).values()]
            scenes.append(SyntheticScene(seen, self.seed, first.motion_seed, first, faces=faces))
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


def _reference(
    name: str, sequences: list[dict[str, Any]], views: dict[str, Any] | None = None, **own: Any
) -> ReferenceCapture:
    recipes = tuple(_recipe({"name": name, **one}) for one in sequences)
    named: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in own.items()}
    return ReferenceCapture(name, sequences=recipes, views=SideViews(**views) if views else None, **named)


def _recipe(changes: dict[str, Any]) -> SyntheticRecipe:
    """The recipe of `like` with changes. A recipe that names no other one has the defaults."""
    base = changes.pop("like", None)
    recipe = _recipe({**PEOPLE["recipes"][base]}) if base else SyntheticRecipe()
    own = {name: tuple(value) if isinstance(value, list) else value for name, value in changes.items()}
    if "script" in own:
        own["script"] = tuple(Segment(*part) for part in own["script"])
    return replace(recipe, **own)


REFERENCES = {name: _reference(name, **entry) for name, entry in PEOPLE["references"].items()}
"""Reference captures by name."""
