"""What `mien batch` tells of its rows: results, the wall, the status and tables."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mien.batch import Batch, Row, State, latex_table, markdown_table, means_by, write_results, write_wall
from mien.batch.steps import _write_strip
from mien.capture.video import write_video
from mien.cli import main
from mien.commands import batch as batch_command
from mien.errors import UserError
from web_case import violations


def scored(batch: Batch) -> list[dict[str, object]]:
    """A batch of three people and two methods, with figures."""
    rows = []
    for person, light in (("ann", "sun"), ("bob", "lamp"), ("eve", "sun")):
        rows.append(Row(person, (), {"light": light}))
    batch.write_plan(rows)
    for index, row in enumerate(rows[:2]):
        runs = tuple(
            {"run": m, "method": m, "psnr": 30.0 + index + gain, "perceptual": 0.1}
            for m, gain in (("a", 0.0), ("b", 1.0 + index))
        )
        batch.write_state(State(row.name, "done", "", runs=runs, stages={"training": 3.0}))
    batch.write_state(State("eve", "failed", "", error="=cmd: <b>no face</b>"))
    return write_results(batch)


def test_results_have_all_figures_and_paired_differences(tmp_path: Path):
    batch = Batch(tmp_path)
    rows = scored(batch)
    with (tmp_path / "results.csv").open() as file:
        table = list(csv.DictReader(file))
    assert [(row["name"], row["run"], row["psnr"]) for row in table[:2]] == [("ann", "a", "30.0"), ("ann", "b", "31.0")]
    assert table[-1]["error"] == "'=cmd: <b>no face</b>"
    content = json.loads((tmp_path / "results.json").read_text())
    difference = next(each for each in content["comparison"] if each.get("minus") == "b" and each["metric"] == "psnr")
    assert difference["mean"] == -1.5
    # t(0.975, 1) = 12.7062, standard error 0.5
    assert difference["interval"] == pytest.approx([-7.8531, 4.8531], abs=1e-4)
    table = means_by(rows, "method", ["psnr", "lpips"])
    assert table == [
        ["method", "n", "psnr", "lpips"],
        ["a", "2", "30.50 ± 0.71", "0.100 ± 0.000"],
        ["b", "2", "32.00 ± 1.41", "0.100 ± 0.000"],
    ]
    assert markdown_table(table).splitlines()[1] == "|---|---|---|---|"
    assert r"30.50 $\pm$ 0.71" in latex_table(table)
    with pytest.raises(UserError, match="no such column"):
        means_by(rows, "gone", ["psnr"])


def test_the_wall_shows_the_worst_first_and_escapes_texts(tmp_path: Path):
    batch = Batch(tmp_path)
    write_wall(batch, scored(batch))
    page = (tmp_path / "index.html").read_text()
    assert page.index('data-psnr="30.0"') < page.index('data-psnr="31.0"') < page.index('data-psnr="33.0"')
    assert "&lt;b&gt;no face" in page
    assert "<b>no face" not in page
    assert "PSNR 30.00 dB" in page
    assert "Methods compared" in page


@pytest.mark.slow
@pytest.mark.parametrize("device", [[], ["dark", "touch"]])
def test_everybody_can_use_the_wall(tmp_path: Path, device: list[str]):
    """axe-core finds no fault in it."""
    batch = Batch(tmp_path)
    write_wall(batch, scored(batch))
    assert violations(tmp_path / "index.html", (390, 844), device) == []


def test_status_and_table_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    scored(Batch(tmp_path))
    assert main(["batch", "status", str(tmp_path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["counts"] == {"done": 2, "failed": 1}
    assert main(["batch", "table", str(tmp_path), "--rows", "light", "--columns", "psnr"]) == 0
    assert "| sun | 2 |" in capsys.readouterr().out
    assert main(["batch", "status", str(tmp_path / "gone")]) == 2
    assert "is not the folder of a batch" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["status", "DIR", "--rows", "light"], "--rows: changes nothing for `mien batch status`"),
        (["table", "DIR", "--watch"], "--watch: changes nothing for `mien batch table`"),
        (["TABLE", "--out", "DIR", "--columns", "ssim"], "--columns: changes nothing for a batch that runs on local"),
        (["TABLE", "--out", "DIR", "--gpus", "1"], "--gpus: changes nothing for a batch that runs on local"),
        (["status", "DIR", "--shard", "1/2"], "--shard: changes nothing for `mien batch status`"),
        (["TABLE", "--out", "DIR", "--program", "echo 'x"], "--program echo 'x: No closing quotation"),
        (["TABLE", "--out", "DIR", "--store", "nosuch://x"], "nosuch://x: cannot be reached"),
        (["status", "TABLE"], "is not the folder of a batch"),
        (["table", "EMPTY"], "no row is done yet"),
        (["status", "OTHER"], "version 99, expected 'mien.batch' version 1"),
    ],
)
def test_what_makes_no_sense_is_told(words: list[str], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    scored(Batch(tmp_path / "DIR"))
    (tmp_path / "TABLE").write_text("video\n")
    Batch(tmp_path / "EMPTY").write_plan([Row("ann", (("create",),), fingerprint="a")])
    Batch(tmp_path / "OTHER").write_plan([])
    plan = tmp_path / "OTHER" / "plan.json"
    plan.write_text(plan.read_text().replace('"version": 1', '"version": 99'))
    assert main(["batch", *(str(tmp_path / word) if word.isupper() else word for word in words)]) == 2
    assert told in capsys.readouterr().err


def test_a_missing_engine_is_told_before_rows_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any):
    monkeypatch.setattr(batch_command.importlib.util, "find_spec", lambda name: None)
    (tmp_path / "table.csv").write_text("nonsense\n")
    assert main(["batch", str(tmp_path / "table.csv"), "--out", str(tmp_path / "out"), "--on", "ray"]) == 2
    assert "pip install 'mien[batch]'" in capsys.readouterr().err


@pytest.mark.parametrize(
    "changed",
    [
        None, {"version": 99},
        {"status": []}, {"status": "bogus"}, {"runs": [1]}, {"stages": "x"}, {"stages": {"a": "x"}},
        {"began": float("nan")}, {"tries": None},
    ],
    ids=str,
)  # fmt: skip
def test_any_damage_of_a_state_is_shown(
    changed: dict[str, Any] | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    batch = Batch(tmp_path)
    scored(batch)
    file = batch.state_file("ann")
    file.write_text("{" if changed is None else json.dumps(json.loads(file.read_text()) | changed))
    assert main(["batch", "status", str(tmp_path)]) == 0
    assert "ann: failed, try 1: " in capsys.readouterr().out
    assert main(["batch", "table", str(tmp_path), "--columns", "psnr"]) == 0
    assert "| a | 1 | 31.00 |" in capsys.readouterr().out


def test_rows_of_an_earlier_table_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    scored(Batch(tmp_path / "out"))
    (tmp_path / "d.mp4").write_bytes(b"a video")
    (tmp_path / "table.csv").write_text("name,video\nann,d.mp4\n")
    line = ["batch", str(tmp_path / "table.csv"), "--out", str(tmp_path / "out"), "--program", "false", "--retry", "0"]
    assert main(line) == 2
    told = capsys.readouterr().err
    assert "2 rows of an earlier table will not be listed any more (bob, eve)" in told
    assert "1 of 1 row failed" in told


@pytest.mark.parametrize("count", [1, 3, 40])
def test_a_film_of_any_length_has_a_thumbnail(count: int, tmp_path: Path):
    pictures = (np.full((32, 32, 3), 6 * index, np.uint8) for index in range(count))
    write_video(tmp_path / "film.mp4", pictures, 25)
    _write_strip(tmp_path / "film.mp4", tmp_path / "strip.jpg")
    with Image.open(tmp_path / "strip.jpg") as strip:
        assert strip.size == (12 * 160, 160)
