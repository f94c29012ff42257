"""Tables become rows of `mien batch`; what it tells of its rows: results, the wall, the status and tables."""

import csv
import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from batch_stub import PROGRAM
from mien.batch.paper import write_table
from mien.batch.plan import Batch, Row, State
from mien.batch.results import write_results, write_wall
from mien.batch.row import write_strip
from mien.cli import main
from mien.commands import batch as batch_command
from mien.commands.batch_table import read_table
from mien.commands.parsing import parse
from mien.errors import UserError
from mien.media.video import write_video
from refusals import complaint, refuses
from test_startup import HEAVY, modules_after
from web_case import violations


def scored(batch: Batch) -> list[dict[str, object]]:
    """A batch of three people and two methods, with figures."""
    rows = [Row(*one) for one in (("ann", (), {"light": "sun"}), ("bob", (), {"light": "lamp"}), ("eve", (), {}))]
    batch.write_plan(rows)
    for index, row in enumerate(rows[:2]):
        figures = {"a": 30.0 + index, "b": 31.0 + 2 * index}
        runs = tuple({"run": m, "method": m, "psnr": psnr, "perceptual": 0.1} for m, psnr in figures.items())
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
    write_table(batch, rows, None)
    assert (tmp_path / "table.md").read_text().splitlines() == [
        "|  | PSNR, dB | SSIM | ST-LPIPS | state |",
        "|---|---|---|---|---|",
        "| a | 30.50 ± 0.71 | - | 0.100 ± 0.000 | run short: 2 of 3 subjects |",
        "| b | 32.00 ± 1.41 | - | 0.100 ± 0.000 | run short: 2 of 3 subjects |",
    ]
    assert r"30.50 $\pm$ 0.71" in (tmp_path / "table.tex").read_text()


@pytest.mark.slow
def test_the_wall_shows_the_worst_first_and_escapes_texts(tmp_path: Path):
    batch = Batch(tmp_path)
    (tmp_path / "rows" / "ann").mkdir(parents=True)
    (tmp_path / "rows" / "ann" / "me.html").touch()
    rows = scored(batch)
    write_wall(batch, [*rows, {**rows[0], "run": "not scored", "psnr": ""}])
    page = (tmp_path / "index.html").read_text()
    assert page.index("not scored") < page.index('data-psnr="30.0"'), "nobody knows how bad it is"
    assert page.index('data-psnr="30.0"') < page.index('data-psnr="31.0"') < page.index('data-psnr="33.0"')
    assert page.count('<a href="rows/ann/me.html">alive</a>') == 3  # it has three runs
    assert "rows/bob/me.html" not in page
    assert "&lt;b&gt;no face" in page
    assert "<b>no face" not in page
    assert "PSNR 30.00 dB" in page
    assert "Methods compared" in page
    for device in ([], ["dark", "touch"]):  # axe-core finds no fault
        assert violations(tmp_path / "index.html", (390, 844), device) == []
    # A film of any length has a thumbnail there.
    for count in (1, 3, 40):
        write_video(tmp_path / "film.mp4", (np.full((32, 32, 3), 6 * index, np.uint8) for index in range(count)), 25)
        write_strip(tmp_path / "film.mp4", tmp_path / "strip.jpg")
        with Image.open(tmp_path / "strip.jpg") as strip:
            assert strip.size == (12 * 160, 160)


def test_status_on_the_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any):
    scored(Batch(tmp_path))
    assert main(["batch", "status", str(tmp_path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["counts"] == {"done": 2, "failed": 1}
    # A missing engine is told before rows are read.
    monkeypatch.setattr(batch_command.importlib.util, "find_spec", lambda name: None)
    (tmp_path / "table.csv").write_text("nonsense\n")
    assert main(["batch", str(tmp_path / "table.csv"), "--out", str(tmp_path / "out"), "--on", "ray"]) == 2
    assert "pip install 'mien[batch]'" in capsys.readouterr().err


def test_what_makes_no_sense_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any):
    monkeypatch.chdir(tmp_path)
    scored(Batch(Path("DIR")))
    Path("TABLE").write_text("video\n")
    Batch(Path("OTHER")).write_plan([])
    plan = Path("OTHER/plan.json")
    plan.write_text(plan.read_text().replace('"version": 1', '"version": 99'))
    for line, told in (
        ("status DIR --rows light", "Unrecognized options: --rows"),
        ("TABLE --out DIR --gpus 1", "--gpus: changes nothing for --on local"),
        ("TABLE DIR --out OUT", "unknown: DIR"),
        ('TABLE --out DIR --program "echo \'x"', "--program echo 'x: No closing quotation"),
        ("TABLE --out DIR --store nosuch://x", "nosuch://x: cannot be reached"),
        ("status TABLE", "is not the folder of a batch"),
        ("status OTHER", "version 99, expected 'mien.batch' version 1"),
    ):
        assert told in complaint(capsys, "batch", *shlex.split(line))


def test_rows_of_an_earlier_table_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    scored(Batch(tmp_path / "out"))
    (tmp_path / "d.mp4").write_bytes(b"a video")
    (tmp_path / "table.csv").write_text("name,video\nann,d.mp4\n")
    line = ["batch", str(tmp_path / "table.csv"), "--out", str(tmp_path / "out"), "--program", "false", "--retry", "0"]
    assert main(line) == 2
    told = capsys.readouterr().err
    assert "2 rows of an earlier table will not be listed any more (bob, eve)" in told
    assert "1 of 1 row failed" in told


@pytest.fixture
def table(tmp_path: Path) -> Path:
    for name in ("ann", "bob"):
        (tmp_path / f"{name}.mp4").write_bytes(b"a video")
    path = tmp_path / "people.csv"
    rows = (",ann.mp4,gaussian_avatars;headgas,60,,30", "robert,bob.mp4,,,,41")
    path.write_text("\n".join(("name,video,methods,steps,hold_out,age", *rows, "")))
    return path


def test_rows_are_tracked_once_and_trained_by_each_method(table: Path):
    ann, bob = read_table(table)
    assert (ann.name, bob.name, ann.labels) == ("ann", "robert", {"age": "30"})
    made = ("--out", "{workspace}", "--method", "gaussian_avatars")
    assert ann.steps == (
        ("create", str(table.parent / "ann.mp4"), *made, "--steps", "60"),
        ("train", "{workspace}", "--method", "headgas", "--steps", "60"),
        ("evaluate", "{workspace}", "--run", "headgas"),
    )
    assert bob.steps == (("create", str(table.parent / "bob.mp4"), *made),)
    # A changed video changes the fingerprint.
    (table.parent / "bob.mp4").write_bytes(b"another video")
    again = [row.fingerprint for row in read_table(table)]
    assert (again[0] == ann.fingerprint, again[1] == bob.fingerprint) == (True, False)


def test_json_and_a_folder_of_videos_are_tables_as_well(table: Path):
    path = table.with_name("people.json")
    path.write_text(json.dumps([{"video": ["ann.mp4", "bob.mp4"], "name": "both", "capture.size": 256}]))
    (row,) = read_table(path)
    assert row.steps[0][1:3] == (str(table.parent / "ann.mp4"), str(table.parent / "bob.mp4"))
    assert row.steps[0][-2:] == ("--capture.size", "256")
    assert [row.name for row in read_table(table.parent)] == ["ann", "bob"]
    for content, words in (
        ('[{"video": "ann.mp4", "video": "bob.mp4"}]', "'video' twice"),
        ('[{"video": "ann.mp4", "capture": {"size": 9}}]', "column 'capture' holds an object"),
    ):
        path.write_text(content)
        refuses(words, read_table, path)
    table.write_bytes("name,video\nJosé,ann.mp4\n".encode("latin-1"))
    refuses("save it as UTF-8", read_table, table)


def test_options_of_create_count_for_all_rows_and_a_cell_goes_first(table: Path, tmp_path: Path):
    typed = ["people.csv", "--steps", "30", "--out", "people", "--capture.no-cuts", "--capture.size=256"]
    typed += ["--method", "textured_mesh", "--training.resolution", "96"]
    command = parse(batch_command, "batch", typed)
    assert (command.table, command.out) == (Path("people.csv"), Path("people"))
    ann, bob = (row.steps[0] for row in read_table(table, command.for_all))
    more = ("--capture.no-cuts", "--capture.size", "256", "--training.resolution", "96")
    made = ("--out", "{workspace}", "--method")
    assert ann == ("create", str(tmp_path / "ann.mp4"), *made, "gaussian_avatars", "--steps", "60", *more)
    assert bob == ("create", str(tmp_path / "bob.mp4"), *made, "textured_mesh", "--steps", "30", *more)


@pytest.mark.parametrize(("options", "words"), [
    ("--preset best", "row 1: invalid choice 'best' for argument '--preset'"),
    ("--view", "'view' cannot be set; nobody watches"),
    ("--steps 3 --steps 4", "--steps is given twice"),
    ("--capture.sizes 3", "row 1: Unrecognized options: --capture.sizes, 3; Perhaps you meant: --capture.size"),
    ("--name ann", "unknown: --name"),
])  # fmt: skip
def test_wrong_options_of_all_rows_are_named(table: Path, capsys: Any, options: str, words: str):
    assert words in complaint(capsys, "batch", str(table), "--out", str(table.parent / "out"), *options.split())


@pytest.mark.parametrize(("column", "typed"), [
    (("capture.cuts", "no"), ("--capture.no-cuts",)),
    (("capture.cuts", "yes"), ()),
    (("track_apart", "no"), ()),
    (("method.face-tuning.enabled", "no"), ("--method.face-tuning.enabled", "False")),
])  # fmt: skip
def test_cells_with_yes_and_no_are_flags(table: Path, column: tuple[str, str], typed: tuple[str, ...]):
    table.write_text(f"video,{column[0]}\nann.mp4,{column[1]}\n")
    (row,) = read_table(table)
    assert row.steps[0][6:] == typed


MISTAKES = [
    ("video,stepz\nann.mp4,3", "did you mean 'steps'"), ("video\ngone.mp4", "gone.mp4: no such file"),
    (f"video\n{'x' * 300}", "x: no such file"),
    ("video,method\nann.mp4,nerf", "nerf"), ("video,steps\nann.mp4,-3", "row 1: "),
    ("video,steps\nann.mp4,many", "row 1: --steps: 'many' is not a whole number"),
    ("video,preset\nann.mp4,best", "row 1: invalid choice 'best' for argument '--preset'"),
    ("video,capture.sizes\nann.mp4,9", "Perhaps you meant: --capture.size"),
    ("video,hold_out,hold-out\nann.mp4,3,4", "columns 'hold_out' and 'hold-out' are the same"),
    ("video,out\nann.mp4,elsewhere", "column 'out' cannot be set"),
    ("video,name\nann.mp4,x\nbob.mp4,x", "two rows have the name 'x'"),
    ("video,name\nann.mp4,../x", "cannot be the name of a folder"),
    ("name\nann", "row 1: has no video and no dataset; its columns are 'name'"),
    ("video,capture-size\nann.mp4,256", "did you mean 'capture.size'"),
    ("video,psnr\nann.mp4,256", "column 'psnr' is one of the results"),
    ("video,\nann.mp4,256", "a column has no name"),
    ("video,methods\nann.mp4,headgas;headgas", "method 'headgas' is there twice"),
    ("video\nann.mp4;ann.mp4", "two videos have the name 'ann'"),
    ("video,calibration\nann.mp4,rig.json", "rig.json: no such file"),
    ("video\nann.mp4,3", "more cells than the heading"), ("video,memory_gb\nann.mp4,lots", "gigabytes above 0"),
    ("", "has no rows"), ("video,protocol\nann.mp4,insta", "column 'protocol' is for datasets"),
    ("dataset,capture.size\nann.mp4,256", "column 'capture.size' is for videos"),
    ("dataset,video\nann.mp4,bob.mp4", "a video or a dataset, and not both"),
]  # fmt: skip


def test_mistakes_in_a_table_are_named_before_any_work(table: Path):
    for text, words in MISTAKES:
        table.write_text(text + "\n")
        with pytest.raises(UserError) as caught:
            read_table(table)
        assert words in str(caught.value)
        assert "\n" not in str(caught.value)


def test_the_driver_imports_neither_torch_nor_what_only_rows_need(table: Path, tmp_path: Path):
    run = ["batch", str(table), "--out", "people", "--program", shlex.join(PROGRAM)]
    looks = [["batch", "status", "people"]]
    for lines, needed in (([run], {"av", "cv2", "mien._native"}), (looks, {"mien._native"})):
        for code, modules in modules_after(lines, tmp_path):
            assert code == 0
            assert not modules & HEAVY - needed, f"{lines} imports {sorted(modules & HEAVY - needed)}"
    assert len(list((tmp_path / "people" / "states").glob("*.json"))) == 2


def test_datasets_are_imported_trained_and_scored(tmp_path: Path):
    """A person of IMavatar's layout."""
    clip = tmp_path / "subject3" / "subject3" / "MVI_1810"
    clip.mkdir(parents=True)
    (clip / "flame_params.json").write_text('{"frames": [{"world_mat": []}]}')
    table = tmp_path / "people.csv"
    head = "dataset,face_model,method,split,protocol,steps,training.resolution,age\n"
    table.write_text(head + "subject3,flame,headgas,dataset,imavatar,30,96,3\n")
    (row,) = read_table(table)
    assert (row.name, row.labels) == ("subject3", {"age": "3"})
    assert row.steps == (
        ("import", str(tmp_path / "subject3"), "--out", "{workspace}", "--resume", "--face-model", "flame"),
        ("train", "{workspace}", "--method", "headgas", "--split", "dataset", "--steps", "30",
         "--training.resolution", "96"),
        ("evaluate", "{workspace}", "--run", "headgas", "--protocol", "imavatar"),
    )  # fmt: skip
