"""Things that several files of tests read. A run makes each once, by the fixture `made_once` (tests/conftest.py).
Folders are for reading: a test that changes one copies it first."""

from collections.abc import Callable
from pathlib import Path

from mien.training import train
from plain_settings import plain_config, plain_run
from toy_scene import toy_sequence
from toy_workspace import write_evaluated_workspace, write_toy_workspace

MadeOnce = Callable[[str, Callable[[Path], object]], Path]


def toy_workspace(made_once: MadeOnce) -> Path:
    """Return a workspace with the sequence `clip` of five frames and the trained run `toy`."""
    return made_once("toy_workspace", write_toy_workspace)


def evaluated_workspace(made_once: MadeOnce) -> Path:
    """Return the same with the figures of its run."""
    return made_once("evaluated_workspace", write_evaluated_workspace)


def toy_run(made_once: MadeOnce, method: str) -> Path:
    """Return the folder of a run of twelve steps by a method's plain settings, without held-out frames."""

    def make(folder: Path) -> None:
        face_model, sequence = toy_sequence(timesteps=5, size=32)
        settings = plain_run(steps=12, split="none", checkpoint_every=100, record_every=4)
        train([sequence], face_model, plain_config(method), settings, folder)

    return made_once(f"toy_run_{method}", make)
