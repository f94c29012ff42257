"""Seconds, cores and memory of each stage of a command, kept with the workspace."""

import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from mien import _native
from mien.disk.files import read_json, write_json
from mien.errors import UserError
from mien.machine.system import peak_memory_mb

FILE_NAME = "stages.json"
_FORMAT, _VERSION = "mien.stage_times", 1
_NOTHING_TO_DO = 0.1  # share of the earlier time


@dataclass(frozen=True)
class StageTime:
    """The time and memory that one stage took."""

    seconds: float
    """Time that passed, in seconds."""
    processor: float
    """Processor time of all threads, and of child processes that have ended, in seconds."""
    memory: float = 0.0
    """The most memory that the process has taken by the end of the stage, in MiB."""

    @property
    def cores(self) -> float:
        """The number of cores in use, on average."""
        return self.processor / self.seconds if self.seconds else 0.0


class StageTimes:
    """The time of each stage by name, kept in a file.

    A stage that takes less than a tenth of its earlier time had nothing to do, and the earlier time stays.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            content = read_json(path, _FORMAT, _VERSION)["stages"]
            self.stages = {name: StageTime(**own) for name, own in content.items()}
        except (UserError, TypeError, AttributeError, KeyError):  # it is only measured anew
            self.stages: dict[str, StageTime] = {}

    @contextmanager
    def measured(self, stage: str) -> Iterator[None]:
        """Measure the time inside the context."""
        _native.release_memory()  # What the stages before took
        began, processor = time.monotonic(), _processor_seconds()
        yield
        spent = StageTime(
            round(time.monotonic() - began, 1), round(_processor_seconds() - processor, 1), round(peak_memory_mb(), 0)
        )
        if stage in self.stages and spent.seconds < _NOTHING_TO_DO * self.stages[stage].seconds:
            return
        self.stages[stage] = spent
        write_json(self._path, _FORMAT, _VERSION, {"stages": {key: asdict(own) for key, own in self.stages.items()}})

    @contextmanager
    def one_by_one(self, begin: Callable[[str], None]) -> Iterator[Callable[[str], None]]:
        """Give `begin`, which measures each stage until the next one begins."""
        with ExitStack() as running:

            def next_stage(name: str) -> None:
                running.close()
                begin(name)
                running.enter_context(self.measured(name))

            yield next_stage

    def seconds(self) -> dict[str, float]:
        """Seconds by stage."""
        return {name: own.seconds for name, own in self.stages.items()}

    def told(self) -> str:
        """Tell people what took a second or more: "tracking 120 s on 1.8 cores, training 364 s on 1.4"."""
        long = {name: own for name, own in self.stages.items() if own.seconds >= 1}
        each = ", ".join(f"{name} {own.seconds:.0f} s on {own.cores:.1f} cores" for name, own in long.items())
        most = max((own.memory for own in self.stages.values()), default=0.0)
        return each + (f"; {most * 2**20 / 1e9:.1f} GB of memory" if most else "")


def _processor_seconds() -> float:
    return sum(os.times()[:4])
