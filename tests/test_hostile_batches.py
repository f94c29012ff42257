"""Batches and tables of strangers: cells that are options, links, states that no program wrote, formulas, umasks."""

import csv
import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from batch_stub import PROGRAM, stub_row
from mien.batch import Batch, Row, State, write_results
from mien.batch.row import attempt
from mien.batch.steps import write_strip
from mien.cli import main
from mien.commands.stages.batch_table import read_table
from mien.errors import UserError
from mien.files import write_atomically


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Run a command that must be refused in one line, and return the line."""
    capsys.readouterr()
    assert main(list(arguments)) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("mien: ")]
    return line


@pytest.mark.parametrize(("name", "text"), [
    ("a.csv", "video,preset\nann.mp4,draft;--out;/elsewhere\n"),
    ("a.csv", "video;preset\nann.mp4;--out=/elsewhere\n"),
    ("a.csv", "video,capture.mattes\nann.mp4,-o\n"),
    ("a.json", json.dumps([{"video": "ann.mp4", "preset": ["draft", "--out", "/elsewhere"]}])),
])  # fmt: skip
def test_a_cell_is_never_an_option(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / "ann.mp4").touch()
    (tmp_path / name).write_text(text)
    with pytest.raises(UserError, match=r"row 1: column '(preset|capture.mattes)' holds '-.*would be an option; give"):
        read_table(tmp_path / name)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le"])
@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_a_table_is_read_as_spreadsheets_save_it(tmp_path: Path, separator: str, encoding: str) -> None:
    (tmp_path / "änn.mp4").touch()
    (tmp_path / "bob.mp4").touch()
    cells = (("name", "video", "age", "capture.start"), ("who", '"änn.mp4;bob.mp4"', "31", '"0,5"'))
    text = "".join(separator.join(line) + "\r\n" for line in cells)
    (tmp_path / "a.csv").write_bytes(text.encode(encoding))
    (row,) = read_table(tmp_path / "a.csv")
    assert (row.name, row.labels) == ("who", {"age": "31"})
    assert row.steps[0][:3] == ("create", str(tmp_path / "änn.mp4"), str(tmp_path / "bob.mp4"))
    assert row.steps[0][-2:] == ("--capture.start", "0.5")


@pytest.mark.parametrize("place", ["states", "states/ann.json", "logs", "logs/ann.log", "rows", "rows/ann", "thumbs"])
def test_no_link_in_a_batch_is_followed(tmp_path: Path, place: str) -> None:
    batch, outside = Batch(tmp_path / "people"), tmp_path / "outside"
    link = batch.root / place
    link.parent.mkdir(parents=True)
    if "." in place:
        outside.write_text("mine")
    else:
        outside.mkdir()
    link.symlink_to(outside)
    ways = {"states": batch.state_file, "logs": batch.log_file, "rows": batch.workspace}
    way = ways.get(place.split("/")[0], lambda name: batch.place("thumbs", f"{name}.jpg"))
    with pytest.raises(UserError, match="is a link, and links"):
        way("ann")
    if place.startswith("logs"):
        with pytest.raises(UserError, match="is a link, and links"):
            attempt(batch.root, stub_row("ann"), PROGRAM)
    assert outside.read_text() == "mine" if "." in place else not any(outside.iterdir())


def hostile(**given: object) -> str:
    whole = {"name": "ann", "status": "done", "fingerprint": "", "runs": [{"run": "a", "method": "a", "psnr": 30.0}]}
    return json.dumps({"format": "mien.batch-row", "version": 1, **whole, **given})


@pytest.mark.parametrize("content", [
    "[" * 100_000 + "]" * 100_000,
    hostile(seconds=0).replace('"seconds": 0', '"seconds": ' + "9" * 400),
    hostile(runs=[{"run": "a", "method": "a", "psnr": 0}]).replace('"psnr": 0', '"psnr": ' + "9" * 400),
    hostile(runs=[{"run": "a", "method": ["a"]}]),
    hostile(runs=[{"run": "../../a", "method": "a"}]),
    hostile(runs=[{"run": "a", "method": "a", "psnr": {"deep": []}}]),
    hostile(runs=[1]),
    hostile(began=1e308, seconds=1e308, status="running"),
    hostile(seconds=float("nan")),
    hostile(mien=["0"]),
    hostile(stages={"a\x1b[2J": 1.0}),
])  # fmt: skip
def test_hostile_states_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str) -> None:
    batch = Batch(tmp_path)
    batch.write_plan([Row("ann", ())])
    batch.state_file("ann").parent.mkdir()
    batch.state_file("ann").write_text(content)
    assert main(["batch", "status", str(tmp_path)]) == 0
    assert f"{batch.state_file('ann')}: damaged (" in capsys.readouterr().out.replace("\n", "")
    assert "no row is done yet" in refused(capsys, "batch", "table", str(tmp_path))


def test_formulas_in_headings_are_defused(tmp_path: Path) -> None:
    batch = Batch(tmp_path)
    labels = {name: name for name in ("=HYPERLINK(1)", "+1", "-1", "@x", "\tx", "age")}
    batch.write_plan([Row("ann", (), labels)])
    write_results(batch)
    with (tmp_path / "results.csv").open(newline="", encoding="utf-8") as file:
        heading, row = csv.reader(file)
    assert heading[2:] == row[2:] == ["'=HYPERLINK(1)", "'+1", "'-1", "'@x", "'\tx", "age"]


@pytest.fixture
def restored_umask() -> Iterator[None]:
    before = os.umask(0)
    yield
    os.umask(before)


@pytest.mark.parametrize(("mask", "mode"), [(0o077, 0o600), (0o022, 0o644), (0o002, 0o664)])
@pytest.mark.usefixtures("restored_umask")
def test_outputs_follow_the_umask(tmp_path: Path, mask: int, mode: int) -> None:
    os.umask(mask)
    Batch(tmp_path).write_state(State("ann", "done", ""))
    write_atomically(tmp_path / "a.txt", lambda path: path.write_text("a"))
    for path in (tmp_path / "a.txt", tmp_path / "states" / "ann.json"):
        assert path.stat().st_mode & 0o777 == mode


def test_a_list_of_files_is_no_film(tmp_path: Path) -> None:
    (tmp_path / "film.mp4").write_text("ffconcat version 1.0\nfile secret.mp4\n")
    with pytest.raises(UserError, match=r"film\.mp4: is a list of files"):
        write_strip(tmp_path / "film.mp4", tmp_path / "a.jpg")
