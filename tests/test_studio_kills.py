"""Real makings of a studio: it says why one fails, and goes on after a kill in each stage."""

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

pytest.importorskip("starlette")

from capture_helpers import write_gradient_video
from mien.batch.plan import Batch
from mien.batch.progress import stage_of
from mien.studio.making import Maker, Settings
from mien.studio.people import People
from studio_case import SHORT, give_film, studio
from web_case import until

DAY = 86_400.0
STAGES = ("capture", "tracking", "alignment", "training", "scoring")
MADE = {"tracking": "sequences/film_1/capture/capture.json", "training": "sequences/film_1/tracking/tracking.json"}
"""A file that is whole when a stage begins. No later stage writes it again."""
SERVES = """
import sys
from pathlib import Path
sys.path.insert(0, {tests!r})
from studio_case import SHORT, studio
with studio(Path({root!r}), SHORT) as serving:
    serving.wait()
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("program", "words"),
    [
        (None, "no face"),
        (("/proc/nowhere/mien",), "No such file or directory"),
    ],
    ids=["without a face", "without a program"],
)
def test_a_making_that_fails_says_why(program: tuple[str, ...] | None, words: str, tmp_path: Path) -> None:
    """The first is made by mien itself, as in a studio that a person has started."""
    film, people = tmp_path / "grey.mp4", tmp_path / "people"
    write_gradient_video(film, frames=50)
    with studio(people, program) as serving:
        give_film(serving.maker.people, "Ada", film)
        serving.maker.add("Ada", Settings("draft", threads=1))
        until(lambda: serving.maker.progress("Ada").state == "failed", DAY)
        assert words in serving.maker.progress("Ada").error
        serving.maker.add("Ada", Settings("draft", threads=1))
        assert serving.maker.progress("Ada").state != "failed", "it is tried again"


@pytest.mark.unchecked
@pytest.mark.long
def test_a_studio_that_is_killed_in_each_stage_goes_on(tmp_path: Path, test_data: Path) -> None:
    """Kills the server with the process that makes the avatar. The test ends if the making fails, in whatever stage."""
    film = test_data / "cases" / "plain.mp4"
    give_film(People(tmp_path), "Ada", film)
    Maker(People(tmp_path), SHORT).add("Ada", Settings("draft", threads=1))
    batch, script = Batch(tmp_path / ".studio"), SERVES.format(tests=str(Path(__file__).parent), root=str(tmp_path))
    log, written = batch.log_file("Ada"), {}
    for stage in (*STAGES, None):
        before = log.stat().st_size if log.is_file() else 0
        process = subprocess.Popen([sys.executable, "-c", script], start_new_session=True)

        def reached(stage: str | None = stage, before: int = before, process: subprocess.Popen = process) -> bool:
            state = batch.read_state("Ada")
            assert process.poll() is None, "the studio has ended"
            assert state is None or state.status != "failed", state and state.error
            if state is not None and state.status == "done":
                return True
            name = stage_of(log, before).name if log.is_file() else ""
            return stage is not None and name in STAGES and STAGES.index(name) >= STAGES.index(stage)

        try:
            until(reached, DAY)
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        for begins, path in MADE.items():
            if stage is None or STAGES.index(stage) >= STAGES.index(begins):
                changed = (tmp_path / "Ada" / path).stat().st_mtime_ns
                assert written.setdefault(path, changed) == changed, f"{path}: was made again"
    state = batch.read_state("Ada")
    assert state is not None
    assert state.status == "done"
    assert state.tries == len(STAGES) + 1
    assert (tmp_path / "Ada" / "me.mien").is_file()
    assert (tmp_path / "Ada" / "films" / "film_1.mp4").read_bytes() == film.read_bytes()
