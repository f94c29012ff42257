"""`mien demo`."""

from dataclasses import dataclass
from pathlib import Path

from mien.commands.create import Command as Create
from mien.commands.options import PresetName, TrainOptions
from mien.errors import UserError

_LONGEST = 600.0
"""Seconds: synthetic heads are drawn frame by frame."""


@dataclass(frozen=True)
class Command:
    """The whole path on a synthetic head: draw a video, capture, track, train, evaluate, report."""

    out: Path = Path("out/demo")
    """Workspace folder; the video lies in it."""
    preset: PresetName = "draft"
    """As for `mien create`."""
    steps: int = 0
    """As for `mien create`."""
    seconds: float = 0.0
    """Length of the video; 0 for the recipe's."""
    seed: int = 0
    """Another head, another motion."""

    def check(self) -> None:
        """Tell what can be told without heavy libraries."""
        from mien.files import check_writable

        TrainOptions(preset=self.preset, steps=self.steps).settings()
        if self.seconds and not 0 < self.seconds <= _LONGEST:
            raise UserError(f"--seconds {self.seconds:g}: give up to {_LONGEST:g}, or leave it out")
        check_writable(self.out, folder=True)

    def run(self) -> None:
        """Write the video unless it is there, then create."""
        from dataclasses import replace

        from mien.locks import hold
        from mien.synthetic import RECIPES, write_synthetic_video

        recipe = RECIPES["demo"]
        if self.seconds:
            recipe = replace(recipe, seconds=self.seconds)
        video = self.out / f"synthetic-{self.seed}-{recipe.seconds:g}s.mp4"
        if not video.is_file():
            with hold(video):
                write_synthetic_video(recipe, video, self.seed)
        options = TrainOptions(preset=self.preset, steps=self.steps)
        create = Create(videos=(video,), out=self.out, name=("synthetic",), options=options)
        create.check()
        create.run()
