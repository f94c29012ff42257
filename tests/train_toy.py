"""Train the toy scene into a folder, and progresses of a training that do something after each step."""

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path

import torch

from mien.avatar.methods import DEFAULT_METHOD
from mien.avatar.settings import FaceTuning, GradientSettings
from mien.machine.progress import Advance
from mien.training import train
from plain_settings import plain_config, plain_run
from toy_scene import toy_sequence

CONFIG = plain_config(
    DEFAULT_METHOD, density=GradientSettings(start=0.2, stop=0.8, rounds=4, grow_gradient=1e-4, max_gaussians=400),
    face_tuning=FaceTuning(enabled=True),
)  # fmt: skip
SETTINGS = plain_run(steps=30, split="none", background="random", checkpoint_every=4, record_every=3)


def progress(each: Callable[[int], object]) -> Callable[[str, int, int], AbstractContextManager[Advance]]:
    """Return a progress that calls `each` with the number of every step that is done."""

    @contextmanager
    def report(title: str, total: int, completed: int) -> Iterator[Advance]:
        done = completed

        def advance(amount: int = 1, status: str = "") -> None:
            nonlocal done
            done += amount
            each(done)

        yield advance

    return report


silence = progress(lambda done: None)


def stopped_at(step: int) -> Callable[[str, int, int], AbstractContextManager[Advance]]:
    """Return a progress that raises the error of Ctrl-C after a step."""
    return progress(lambda done: signal.default_int_handler(signal.SIGINT, None) if done == step else None)


def main(run_dir: Path | str, steps: int, kill_at: int = 0) -> None:
    """Train so many steps, print the number of each, and kill this process with SIGKILL after one of them."""

    def each(done: int) -> None:
        print("step", done, flush=True)
        if done == kill_at:
            os.kill(os.getpid(), signal.SIGKILL)

    torch.set_num_threads(1)
    face_model, sequence = toy_sequence(timesteps=5, size=32)
    train([sequence], face_model, CONFIG, replace(SETTINGS, steps=steps), Path(run_dir), progress(each))
