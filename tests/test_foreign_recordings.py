"""Recordings of other programs, in their units, encodings, times and layouts; and what systems leave in folders."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mien.capture.cameras.calibration import CalibratedCamera, match_sources, read_calibration
from mien.commands.batch_table import read_table
from mien.datasets.live_link_face_take import LIVE_LINK_FACE
from mien.disk.reading import listed
from mien.disk.workspace import Workspace
from mien.driving.blendshape_json import read_blendshape_json
from mien.driving.live_link_face import read_live_link_face
from mien.driving.motion import ARKIT_NAMES, Motion
from mien.evaluation.image_folders import open_pictures
from mien.media.source import list_images
from mien.pipeline import drive as driving
from recordings import live_link_face, row, write_csv, write_json
from refusals import complaint, refuses
from toy_scene import toy_camera


def jaw(motion: Motion) -> list[float]:
    return np.round(motion.coefficients[:, ARKIT_NAMES.index("jawOpen")].astype(float), 6).tolist()


def turning(*yaws: float, times: str = "0:00:00:{:02d}.0", **others: float) -> list[list[str]]:
    """Rows of a head that turns, two frames of a timecode apart."""
    return [row(times.format(2 * index), HeadYaw=yaw, **others) for index, yaw in enumerate(yaws)]


@pytest.mark.parametrize(("rows", "words"), [
    (turning(0, 1.69, 2.9), "line 4: HeadYaw is 2.9; angles are in radians, .* beyond 1.7; divide degrees by 57.3"),
    (turning(0, LeftEyePitch=-14), "line 2: LeftEyePitch is -14; angles are in radians"),
    (turning(0, HeadRoll=3.2), "line 2: HeadRoll is 3.2; .* beyond 3.14; divide"),
    (
        turning(0, 0.1, 1.2),
        r"line 4: HeadYaw goes from 0.1 to 1.2 in 0.033 s; .* more than 20 a second; divide deg",
    ),
    (turning(0, JawOpen=45), "line 2: JawOpen is 45; coefficients go from 0 to 1; divide percent by 100"),
    (turning(0, JawOpen=-45), "line 2: JawOpen is -45; .* correct or delete the row"),
])  # fmt: skip
def test_units_that_cannot_be_are_named(tmp_path: Path, rows: list[list[str]], words: str) -> None:
    refuses(words, read_live_link_face, write_csv(tmp_path / "a.csv", *rows))


def test_fast_heads_that_are_no_degrees_are_read(tmp_path: Path) -> None:
    """A phone on its side, a face that is lost and found elsewhere, and a timecode with a hiccup are no degrees."""
    side = turning(0.3, 0.4, HeadRoll=1.8)
    lost = [*turning(0.0), ["0:00:00:02.0", "0"], *(row(f"0:00:00:{at:02d}.0", HeadYaw=1.2) for at in (4, 6))]
    hiccup = [
        row(f"0:00:00:{code}", HeadYaw=yaw) for code, yaw in (("02.0", 0), ("04.0", 0.1), ("04.1", 0.2), ("06.0", 0.3))
    ]
    for rows in (side, lost, hiccup):
        read_live_link_face(write_csv(tmp_path / "a.csv", *rows))


def test_fewer_than_five_rows_a_second_are_said(tmp_path: Path) -> None:
    """The frame field of the timecode never changes, so --fps is the number of rows a second."""
    path = write_csv(tmp_path / "a.csv", *(row(f"0:00:{second:02d}:00.0") for second in range(10)))
    motion = read_live_link_face(path)
    assert motion.fps == pytest.approx(1)
    assert "has 1 rows a second, and recordings of faces have at least 5; `mien drive --fps 60`" in motion.notes[0]
    motion = read_live_link_face(path, 60.0)
    assert (len(motion), motion.fps, motion.notes) == (10, pytest.approx(60), ())
    json_path = write_json(tmp_path / "a.json", [{"time": second, "blendshapes": {}} for second in range(4)])
    assert "has 1 rows a second" in read_blendshape_json(json_path).notes[0]


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be", "utf-8-sig"])
def test_encodings_of_spreadsheets_are_read(tmp_path: Path, encoding: str) -> None:
    take = write_csv(tmp_path / "a.csv", row("0:0:0:0", JawOpen=0.0), row("0:0:0:2", JawOpen=0.1))
    plain = write_json(tmp_path / "a.json", [{"time": 0, "blendshapes": {"jawOpen": 0.5}}])
    for path in (take, plain):
        path.write_bytes(path.read_text().encode(encoding))
    assert (jaw(read_live_link_face(take)), jaw(read_blendshape_json(plain))) == ([0, 0.1], [0.5])
    take.write_bytes("Timecode,JawOpen,\u00fc\n0:0:0:0,1\n".encode("latin-1"))
    refuses("it is no text in UTF-8 or UTF-16; save it as UTF-8", read_live_link_face, take)


def table(path: Path, *columns: str, rows: int = 4, step: float = 1.0) -> Path:
    """A csv whose first column counts, and whose others rise by a tenth."""
    cells = [[f"{step * at:g}", *([str(at / 10)] * (len(columns) - 1))] for at in range(rows)]
    return write_csv(path, *cells, columns=list(columns))


@pytest.mark.parametrize(("key", "step", "fps", "rate"), [
    ("frame", 1, None, 30), ("frame", 1, 24.0, 24), ("Frame", 2, 60.0, 30),
    ("timestamp_ms", 40, None, 25), ("time", 0.02, None, 50), ("time", 0.02, 25.0, 25),
])  # fmt: skip
def test_tables_of_other_programs(tmp_path: Path, key: str, step: float, fps: float | None, rate: float) -> None:
    motion = read_live_link_face(
        table(tmp_path / "a.csv", key, "jawOpen", "MouthSmile_L", "confidence", step=step), fps
    )
    assert (motion.fps, jaw(motion)) == (pytest.approx(rate), [0, 0.1, 0.2, 0.3])
    # pandas writes the number of each row, in a column without a name
    assert jaw(read_live_link_face(table(tmp_path / "b.csv", "", "time", "jawOpen"))) == [0, 0.1, 0.2, 0.3]
    assert motion.coefficients[3, ARKIT_NAMES.index("mouthSmileLeft")] == pytest.approx(0.3)
    assert "has no columns EyeBlinkLeft, " in motion.notes[0]
    assert "(50 in all), so they stay 0" in motion.notes[0]
    assumed = ["so 30 rows a second are assumed; --fps sets it" in note for note in motion.notes[1:]]
    assert assumed == [True] * (key == "frame" and fps is None)


@pytest.mark.parametrize(("columns", "step", "words"), [
    (("frame", "AU01_r"), 1, "lacks ARKit's names, or a column Timecode, timestamp_ms, time or frame; give"),
    (("row", "jawOpen"), 1, "lacks ARKit's names, or a column Timecode"),
    (("timestamp_ms", "jawOpen"), 0.0333, "there would be 30,030 frames in a second; give milliseconds"),
    (("time", "jawOpen"), 33.3, 'a frame would last 33 s; give seconds, or call milliseconds "timestamp_ms"'),
    (("time", "jawOpen"), float("nan"), "line 2: time is 'nan'; give every row a number"),
])  # fmt: skip
def test_tables_that_cannot_be_read(tmp_path: Path, columns: tuple[str, ...], step: float, words: str) -> None:
    refuses(words, read_live_link_face, table(tmp_path / "a.csv", *columns, step=step))


def piece(first: Any, *rows: Any) -> dict[str, Any]:
    return {"FrameIndex": first, "BlendShapes": list(rows)}


def test_pieces_of_azures_speech(tmp_path: Path) -> None:
    """Pieces follow each other at 60 frames a second. The 18th number is the open jaw, and rolls are left out."""
    rows = [[0.0] * 17 + [at / 10] + [0.0] * 37 for at in range(6)]
    path = write_json(tmp_path / "a.json", [piece(0, *rows[:4]), piece(4, *rows[4:])])
    motion = read_blendshape_json(path)
    assert (motion.fps, motion.notes) == (pytest.approx(60), ())
    assert jaw(motion) == [0, 0.1, 0.2, 0.3, 0.4, 0.5]
    rows[0][52] = 0.1
    motion = read_blendshape_json(write_json(path, piece(0, *rows)))
    assert motion.notes == (f"{path}: the rolls of head and eyes are not read, so the head keeps still",)
    for content, words in (
        (piece(0, rows[0][:54]), "frame 0: is not a list of 55 numbers"),
        (piece(7, 3), "frame 7: is not a list of 55 numbers"),
        (piece(-1, rows[0]), "piece 0: FrameIndex is -1"),
        (piece(10**12, rows[0]), "piece 0: FrameIndex is 10"),
        ([piece(0)], 'its "BlendShapes" have no frames'),
        ({"FrameIndex": 0, "BlendShapes": 3}, 'piece 0: "BlendShapes" is not a list of frames'),
        ([piece(0, rows[0]), piece(9, ["wide", *rows[0][1:]])], "frame 1: eyeBlinkLeft is 'wide'"),
    ):
        refuses(words, read_blendshape_json, write_json(path, content))


LEFT = ("._{}", ".{}", ".DS_Store", "Thumbs.db", "desktop.ini", "__MACOSX/{}", "__MACOSX/._{}")
"""Names of files that systems leave beside a file."""


def given(folder: Path, *names: str) -> Path:
    """Return a folder with small files or pictures of these names, and what systems leave beside each."""
    picture = cv2.imencode(".png", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
    for name in names:
        for each in (name, *(left.format(name) for left in LEFT)):
            path = folder / each
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(picture if each == name else b"\0\x05\x16\x07")
    return folder


def cameras() -> list[CalibratedCamera]:
    return [CalibratedCamera(name, toy_camera(16)) for name in ("00", "01")]


@pytest.mark.parametrize(("names", "read"), [
    (("2.png", "10.png"), list_images),
    (("00.mp4", "01.mp4"), lambda folder: match_sources([folder], cameras(), folder / "cameras.json")),
    (("ann.mp4", "bob.mov"), lambda folder: [Path(row.steps[0][1]) for row in read_table(folder)]),
    (("a.png", "b.png"), lambda folder: [*(open_pictures(folder).files or {}).values()]),
    (("a.obj", "b.obj"), lambda folder: listed(folder, "*.obj")),
])  # fmt: skip
def test_what_systems_leave_is_skipped(tmp_path, names: tuple[str, ...], read: Callable[[Path], list[Path]]) -> None:
    assert [path.name for path in read(given(tmp_path / "people", *names))] == list(names)


@pytest.mark.parametrize("command", ["create", "capture", "batch"])
def test_a_workspace_is_no_folder_of_videos(tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str) -> None:
    """Its films show the avatar, from which no other one is made."""
    given(tmp_path / "ann", "me.mp4", "runs/headgas/film.mp4")
    told = complaint(capsys, command, tmp_path / "ann", "--out", tmp_path / "out")
    assert "is a workspace" in told
    assert f"mien train {tmp_path / 'ann'}" in told
    assert "me.mp4" not in told


def test_a_take_with_what_systems_leave_is_recognised_also_in_a_hidden_folder(tmp_path: Path) -> None:
    given(tmp_path, "take.mov", "take.csv")
    live_link_face(tmp_path, [{}] * 3)
    assert LIVE_LINK_FACE.recognises(tmp_path) == "a take of Live Link Face (a video, coefficients)"
    assert [path.name for path in list_images(given(tmp_path / ".hidden" / "__MACOSX", "a.png"))] == ["a.png"]


@pytest.mark.parametrize(
    ("names", "count"), [(("a.png",), 3), (("a.png", "b.png"), 6), (("a.png", "b.png", "c.png"), 3)]
)
@pytest.mark.parametrize("whole", [True, False])
def test_pictures_drive_an_avatar(tmp_path: Path, monkeypatch, names: tuple[str, ...], count: int, whole: bool) -> None:
    """A picture, or a folder of few, is repeated, because tracking needs three frames."""
    captured: list[Path] = []
    monkeypatch.setattr(driving, "run_capture_stage", lambda _, sources, *__: captured.extend(list_images(sources[0])))
    monkeypatch.setattr(driving, "run_tracking_stage", lambda *_, **__: {"clip": None})
    monkeypatch.setattr(driving, "cache_folder", lambda: tmp_path / "cache")
    folder = given(tmp_path / "people", *names)
    workspace, found = driving.tracked_film(folder if whole else folder / names[0], "anny")
    assert isinstance(workspace, Workspace)
    assert (found, len(captured)) == (["clip"], (count if whole else 3))
    assert captured[0].read_bytes() == (folder / names[0]).read_bytes()


@pytest.mark.parametrize("name", ["transforms.json", "cameras.json"])
def test_a_calibration_of_nerfstudio_is_named(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    frames = [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}]
    path.write_text(json.dumps({"fl_x": 500, "frames": frames}))
    refuses(rf"{name}: is nerfstudio's transforms.json, .*matrices are camera-to-world", read_calibration, path)
    path.write_text(json.dumps({"frames": 3}))
    refuses("write it as described in docs/using.md", read_calibration, path)
