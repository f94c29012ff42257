"""Tables become rows: commands of mien, labels, fingerprints, and what is told of mistakes."""

import json
import shlex
from pathlib import Path

import pytest

from batch_stub import PROGRAM
from mien.commands.stages.batch_table import read_table
from mien.errors import UserError
from test_startup import HEAVY, modules_after


@pytest.fixture
def table(tmp_path: Path) -> Path:
    for name in ("ann", "bob"):
        (tmp_path / f"{name}.mp4").write_bytes(b"a video")
    path = tmp_path / "people.csv"
    path.write_text(
        "name,video,methods,steps,hold_out,age\n,ann.mp4,gaussian_avatars;headgas,60,,30\nrobert,bob.mp4,,,,41\n"
    )
    return path


def test_rows_are_tracked_once_and_trained_by_each_method(table: Path):
    ann, bob = read_table(table)
    assert ann.name == "ann"
    assert bob.name == "robert"
    assert ann.labels == {"age": "30"}
    first, *others = ann.steps
    video = str(table.parent / "ann.mp4")
    assert first == ("create", video, "--out", "{workspace}", "--method", "gaussian_avatars", "--steps", "60")
    assert others == [
        ("train", "{workspace}", "--method", "headgas", "--steps", "60"),
        ("evaluate", "{workspace}", "--run", "headgas"),
    ]
    assert bob.steps == (
        ("create", str(table.parent / "bob.mp4"), "--out", "{workspace}", "--method", "gaussian_avatars"),
    )


def test_a_changed_video_or_setting_changes_the_fingerprint(table: Path):
    before = [row.fingerprint for row in read_table(table)]
    (table.parent / "bob.mp4").write_bytes(b"another video")
    assert [row.fingerprint == old for row, old in zip(read_table(table), before, strict=True)] == [True, False]


def test_json_and_a_folder_of_videos_are_tables_as_well(table: Path):
    path = table.with_name("people.json")
    path.write_text(json.dumps([{"video": ["ann.mp4", "bob.mp4"], "name": "both", "capture.size": 256}]))
    (row,) = read_table(path)
    assert row.steps[0][1:3] == (str(table.parent / "ann.mp4"), str(table.parent / "bob.mp4"))
    assert row.steps[0][-2:] == ("--capture.size", "256")
    assert [row.name for row in read_table(table.parent)] == ["ann", "bob"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("video,stepz\nann.mp4,3", "did you mean 'steps'"),
        ("video\ngone.mp4", "gone.mp4: no such file"),
        ("video,method\nann.mp4,nerf", "nerf"),
        ("video,steps\nann.mp4,-3", "row 1: "),
        ("video,steps\nann.mp4,many", "row 1: --steps: give a whole number instead of 'many'; see mien create"),
        ("video,preset\nann.mp4,best", "row 1: --preset: give one of 'draft', "),
        ("video,capture.sizes\nann.mp4,9", "did you mean --capture.size"),
        ("video,age,age\nann.mp4,3,4", "columns 'age' and 'age' are the same"),
        ("video,hold_out,hold-out\nann.mp4,3,4", "columns 'hold_out' and 'hold-out' are the same"),
        ("video,out\nann.mp4,elsewhere", "column 'out' cannot be set"),
        ("video,name\nann.mp4,x\nbob.mp4,x", "two rows have the name 'x'"),
        ("video,name\nann.mp4,../x", "cannot be the name of a folder"),
        ("name\nann", "row 1: has no video and no dataset; its columns are 'name'"),
        ("movie;steps\nann.mp4;3", "has no video and no dataset"),
        ("video,methodx\nann.mp4,headgas", "column 'methodx' is no option; did you mean 'method'"),
        ("video,namex\nann.mp4,x", "did you mean 'name'"),
        ("video,capture-size\nann.mp4,256", "did you mean 'capture.size'"),
        ("video,psnr\nann.mp4,256", "column 'psnr' is one of the results"),
        ("video,\nann.mp4,256", "a column has no name"),
        ("video,methods\nann.mp4,headgas;headgas", "method 'headgas' is there twice"),
        ("video\nann.mp4;ann.mp4", "two videos have the name 'ann'"),
        ("video,calibration\nann.mp4,rig.json", "rig.json: no such file"),
        ("video\nann.mp4,3", "more cells than the heading"),
        ("video,memory_gb\nann.mp4,lots", "gigabytes above 0"),
        ("", "has no rows"),
        ("video,protocol\nann.mp4,insta", "column 'protocol' is for datasets"),
        ("video,retrack\nann.mp4,yes", "column 'retrack' is for datasets"),
        ("dataset,capture.size\nann.mp4,256", "column 'capture.size' is for videos"),
        ("dataset,video\nann.mp4,bob.mp4", "a video or a dataset, and not both"),
    ],
)
def test_mistakes_in_a_table_are_named_before_any_work(table: Path, text: str, words: str):
    table.write_text(text + "\n")
    with pytest.raises(UserError, match=".") as caught:
        read_table(table)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ('[{"video": "ann.mp4", "video": "bob.mp4"}]', "'video' twice"),
        ('[{"video": "ann.mp4", "capture": {"size": 9}}]', "column 'capture' holds an object"),
    ],
)
def test_mistakes_in_json_are_named_as_well(table: Path, content: str, words: str):
    path = table.with_name("people.json")
    path.write_text(content)
    with pytest.raises(UserError, match=words):
        read_table(path)


def test_a_table_that_is_not_utf_8_is_told_so(table: Path):
    table.write_bytes("name,video\nJosé,ann.mp4\n".encode("latin-1"))
    with pytest.raises(UserError, match="save it as UTF-8"):
        read_table(table)


def test_the_driver_imports_neither_torch_nor_what_only_rows_need(table: Path, tmp_path: Path):
    run = ["batch", str(table), "--out", "people", "--program", shlex.join(PROGRAM)]
    looks = [["batch", "status", "people"], ["batch", "table", "people", "--columns", "psnr"]]
    for lines, needed in (([run], {"av", "cv2", "mien._native"}), (looks, {"mien._native"})):
        for code, modules in modules_after(lines, tmp_path):
            assert code == 0
            assert not modules & HEAVY - needed, f"{lines} imports {sorted(modules & HEAVY - needed)}"
    assert len(list((tmp_path / "people" / "states").glob("*.json"))) == 2


@pytest.fixture
def subjects(tmp_path: Path) -> Path:
    """Return a folder with ten people of IMavatar's layout."""
    for number in range(10):
        clip = tmp_path / "data" / f"subject{number}" / f"subject{number}" / "MVI_1810"
        clip.mkdir(parents=True)
        (clip / "flame_params.json").write_text('{"frames": [{"world_mat": []}]}')
    return tmp_path / "data"


def test_datasets_are_imported_trained_and_scored(subjects: Path):
    table = subjects / "people.csv"
    head = "dataset,face_model,method,split,protocol,steps,training.resolution,age\n"
    table.write_text(head + "".join(f"subject{n},flame,headgas,dataset,imavatar,30,96,{n}\n" for n in range(10)))
    rows = read_table(table)
    assert [row.name for row in rows] == [f"subject{n}" for n in range(10)]
    assert rows[3].labels == {"age": "3"}
    place = str(subjects / "subject3")
    assert rows[3].steps == (
        ("import", place, "--out", "{workspace}", "--resume", "--face-model", "flame"),
        ("train", "{workspace}", "--method", "headgas", "--split", "dataset", "--steps", "30",
         "--training.resolution", "96"),
        ("evaluate", "{workspace}", "--run", "headgas", "--protocol", "imavatar"),
    )  # fmt: skip
