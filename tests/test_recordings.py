"""Recordings as real programs and spreadsheets leave them: times, separators, layouts and matrices."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mien.driving import ARKIT_NAMES, Motion, read_blendshape_json, read_live_link_face, read_recording
from mien.errors import UserError
from recordings import COLUMNS, LAYOUTS, STILL, Frames, row, write_csv, write_json
from small_face_model import make_small_face_model


def jaw(motion: Motion) -> list[float]:
    return np.round(motion.coefficients[:, ARKIT_NAMES.index("jawOpen")], 6).tolist()


def opening(*seconds: str) -> list[list[str]]:
    """Rows with these timecodes, whose jaw opens by a tenth from one to the next."""
    return [row(timecode, JawOpen=index / 10) for index, timecode in enumerate(seconds)]


def test_a_take_goes_on_after_midnight(tmp_path: Path) -> None:
    """A csv that begins at 23:59:58 and has 60 rows before and after midnight lasts 4 s."""
    times = [(23, 59, 58), (23, 59, 59), (0, 0, 0), (0, 0, 1)]
    codes = [f"{h:02d}:{m:02d}:{s:02d}:{f:02d}.451" for h, m, s in times for f in range(0, 60, 2)]
    motion = read_live_link_face(write_csv(tmp_path / "a.csv", *map(row, codes)))
    assert (len(motion), motion.fps) == (120, pytest.approx(30))
    assert motion.notes == ()


def test_a_timecode_that_comes_twice_costs_one_row(tmp_path: Path) -> None:
    path = write_csv(tmp_path / "a.csv", *opening("1:0:0:0", "1:0:0:1", "1:0:0:1", "1:0:0:0.5", "1:0:0:2", "1:0:0:4"))
    motion = read_live_link_face(path)
    np.testing.assert_allclose(jaw(motion), [0, 0.1, 0.4, 0.45, 0.5], atol=1e-6)
    assert motion.notes == (f"{path}, line 4: has the time of a row before it and is left out; 2 in all",)
    frames = [{"timestamp_ms": time, "blendshapes": {"jawOpen": 0.1}} for time in (0, 40, 40, 80)]
    motion = read_blendshape_json(write_json(tmp_path / "a.json", frames))
    assert len(motion) == 3
    assert "frame 2: has the time of a row before it and is left out; 1 in all" in motion.notes[0]


def test_times_that_go_back_are_refused(tmp_path: Path) -> None:
    for codes, fps, words in (
        (("1:0:0:5", "1:0:0:9", "1:0:0:6"), None, "line 4: its Timecode does not come after"),
        (("1:0:0:5", "1:0:0:5", "1:0:0:5"), None, "line 3: its Timecode does not come after"),
        (("1:0:0:28", "1:0:0:29", "1:0:1:0"), 24.0, "--fps 24: its frame numbers go up to 29; give more"),
    ):
        with pytest.raises(UserError, match=words):
            read_live_link_face(write_csv(tmp_path / "a.csv", *opening(*codes)), fps)
    with pytest.raises(UserError, match="frame 1: its timestamp_ms does not come after"):
        read_blendshape_json(write_json(tmp_path / "a.json", [{"timestamp_ms": t, "blendshapes": {}} for t in (5, 0)]))


@pytest.mark.parametrize("separator", [";", "\t", ","])
@pytest.mark.parametrize("hint", ["", "sep={}\n"])
def test_a_csv_that_a_spreadsheet_saved(tmp_path: Path, separator: str, hint: str) -> None:
    """Semicolons, tabs, decimal commas (quoted if they also separate), a byte order mark and Excel's hint are read."""
    rows = [row(f"0:00:00:0{index}.5", JawOpen=index / 8, HeadYaw=0.25) for index in range(3)]
    quote = '"' if separator == "," else ""
    lines = [separator.join(f"{quote}{cell.replace('.', ',')}{quote}" for cell in cells) for cells in (COLUMNS, *rows)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join([hint.format(separator) + lines[0], *lines[1:]]), encoding="utf-8-sig")
    motion = read_live_link_face(path)
    assert jaw(motion) == [0, 0.125, 0.25]
    assert motion.head_rotation[0] == pytest.approx([0, -0.25, 0])


def test_a_missing_tongue_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A csv of 51 coefficients is read with a line, which `mien drive` prints."""
    columns = [name for name in COLUMNS if name != "TongueOut"]
    rows = [
        [cell for name, cell in zip(COLUMNS, cells, strict=True) if name != "TongueOut"] for cells in opening("0:0:0:1")
    ]
    path = write_csv(tmp_path / "a.csv", *rows, columns=columns)
    motion = read_live_link_face(path)
    assert motion.notes == (f"{path}: has no column TongueOut, so the tongue stays in",)
    assert (motion.coefficients[:, ARKIT_NAMES.index("tongueOut")] == 0).all()
    model = replace(make_small_face_model(), expression_names=("jawOpen", *(f"other{i}" for i in range(7))))
    read_recording(path, model)
    assert "has no column TongueOut" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("write", [write for writers in LAYOUTS.values() for write in writers])
def test_every_layout_gives_the_same_motion(write: Callable[[Path, Frames], Path], tmp_path: Path) -> None:
    frames: Frames = [{"jawOpen": index / 8, "eyeBlinkLeft": 0.5, "browInnerUp": 0.25} for index in range(5)]
    path = write(tmp_path, frames)
    motion = read_live_link_face(path) if path.suffix == ".csv" else read_blendshape_json(path)
    assert jaw(motion) == [0, 0.125, 0.25, 0.375, 0.5]
    assert motion.coefficients[:, ARKIT_NAMES.index("eyeBlinkLeft")].tolist() == [0.5] * 5
    assert motion.coefficients.sum() == pytest.approx(1.25 + 5 * 0.75)
    assert motion.fps == pytest.approx(30, rel=0.02)
    assert motion.notes == ()
    if "facial_transformation_matrixes" in path.read_text():
        assert motion.head_translation[0] == pytest.approx([0, 0, -0.4])


def test_units_of_times(tmp_path: Path) -> None:
    """Seconds and milliseconds are read by their names, and refused under the other's."""
    path = tmp_path / "a.json"

    def read(key: str, step: float, count: int = 120) -> Motion:
        return read_blendshape_json(write_json(path, [{key: step * i, "blendshapes": {}} for i in range(count)]))

    assert len(read("time", 1 / 60)) / read("time", 1 / 60).fps == pytest.approx(2.0)
    assert read("timestampMs", 1000 / 60).fps == pytest.approx(60)
    assert read("time", 2.0).fps == pytest.approx(0.5)
    for key, step, words in (
        ("timestamp_ms", 1 / 30, 'goes up by 0.03333 a frame, so there would be 30,000 .*or call seconds "time"'),
        ("timestamp_ms", 33333.0, "goes up by 3.333e[+]04 a frame, so a frame would last 33 s; give milliseconds"),
        ("time", 33.3, 'goes up by 33.3 a frame, so a frame would last 33 s; .*or call milliseconds "timestamp_ms"'),
        ("time", 1e-4, "10,000 frames in a second; give seconds"),
    ):
        with pytest.raises(UserError, match=words):
            read(key, step)


def test_missing_times_are_said(tmp_path: Path) -> None:
    path = write_json(tmp_path / "a.json", [{"blendshapes": {"jawOpen": 0.5}}] * 3)
    motion = read_blendshape_json(path)
    assert motion.fps == pytest.approx(30)
    line = f'{path}: has no times ("timestamp_ms", or "time" in seconds), so 30 frames a second are assumed'
    assert motion.notes == (line,)
    weights = {"facsNames": ["jawOpen"], "weightMat": [[0.5]] * 3}
    assert "so 30 frames a second are assumed" in read_blendshape_json(write_json(path, weights)).notes[0]
    assert read_blendshape_json(write_json(path, {**weights, "exportFps": 60})).fps == pytest.approx(60)


def test_names_that_are_not_arkits(tmp_path: Path) -> None:
    """Some other names are left out with a line. A file of other names is refused."""
    path = tmp_path / "a.json"
    weights = {"exportFps": 30, "facsNames": ["JawOpen", "mouthSmile_L", "tongueTipUp"], "weightMat": [[0.5, 0.25, 1]]}
    motion = read_blendshape_json(write_json(path, weights))
    assert jaw(motion) == [0.5]
    assert motion.coefficients[0, ARKIT_NAMES.index("mouthSmileLeft")] == 0.25
    assert motion.notes == (f"{path}: 1 of its 3 names are not ARKit's and are left out ('tongueTipUp')",)
    good = {"names": ["jawOpen"], "frames": [{"weights": [0.5], "time": 0.0}]}
    for content, words in (
        (
            {**weights, "facsNames": ["jawDrop", "lipSuck", "jawOpen"]},
            "most of its names are not ARKit's, such as 'jawDrop'",
        ),
        ({**weights, "facsNames": None}, "has no list of names"),
        ({**weights, "exportFps": -1}, "exportFps is -1; give frames per second"),
        ({**weights, "exportFps": 1e-320}, "give frames per second, from 1 to 500"),
        ({**weights, "weightMat": [[0.5]]}, "frame 0: has 1 weights for 3 names"),
        ({**weights, "weightMat": [[0.5, "wide", 0]]}, "mouthSmile_L is 'wide'"),
        ({**weights, "weightMat": {}}, '"weightMat" is not a list of frames'),
        ({**good, "frames": [1]}, '"frames" is not a list of frames'),
        ({**good, "frames": [{"weights": 3}]}, "frame 0: has 3 weights for 1 names"),
        ({**good, "frames": [{"weights": None}]}, "no frame has a face"),
        ({"names": 3, "frames": [{}]}, "has no list of names"),
        ({"names": ["jawOpen"], "frames": {}}, '"frames" is not a list of frames'),
        ({"weightMat": []}, '"weightMat" is not a list of frames'),
        ({**good, "names": []}, "most of its names are not ARKit's"),
    ):
        with pytest.raises(UserError, match=words):
            read_blendshape_json(write_json(path, content))
    turned = {**good, "frames": [{"weights": [0.5], "time": 0.0, "rotation": [0.1, 0.2, 0.3]}]}
    assert '"rotation" is not read' in read_blendshape_json(write_json(path, turned)).notes[0]


def matrices(*given: np.ndarray) -> list[dict[str, Any]]:
    return [
        {"time": i / 30, "face_blendshapes": [], "facial_transformation_matrixes": [one.tolist()]} if i else
        {"time": 0.0, "face_blendshapes": [[]], "facial_transformation_matrixes": [one.tolist()]}
        for i, one in enumerate(given)
    ]  # fmt: skip


def test_transposed_matrices_are_read_and_others_refused(tmp_path: Path) -> None:
    """All matrices of a file decide whether they are transposed, because one without translation does not tell."""
    turn = np.array([[0.8, -0.6, 0, 0], [0.6, 0.8, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    moved = turn + np.array(STILL) * np.array([0, 0, 0, 1]) - np.diag([0, 0, 0, 1])
    path = tmp_path / "a.json"
    plain = read_blendshape_json(write_json(path, matrices(turn, moved, moved)))
    other = read_blendshape_json(write_json(path, matrices(turn.T, moved.T, moved.T)))
    np.testing.assert_allclose(plain.head_rotation[:, 2], np.arccos(0.8), atol=1e-6)
    for name in ("head_rotation", "head_translation"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(other, name))
    assert plain.notes == ()
    assert other.notes == (f"{path}: its facial transformation matrices are transposed, and are read so",)
    wrong = moved.copy()
    wrong[3] = [0, 0, 0.5, 1]
    for given in ([moved, wrong], [moved, moved.T]):
        with pytest.raises(UserError, match="frame 1: the last row of its facial .* not 0 0 0 1"):
            read_blendshape_json(write_json(path, matrices(*given)))
