"""A package of a stranger adds an engine of `mien batch` by the recipe in CONTRIBUTING.md."""

import json
from pathlib import Path

import pytest

from batch_stub import PROGRAM
from forked import ForkServer
from mien.batch import Batch
from mien.cli import main
from toy_package import blocks, entry_points, help_of, install, mien

RECIPE = "Add an engine"
PLACE = 'Engine("mien_in_turn:run")'


def batch(server: ForkServer, folder: Path, *more: str, code: str | None = None) -> tuple[int, str]:
    """Run two rows on the engine of the recipe, or of other code, and return the exit code and what was told."""
    (recipe,) = blocks(RECIPE, "python")
    install(folder, "mien_in_turn", recipe if code is None else code, entry_points(RECIPE))
    (folder / "a.mp4").write_bytes(b"a video")
    (folder / "table.csv").write_text("name,video\nann,a.mp4\nbob,a.mp4\n")
    words = ("batch", str(folder / "table.csv"), "--out", str(folder / "out"), "--program", " ".join(PROGRAM))
    done = mien(server, folder, *words, *(more or ("--on", "in_turn")))
    return done.returncode, done.stderr


def test_an_engine_of_a_package_runs_rows(fork_server: ForkServer, tmp_path: Path) -> None:
    code, told = batch(fork_server, tmp_path)
    assert code == 0, told
    assert "2 to do on in_turn" in told
    done = Batch(tmp_path / "out")
    assert all(done.is_done(row) for row in done.read_plan())
    assert len(list(done.read_plan())) == 2
    listed = json.loads(mien(fork_server, tmp_path, "plugins", "--json").stdout)["engines"]
    assert listed["own"] == ["local", "slurm", "ray"]
    assert [(each["name"], each["package"], each["fault"]) for each in listed["added"]] == [
        ("in_turn", "mien-in-turn", None)
    ]
    assert "local, slurm, ray, in_turn" in help_of(fork_server, tmp_path, "batch")


def test_options_that_an_engine_does_not_heed_are_refused(fork_server: ForkServer, tmp_path: Path) -> None:
    code, told = batch(fork_server, tmp_path, "--on", "in_turn", "--partition", "long")
    assert (code, told) == (2, "mien: --partition: changes nothing for a batch that runs on in_turn; leave it out\n")


@pytest.mark.parametrize(
    ("code", "told"),
    [
        ("ENGINE = 1", "mien_in_turn:ENGINE: mien-in-turn adds it to mien.engines, and it is no Engine"),
        (f"from mien.batch import Engine\nENGINE = {PLACE}", "mien_in_turn:run: cannot be imported (AttributeError("),
    ],
)
def test_a_broken_engine_is_named(fork_server: ForkServer, tmp_path: Path, code: str, told: str) -> None:
    status, said = batch(fork_server, tmp_path, code=code)
    assert status == 2
    assert said.splitlines()[-1].startswith(f"mien: {told}")


def test_a_missing_module_of_an_engine_is_told_before_rows_are_read(fork_server: ForkServer, tmp_path: Path) -> None:
    engine = "Engine('mien_in_turn:run', packages=('mien_lacks_this',))"
    code, told = batch(fork_server, tmp_path, code=f"from mien.batch import Engine\nENGINE = {engine}")
    assert (code, told) == (
        2,
        "mien: --on in_turn: needs the module mien_lacks_this, which is not installed; install it\n",
    )
    assert not (tmp_path / "out").exists()


def test_an_unknown_engine_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "table.csv").touch()
    assert main(["batch", str(tmp_path / "table.csv"), "--out", str(tmp_path / "out"), "--on", "rya"]) == 2
    assert "no engine 'rya'; give one of local, slurm, ray" in capsys.readouterr().err
