"""`mien batch`: rows run once, failures stay alone, lost processes are taken up, and strangers' tables do no harm."""

import csv
import json
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

import pytest

from batch_stub import PROGRAM, do_stub, drive_rows, ended, stub_row, wait_for_begin
from forked import ForkServer
from known import known
from mien.batch.drive import shard_of
from mien.batch.paper import write_table
from mien.batch.plan import Batch, Row, State
from mien.batch.progress import batch_progress, progress_text
from mien.batch.results import write_results
from mien.batch.row import attempt, run_row, write_strip
from mien.cli import main
from mien.commands.batch_table import read_table
from mien.disk.files import write_atomically
from mien.disk.locks import hold
from other_process import Holder
from refusals import refuses


def run_stubs(batch: Batch, rows: list[Row], **options: object) -> dict[str, str]:
    batch.write_plan(rows)
    drive_rows(batch, rows, **options)
    return {row["name"]: row["status"] for row in batch_progress(batch)["rows"]}


def test_a_process_that_never_claims_its_row_fails_anew_each_time(tmp_path: Path):
    """The error is that of the last try, and tries are counted."""
    batch, row = Batch(tmp_path), stub_row("ann")
    batch.write_plan([row])
    silent = "its process printed nothing and ended with exit code"
    programs = ("false", f"{silent} 1"), ("sh -c \"echo 'mien: no room'; exit 7\"", "no room"), ("true", f"{silent} 0")
    for tries, (program, told) in enumerate(programs, start=1):
        drive_rows(batch, [row], retry=0, program=program)
        state = known(batch.read_state("ann"))
        assert (state.status, state.tries) == ("failed", tries)
        assert state.error.startswith(told)


def test_slurm_waits_for_the_rows_of_a_driver_that_was_killed(tmp_path: Path, mortal: Holder, monkeypatch):
    batch, row, queued = Batch(tmp_path / "people"), stub_row("long", ("sleep", "0")), tmp_path / "queued"
    batch.write_plan([row])
    (tmp_path / "squeue").write_text(f"#!/bin/sh\ncat {queued} 2>/dev/null; true\n")
    (tmp_path / "squeue").chmod(0o755)
    queued.write_text("77_0 RUNNING\n")
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setattr("mien.batch.engines.POLL_SECONDS", 0.05)
    (batch.root / "slurm").mkdir()
    (batch.root / "slurm" / "jobs.txt").write_text("77")

    def finish() -> None:
        with mortal.holding(batch.state_file("long")):
            held.set()
            time.sleep(0.5)
            batch.write_state(State("long", "done", row.fingerprint))
        queued.unlink()

    held = threading.Event()
    task = threading.Thread(target=finish)
    task.start()
    assert held.wait(30)
    drive_rows(batch, [row], on="slurm")
    assert not queued.exists()
    assert batch.is_done(row)
    task.join()


def test_what_killed_processes_left_beside_the_states_is_removed_in_the_end(tmp_path: Path):
    batch, long = Batch(tmp_path), "l" * 120
    rows = [stub_row("killed", ("sleep", "0")), stub_row(long, ("sleep", "0")), stub_row("other", ("sleep", "0"))]
    assert set(run_stubs(batch, rows).values()) == {"done"}
    left = [tmp_path / "states" / name for name in (".killed.json.ab_9.json", f".{long[:100]}.ab_9.json")]
    left.append(tmp_path / "states" / ".killed.json.lock")
    held = tmp_path / "states" / ".other.json.ab_9.json"
    for path in (*left, held):
        path.touch()
    with hold(batch.state_file("other")):
        run_stubs(batch, rows)
        assert held.exists()
    assert sorted(path.name for path in (tmp_path / "states").glob(".*")) == [held.name]


def test_shards_share_all_rows_out():
    rows = [Row(str(index), ()) for index in range(10)]
    shards = [row.name for index in (1, 2, 3) for row in shard_of(rows, f"{index}/3")]
    assert sorted(shards) == [row.name for row in rows]
    for wrong in ("0/3", "4/3", "1", "a/b", "-1/3"):
        refuses("--shard", shard_of, rows, wrong)


def test_a_failing_row_stops_no_other_and_is_tried_again(tmp_path: Path):
    batch = Batch(tmp_path)
    rows = [stub_row("bad", ("fail", "no face")), stub_row("good", ("sleep", "0"))]
    rows.append(stub_row("second", ("once", "a hiccup"), ("value", "20")))
    assert run_stubs(batch, rows) == {"bad": "failed", "good": "done", "second": "done"}
    begins = (tmp_path / "begins.txt").read_text()
    assert [begins.count(f"begin {name} ") for name in ("bad", "good", "second")] == [2, 1, 2]
    found = {row["name"]: row for row in batch_progress(batch)["rows"]}
    assert (found["bad"]["error"], found["bad"]["tries"]) == ("no face", 2)
    text = progress_text(batch_progress(batch))
    assert "bad: failed on " in text
    assert "repeat it: mien fail 'no face'" in text
    drive_rows(batch, rows)  # what is done is skipped
    assert (tmp_path / "begins.txt").read_text().count("begin good ") == 1


def test_a_row_whose_process_is_killed_is_tried_again(tmp_path: Path, fork_server: ForkServer):
    batch, other = Batch(tmp_path), stub_row("other", ("sleep", "0"))
    batch.write_plan([stub_row("victim", ("wait", "go"), ("value", "21")), other])
    running = fork_server.call("batch_stub:drive_stubs", str(tmp_path))
    os.kill(wait_for_begin(tmp_path, "victim"), signal.SIGKILL)
    (tmp_path / "go").touch()
    assert running.wait() == 0
    state = known(batch.read_state("victim"))
    assert (state.status, state.tries, state.runs[0]["psnr"]) == ("done", 2, 21.0)
    assert batch.is_done(other)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_rows_stop_with_their_driver_and_the_same_command_continues(tmp_path: Path, number: int, fork_server):
    batch = Batch(tmp_path)
    batch.write_plan([stub_row(name, ("wait", "never")) for name in ("long", "second", "queued")])
    running = fork_server.call("batch_stub:drive_stubs", str(tmp_path))
    pid = wait_for_begin(tmp_path, "long")
    assert batch_progress(batch)["rows"][0]["status"] == "running"
    running.send_signal(number)
    running.wait()
    assert ended(pid)
    assert batch_progress(batch)["rows"][0]["status"] == "interrupted"
    assert run_stubs(batch, [stub_row("long", ("sleep", "0"))]) == {"long": "done"}


def test_what_runs_is_shown_before_a_row_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    batch, row = Batch(tmp_path), stub_row("ann", ("wait", "shown"))
    batch.write_plan([row])

    @contextmanager
    def bar(*_: object) -> Iterator[Callable[..., None]]:
        yield lambda amount=1, status="": (tmp_path / "shown").touch() if "ann: running" in status else None

    monkeypatch.setattr("mien.batch.drive.progress_bar", bar)
    monkeypatch.setattr("mien.batch.drive.LOOK_SECONDS", 0.05)
    drive_rows(batch, [row])
    assert batch.is_done(row)


def test_the_percentage_is_that_of_the_present_stage(tmp_path: Path, mortal: Holder):
    batch, (row, *others) = Batch(tmp_path), (stub_row("long"), stub_row("done"), stub_row("failed"))
    batch.write_plan([row, *others])
    batch.write_state(State("done", "done", others[0].fingerprint, seconds=10.0))
    batch.write_state(State("failed", "failed", others[1].fingerprint, seconds=10.0))
    log = batch.log_file("long")
    log.parent.mkdir(parents=True)
    with mortal.holding(batch.state_file("long")):
        batch.write_state(State("long", "running", row.fingerprint, 1, "here", time.time()))
        for more, stage, percent in (
            ("", None, None),
            ("stage 2 of 4 (tracking), about 9 min left\nOverlay: 100/100 in 5 s\n", "tracking (2 of 4)", 100),
            ("stage 3 of 4 (training), about 3 min left\n", "training (3 of 4)", None),
            ("training: 200/800 in 9 s, ETA 6 s\rstage 3 of 4 (training), about 2 min left\n", "training (3 of 4)", 25),
            ("training: 400/800 in 9 s, ETA 6 s\n" * 1000, "training (3 of 4)", 50),
        ):
            with log.open("a") as file:
                file.write(more)
            found = batch_progress(batch)["rows"][0]
            assert (found["stage"], found["percent"]) == (stage, percent)
        assert batch_progress(batch)["seconds_left"] == 10, "what failed is not waited for"


def test_a_row_that_another_command_holds_is_left_to_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    claims, batch, row = [], Batch(tmp_path), stub_row("held", ("sleep", "0"))
    with hold(batch.state_file("held")):
        assert run_row(batch, row, do_stub) is None
    assert not (tmp_path / "begins.txt").exists()
    monkeypatch.setattr("mien.batch.row.hold", lambda *places: claims.append(places) or hold(*places))
    assert run_stubs(batch, [row]) == {"held": "done"}
    assert claims == []  # the row's own process has the only claim


def test_memory_is_counted_before_rows_run_side_by_side(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("mien.batch.engines.free_memory_mb", lambda: 1000.0)
    rows = [stub_row(f"big{index}", ("sleep", "0.3"), memory_mb=700.0) for index in range(2)]
    rows.append(stub_row("huge", ("sleep", "0.1"), memory_mb=5000.0))
    assert set(run_stubs(Batch(tmp_path), rows, jobs=4).values()) == {"done"}
    words = [line.split()[0] for line in (tmp_path / "begins.txt").read_text().splitlines()]
    assert words == ["begin", "end"] * 3


def test_workspaces_go_through_a_store(tmp_path: Path):
    pytest.importorskip("fsspec")
    store = tmp_path / "store/away"
    check_store(Batch(tmp_path / "batch"), f"file://{store.parent}")
    assert {path.name: path.read_text() for path in store.iterdir()} == {"kept": "away\naway\n"}


def check_store(batch: Batch, store: str, *steps: tuple[str, str]) -> None:
    """Run a row through a store whose second try finds the workspace of the first."""
    first = [stub_row("away", ("make", "kept"), ("make", "passing"), ("fail", "no face"))]
    assert run_stubs(batch, first, store=store, retry=0) == {"away": "failed"}
    row = stub_row("away", ("make", "kept"), ("drop", "passing"), *steps)
    assert run_stubs(batch, [row], store=store) == {"away": "done"}
    assert (batch.log_file("away")).is_file()
    assert not (batch.root / "begins.txt").exists()  # it ran elsewhere


@pytest.mark.parametrize(("name", "text"), [
    ("a.csv", "video,preset\nann.mp4,draft;--out;/elsewhere\n"),
    ("a.csv", "video;preset\nann.mp4;--out=/elsewhere\n"),
    ("a.csv", "video,capture.mattes\nann.mp4,-o\n"),
    ("a.json", json.dumps([{"video": "ann.mp4", "preset": ["draft", "--out", "/elsewhere"]}])),
])  # fmt: skip
def test_a_cell_is_never_an_option(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / "ann.mp4").touch()
    (tmp_path / name).write_text(text)
    refuses(r"row 1: column '(preset|capture.mattes)' holds '-.*would be an option; give", read_table, tmp_path / name)


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
    refuses("is a link, and links", way, "ann")
    if place.startswith("logs"):
        refuses("is a link, and links", attempt, batch.root, PROGRAM, None, stub_row("ann"))
    assert outside.read_text() == "mine" if "." in place else not any(outside.iterdir())


def hostile(**given: object) -> str:
    whole = asdict(State("ann", "done", "", runs=({"run": "a", "method": "a", "psnr": 30.0},)))
    return json.dumps({"format": "mien.batch-row", "version": 1, **whole, **given})


@pytest.mark.parametrize("content", [
    "[" * 100_000 + "]" * 100_000,
    hostile(seconds=0).replace('"seconds": 0', '"seconds": ' + "9" * 400),
    hostile(runs=[{"run": "a", "method": "a", "psnr": 0}]).replace('"psnr": 0', '"psnr": ' + "9" * 400),
    hostile(runs=[{"run": "a", "method": ["a"]}]),
    hostile(runs=[{"run": "a", "method": "a", "psnr": {"deep": []}}]),
    hostile(runs=[1]),
    hostile(began=1e308, seconds=1e308, status="running"),
    hostile(seconds=float("nan")),
    hostile(mien=["0"]),
    hostile(version=99),
    hostile(stages={"a": "x"}),
    hostile(status="bogus"),
    "{",
])  # fmt: skip
def test_hostile_states_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str) -> None:
    batch = Batch(tmp_path)
    batch.write_plan([Row("ann", ()), Row("bob", ())])
    batch.write_state(State("bob", "done", "", runs=({"run": "a", "method": "a", "psnr": 31.0},)))
    batch.state_file("ann").write_text(content)
    assert main(["batch", "status", str(tmp_path)]) == 0
    assert f"ann: failed, try 1: {batch.state_file('ann')}: " in capsys.readouterr().out
    write_table(batch, write_results(batch), None)
    assert "| a | 31.00 | - | - | run short: 1 of 2 subjects |" in (tmp_path / "table.md").read_text()


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
    refuses(r"film\.mp4: is a playlist, a manifest or a link", write_strip, tmp_path / "film.mp4", tmp_path / "a.jpg")
