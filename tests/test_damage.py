"""Every reader meets every kind of damage: one line of complaint that names the file, or content that can be used.

The readers are the table `fuzzing.targets`, the damage is `fuzzing.faults`, `formats` and `values`, and the judge is
`fuzzing.judge`: no traceback, no hang, no memory beyond a bound, no byte outside. `make fuzz` draws from these tables.
Cases run in other processes, so that a crashing decoder spares the tests.
"""

from pathlib import Path

import pytest

from forked import ForkServer
from fuzzing.faults import FIXED
from fuzzing.material import quick_material
from fuzzing.values import VALUES
from shared_things import MadeOnce


@pytest.fixture
def material(made_once: MadeOnce) -> Path:
    """Return a folder with a whole file of each kind."""
    return quick_material(made_once)


def check(server: ForkServer, name: str, tmp_path: Path, material: Path, *arguments: object) -> None:
    process = server.call(f"fuzzing.checks:{name}", str(tmp_path / "b"), str(material), *arguments)
    assert process.wait() == 0, process.stdout + process.stderr[-6000:]


@pytest.mark.parametrize("kind", FIXED)
def test_any_file_can_be_damaged(kind: str, fork_server: ForkServer, tmp_path: Path, material: Path) -> None:
    check(fork_server, "check_damage", tmp_path, material, kind)


@pytest.mark.parametrize("name", VALUES)
def test_values_that_cannot_be(name: str, fork_server: ForkServer, tmp_path: Path, material: Path) -> None:
    """Every file has the right checksum, or none, since whoever makes a file can make its checksum."""
    check(fork_server, "check_values", tmp_path, material, name)


def test_random_faults(fork_server: ForkServer, tmp_path: Path, material: Path) -> None:
    check(fork_server, "check_random", tmp_path, material, 0, 150)


def test_corrected_checksums_hide_no_fault(fork_server: ForkServer, tmp_path: Path, material: Path) -> None:
    check(fork_server, "check_repairs", tmp_path, material)


def test_readers_that_are_wrong_are_found(fork_server: ForkServer, tmp_path: Path, material: Path) -> None:
    check(fork_server, "check_judge", tmp_path, material)
