"""`mien demo`: the whole path on a synthetic head."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from mien.commands.create import Command as Create
from mien.commands.train_options import PresetName, TrainOptions
from mien.disk.config import Range
from mien.disk.files import check_writable


@dataclass(frozen=True)
class Command:
    """Run the whole path on a synthetic head: draw a video, capture, track, train, evaluate, report."""

    out: Path = Path("out/demo")
    """Workspace folder. The video is written there, too."""
    run_name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Name of the run (default: the method's name)."""
    preset: PresetName = "draft"
    """How thorough the training is, as for `mien create`: draft, standard, fine, paper or paper-cpu."""
    steps: Annotated[int, Range(0, 1_000_000_000)] = 0
    """Number of optimiser steps. 0 means the preset's number."""
    seconds: Annotated[float, Range(0, 600)] = 0.0  # synthetic heads are drawn frame by frame
    """Length of the video in seconds. 0 means the default length."""

    def check(self) -> None:
        """Check the options without heavy libraries."""
        self._options().settings()
        check_writable(self.out, folder=True)

    def run(self) -> None:
        """Write the video unless it exists, then run `mien create` on it."""
        from mien.disk.locks import hold
        from mien.lab.synthetic.captures import write_synthetic_video
        from mien.lab.synthetic.recipe import RECIPES

        recipe = RECIPES["demo"]
        if self.seconds:
            recipe = replace(recipe, seconds=self.seconds)
        video = self.out / f"synthetic-0-{recipe.seconds:g}s.mp4"
        if not video.is_file():
            with hold(video):
                write_synthetic_video(recipe, video, seed=0)
        create = Create((video,), self.out, ("synthetic",), run_name=self.run_name, options=self._options())
        create.check()
        create.run()

    def _options(self) -> TrainOptions:
        options = TrainOptions.of(preset=self.preset)
        return replace(options, steps=self.steps) if self.steps else options
