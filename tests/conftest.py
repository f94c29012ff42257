"""Share fixtures, let calls be checked where tests ask for it, and list the skipped tests at the end."""

import os
import shutil
import signal
from collections.abc import Callable, Iterator
from copy import deepcopy
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import torch
from filelock import FileLock
from hypothesis import settings

import checked_types  # before mien, see there
from instruction_sets import ISAS
from mien import _native
from needs import NO_GPU, NO_TEST_DATA, find_test_data, is_strict, skipped_lines, unexpected, use_instructions

# jaxtyping checks only modules that are imported after pytest has read this file, so fixtures import them at use.
if TYPE_CHECKING:
    from forked import ForkServer
    from mien.face import FaceModel
    from other_process import Holder

torch.set_num_threads(1)
# Without a GPU, Triton's interpreter runs kernels. It is chosen when Triton is imported.
if not torch.cuda.is_available():
    os.environ.setdefault("TRITON_INTERPRET", "1")
# The same examples on every machine, however busy it is.
settings.register_profile("mien", deadline=None, derandomize=True)
settings.load_profile("mien")

MOST_WORKERS = 8
"""Largest number of worker processes. More gain little, since things that are made once are waited for."""
MEMORY_OF_A_WORKER = 3 << 30
"""Memory that a worker needs, in bytes."""


@pytest.fixture(autouse=True)
def _hear_signals() -> Iterator[None]:
    """Let Ctrl-C and SIGHUP be heard, also where the tests run in the background or under nohup, which ignore them."""
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGHUP: signal.SIG_DFL}
    before = {number: signal.signal(number, handler) for number, handler in usual.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="session")
def test_data() -> Path:
    """Return the folder named by MIEN_TEST_DATA (default: ../shared/data beside the checkout)."""
    folder = find_test_data()
    if folder is None:
        pytest.skip(NO_TEST_DATA)
    return folder


@pytest.fixture(params=ISAS)
def isa(request: pytest.FixtureRequest) -> Iterator[str]:
    """Set an instruction set of the native core during a test, and restore the previous one afterwards."""
    before = _native.rasterize_isa()
    use_instructions(request.param)
    yield request.param
    assert _native.set_rasterize_isa(before)


@pytest.fixture(scope="module")
def anny() -> "FaceModel":
    from mien.face import load_face_model

    return load_face_model("anny")


@pytest.fixture(scope="module")
def short_films() -> Iterator[None]:
    """Let films of avatars have two pictures a second, for tests of a file that are about other things."""
    from mien.evaluation import living

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(living, "FPS", 2)
        yield


MadeOnce = Callable[[str, Callable[[Path], object]], Path]


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> MadeOnce:
    """Return a function that makes a folder once for all workers of this run.
    `made_once(name, make)` calls `make(folder)` in the first worker that asks for the name, without checks of types,
    and returns the folder, which is for reading. The others wait for it. Nothing is kept for the next run."""
    base = tmp_path_factory.getbasetemp()
    shared = (base.parent if os.environ.get("PYTEST_XDIST_WORKER") else base) / "made_once"
    shared.mkdir(exist_ok=True)

    def folder(name: str, make: Callable[[Path], object]) -> Path:
        place, done = shared / name, shared / f"{name}.done"
        with FileLock(shared / f"{name}.lock"):
            if not done.exists():
                shutil.rmtree(place, ignore_errors=True)  # of a worker that failed
                place.mkdir()
                with checked_types.unchecked():
                    make(place)
                done.touch()
        return place

    return folder


@pytest.fixture(scope="session")
def built(made_once: MadeOnce) -> Path:
    """Return a folder with a fresh build of the web runtime, for reading."""
    from web_case import build

    return made_once("web", build)


@pytest.fixture(scope="session")
def fork_server() -> "Iterator[ForkServer]":
    """Return a process that has imported torch and forks commands, which start at once (tests/forked.py)."""
    from forked import ForkServer

    with ForkServer() as server:
        yield server


def _holder() -> "Iterator[Holder]":
    """Return another process that holds locks."""
    from other_process import Holder

    holder = Holder()
    yield holder
    holder.kill()


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Let analyses train and draw in float64 in place of a GPU, and return the dtypes of what is drawn by the clock."""
    from mien.avatar.avatar import move_avatar
    from mien.lab.analysis import measuring, mono_gaussian_avatar, running
    from mien.training import run, trainer

    drawn, rasterize, write_avatar, write_tensors = set[str](), measuring.rasterize, run.write_avatar, run.write_tensors

    def draw(gaussians, *more):
        drawn.add(str(gaussians.means.dtype).removeprefix("torch."))
        return rasterize(gaussians, *more)

    for module in (measuring, mono_gaussian_avatar):
        monkeypatch.setattr(module, "rasterize", draw)

    # Files have float32, as those of a GPU.
    def write(folder, avatar):
        move_avatar(copied := deepcopy(avatar), torch.zeros(()))
        write_avatar(folder, copied)

    def write_short(path, tensors):
        write_tensors(path, {name: one.float() if one.is_floating_point() else one for name, one in tensors.items()})

    monkeypatch.setattr(run, "write_avatar", write)
    monkeypatch.setattr(run, "write_tensors", write_short)
    for module in (running, trainer):
        monkeypatch.setattr(module, "like_on", lambda _: torch.zeros((), dtype=torch.float64))
    return drawn


other = pytest.fixture(scope="module")(_holder)
mortal = pytest.fixture(_holder)
"""The same for a test that kills it."""


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Return the number of workers for `-n auto`: one for each core, as far as memory allows."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return max(1, min(len(os.sched_getaffinity(0)), MOST_WORKERS, memory // MEMORY_OF_A_WORKER))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.get_closest_marker("gpu") and not torch.cuda.is_available():
            item.add_marker(pytest.mark.skip(reason=NO_GPU))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    # Before the fixtures of the test, so that what they make for others is checked or not by the same rule.
    checked_types.check_types(item.get_closest_marker("unchecked") is None)


def pytest_sessionfinish(session: pytest.Session) -> None:
    # With workers, only the process that started them has a terminal reporter with all results.
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if reporter and is_strict() and unexpected(_skip_reasons(reporter)) and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    reasons = _skip_reasons(terminalreporter)
    terminalreporter.section("skipped")
    for line in skipped_lines(reasons):
        terminalreporter.write_line(line)
    if is_strict() and (missing := unexpected(reasons)):
        terminalreporter.write_line(f"MIEN_STRICT is set, so this is an error: {'; '.join(missing)}")


def _skip_reasons(reporter: pytest.TerminalReporter) -> list[str]:
    return [report.longrepr[2] for report in reporter.stats.get("skipped", [])]
