"""Recordings of other programs, as Live Link Face's csv or as json of blend shapes, are read, refused and applied."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mien.camera import camera_from_fov, look_at
from mien.driving import drive
from mien.driving.blendshape_json import read_blendshape_json
from mien.driving.drivers import read_recording
from mien.driving.live_link_face import read_live_link_face
from mien.driving.motion import ARKIT_NAMES, Motion, gaze_of
from mien.driving.transfer import face_of_motion
from mien.errors import UserError
from mien.face import load_face_model
from mien.render.mesh import rasterize_mesh
from mien.rotation import matrix_from_axis_angle
from mien.runtime.named import LOOK_ANGLE
from recordings import COLUMNS, LAYOUTS, STILL, Frames, row, write_csv, write_json
from refusals import refuses
from small_face_model import make_small_face_model
from toy_scene import toy_face_model


def jaw(motion: Motion) -> list[float]:
    return np.round(motion.coefficients[:, ARKIT_NAMES.index("jawOpen")], 6).tolist()


def read_rows(folder: Path, *rows: list[str], fps: float | None = None) -> Motion:
    return read_live_link_face(write_csv(folder / "a.csv", *rows), fps)


def test_values_times_and_turns_and_the_lowest_rate_that_has_the_frame_numbers(tmp_path: Path) -> None:
    """Head angles follow Unreal: yaw to the subject's right, pitch down, roll to the left shoulder."""
    assert (len(COLUMNS), COLUMNS[2], COLUMNS[53:55]) == (63, "EyeBlinkLeft", ["TongueOut", "HeadYaw"])
    first = row("11:59:59:58.5", JawOpen=0.25, HeadYaw=0.3, EyeLookOutLeft=1, EyeLookInRight=1, EyeLookDownLeft=0.5)
    rows = row("11:59:59:59.5", JawOpen=0.5), row("12:00:00:00.5", JawOpen=1, HeadPitch=-0.2)
    motion = read_rows(tmp_path, first, *rows)
    assert (motion.fps, jaw(motion)) == (pytest.approx(60), [0.25, 0.5, 1])
    np.testing.assert_allclose(motion.head_rotation[[0, 2]], [[0, -0.3, 0], [-0.2, 0, 0]], atol=1e-6)
    # Both eyes to the subject's left, the left one down as well.
    np.testing.assert_allclose(motion.eyes[0], [[LOOK_ANGLE / 2, LOOK_ANGLE, 0], [0, LOOK_ANGLE, 0]], atol=1e-6)
    assert motion.lost == 0
    by_angles = read_rows(tmp_path, row("0:0:0:0", LeftEyeYaw=0.2, RightEyePitch=0.1))
    np.testing.assert_allclose(by_angles.eyes[0], [[0, -0.2, 0], [0.1, 0, 0]], atol=1e-6)
    rotation = read_rows(tmp_path, row("0:0:0:0", HeadYaw=0.3, HeadPitch=0.2, HeadRoll=0.1)).head_rotation[0]
    turned = matrix_from_axis_angle(torch.from_numpy(rotation)).numpy()
    ahead_and_left = [turned[0, 2], turned[1, 2], turned[1, 0]]
    expected = [math.sin(0.3) * math.cos(0.2), math.sin(0.2), math.sin(0.1) * math.cos(0.2)]
    assert ahead_and_left == pytest.approx([-value for value in expected], abs=1e-6)
    # Frames of 30 a second have the numbers 0 to 29, so the number 30 means 48, the next rate.
    for largest, rate in ((29, 30), (30, 48)):
        rows = [row(f"0:00:0{second}:{frame:02d}.0") for second in (0, 1) for frame in range(largest + 1)]
        motion = read_rows(tmp_path, *rows)
        assert (len(motion) - 1) / motion.fps == pytest.approx(1 + largest / rate, abs=0.02)
    # Dropped rows are interpolated and lost faces held.
    rows = [row(f"0:00:00:0{index}.0", JawOpen=index / 10) for index in (0, 1, 3, 4)]
    motion = read_rows(tmp_path, *rows, ["0:00:00:05.0", "0"], row("0:00:00:06.0", JawOpen=0))
    np.testing.assert_allclose(jaw(motion), [0, 0.1, 0.2, 0.3, 0.4, 0.4, 0], atol=1e-6)
    assert motion.lost == 1


def rows_of(*timecodes: str) -> list[list[str]]:
    """Rows with these timecodes, whose jaw opens by a tenth from one to the next."""
    return [row(timecode, JawOpen=index / 10) for index, timecode in enumerate(timecodes)]


def test_bad_csv_files(tmp_path: Path) -> None:
    good = row("0:00:00:01.0")
    without = [name for name in COLUMNS if name not in ("JawOpen", "TongueOut")]
    for rows, columns, part in (
        ([good[: len(without)]], without, "lacks the columns JawOpen; give"),
        ([good, row("0:00:00:02.0", JawOpen="nan")], COLUMNS, "line 3: JawOpen is nan"),
        ([row("0:00:00:02.0", JawOpen="")], COLUMNS, "line 2: JawOpen is ''"),
        ([row("0:00:00:02.0", JawOpen=45)], COLUMNS, "line 2: JawOpen is 45; coefficients go from 0 to 1"),
        ([row("0:00:00:02.0", HeadYaw=20)], COLUMNS, "no camera sees a face beyond 1.7; divide degrees by 57.3"),
        (rows_of("1:0:0:5", "1:0:0:9", "1:0:0:6"), COLUMNS, "line 4: its Timecode does not come after"),
        (rows_of("1:0:0:5", "1:0:0:5", "1:0:0:5"), COLUMNS, "line 3: its Timecode does not come after"),
        ([row("soon")], COLUMNS, "line 2: Timecode 'soon'"),
        ([good[:30]], COLUMNS, "line 2: has 30 of 63 values"),
        ([[*good[:1], "0"]], COLUMNS, "no row has a face"),
        ([], COLUMNS, "has no frames"),
    ):
        refuses(part, read_live_link_face, write_csv(tmp_path / "a.csv", *rows, columns=columns))
    with pytest.raises(UserError, match="--fps 24: its frame numbers go up to 29; give more"):
        read_rows(tmp_path, *rows_of("1:0:0:28", "1:0:0:29", "1:0:1:0"), fps=24.0)
    (tmp_path / "b.csv").write_bytes(b"\x81\xff" * 9)
    refuses("cannot be read as csv", read_live_link_face, tmp_path / "b.csv")


def test_face_landmarker_results(tmp_path: Path) -> None:
    turn = matrix_from_axis_angle(torch.tensor([0.1, -0.4, 0.2])).numpy()
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, [1, 2, -45]
    result = {
        "faceLandmarks": [],
        "faceBlendshapes": [{"headIndex": -1, "categories": [{"index": 25, "score": 0.5, "categoryName": "jawOpen"}]}],
        "facialTransformationMatrixes": [{"rows": 4, "columns": 4, "data": matrix.T.flatten().tolist()}],
    }
    motion = read_blendshape_json(write_json(tmp_path / "a.json", result))
    assert jaw(motion) == [0.5]
    np.testing.assert_allclose(motion.head_rotation[0], [0.1, -0.4, 0.2], atol=1e-5)
    np.testing.assert_allclose(motion.head_translation[0], [0.01, 0.02, -0.45], atol=1e-6)
    none = {"faceBlendshapes": [], "facialTransformationMatrixes": []}
    assert read_blendshape_json(write_json(tmp_path / "b.json", [none, result])).lost == 1
    # In plain json a frame without a face repeats the one before.
    shapes = [{"jawOpen": 0, "_neutral": 0.9}, {"jawOpen": 0.25}, None, {"jawOpen": 0.75}]
    frames = [{"timestamp_ms": 40 * index, "blendshapes": one} for index, one in enumerate(shapes)]
    motion = read_blendshape_json(write_json(tmp_path / "a.json", frames))
    assert (motion.fps, motion.lost) == (pytest.approx(25), 1)
    assert jaw(motion) == [0, 0.25, 0.25, 0.75]


def test_bad_json_files(tmp_path: Path) -> None:
    good = {"timestamp_ms": 0, "blendshapes": {}}
    for content, part in (
        ([], "is not a list of frames"), ([{"jawOpen": 1}], 'frame 0: has no "blendshapes"'),
        ([good, good], "frame 1: its timestamp_ms does not come after"),
        ([good, {"blendshapes": {}}], "frame 1: timestamp_ms is None"),
        ([{**good, "timestamp_ms": 5}, good], "frame 1: its timestamp_ms does not come after"),
        ([{"blendshapes": {"jawopen": 1}}], "did you mean jawOpen"),
        ([{"blendshapes": {"jawOpen": float("nan")}}], "jawOpen is nan"),
        ([{"blendshapes": {"jawOpen": 60}}], "jawOpen is 60"), ([{"blendshapes": None}], "no frame has a face"),
        ([{"faceBlendshapes": [{"categories": [{}]}]}], "layout of a FaceLandmarker"),
        ([{"faceBlendshapes": [], "facialTransformationMatrixes": [{"data": [1, 2]}]}], "layout of a FaceLandmarker"),
        ([{"faceBlendshapes": [], "facialTransformationMatrixes": [{"data": [0] * 16}]}], "is not a rotation"),
    ):  # fmt: skip
        refuses(part, read_blendshape_json, write_json(tmp_path / "a.json", content))
    (tmp_path / "a.json").write_text("[{")
    refuses("cannot be read as json", read_blendshape_json, tmp_path / "a.json")


def test_an_avatar_does_what_the_phone_saw(tmp_path: Path) -> None:
    names = ("jawOpen", "mouthLeft", *(f"other{i}" for i in range(6)))
    model = replace(make_small_face_model(), expression_names=names)
    motion = read_rows(tmp_path, *(
        row(f"0:00:00:0{i}.0", JawOpen=i / 10, EyeLookUpLeft=1, EyeLookUpRight=1, HeadYaw=0.1 * i) for i in range(3)
    ))  # fmt: skip
    face, at_rest = face_of_motion(motion, model)
    rest = model.neutral()
    rest = replace(rest, expression=rest.expression + 0.05, head_translation=torch.tensor([[0.0, 0, -0.6]]))
    driven = drive(face, at_rest, rest, model.expression_bounds)
    torch.testing.assert_close(driven.expression[:, 0], torch.tensor([0.05, 0.15, 0.25]))
    assert (driven.expression[:, 1] == 0.05).all()
    up = torch.tensor([-math.radians(14) * math.tanh(30 / 14), 0, 0])
    for joint in ("left_eye", "right_eye"):
        torch.testing.assert_close(driven.joints[0, model.free_joint_names.index(joint)], up, atol=1e-5, rtol=0)
    # The head's rest pose is where it mostly is: the middle of the turn, which goes to the right.
    torch.testing.assert_close(driven.head_rotation[:, 1], torch.tensor([0.1, 0, -0.1]), atol=1e-5, rtol=0)
    torch.testing.assert_close(driven.head_translation, rest.head_translation.expand(3, -1))
    refuses("no landmarks, by which expressions are transferred", face_of_motion, motion, toy_face_model())


def test_eyes_that_look_up_and_down_stay_open() -> None:
    """The lids follow the gaze. At ARKit's largest coefficients they must leave the iris in sight."""
    model = load_face_model("anny")
    irises = model.region_mask("irises")

    def visible(name: str, strength: float) -> int:
        coefficients, still = np.zeros((1, len(ARKIT_NAMES)), np.float32), np.zeros((1, 3), np.float32)
        coefficients[0, [ARKIT_NAMES.index(f"{name}{side}") for side in ("Left", "Right")]] = strength
        face, _ = face_of_motion(Motion(30.0, coefficients, gaze_of(coefficients), still, still, 0), model)
        vertices = model.head_vertices(face)[0]
        middle = vertices[model.faces[irises].long().flatten()].mean(0)
        eye = look_at(middle + torch.tensor([0.0, 0, 0.5]), middle, torch.tensor([0.0, 1, 0]))
        shown = rasterize_mesh(vertices, model.faces, camera_from_fov(0.3, 256, 128, eye)).face_index
        return int(irises[shown[shown >= 0].long()].sum())

    ahead = visible("eyeLookUp", 0.0)
    assert ahead > 100
    for name in ("eyeLookUp", "eyeLookDown"):
        assert visible(name, 1.0) > 0.3 * ahead, name


def test_a_take_goes_on_after_midnight_and_a_timecode_that_comes_twice_costs_one_row(tmp_path: Path) -> None:
    times = [(23, 59, 58), (23, 59, 59), (0, 0, 0), (0, 0, 1)]
    codes = [f"{h:02d}:{m:02d}:{s:02d}:{f:02d}.451" for h, m, s in times for f in range(0, 60, 2)]
    motion = read_rows(tmp_path, *map(row, codes))
    assert (len(motion), motion.fps) == (120, pytest.approx(30))
    assert motion.notes == ()
    path, codes = tmp_path / "a.csv", ("1:0:0:0", "1:0:0:1", "1:0:0:1", "1:0:0:0.5", "1:0:0:2", "1:0:0:4")
    motion = read_rows(tmp_path, *rows_of(*codes))
    np.testing.assert_allclose(jaw(motion), [0, 0.1, 0.4, 0.45, 0.5], atol=1e-6)
    assert motion.notes == (f"{path}, line 4: has the time of a row before it and is left out; 2 in all",)
    frames = [{"timestamp_ms": time, "blendshapes": {"jawOpen": 0.1}} for time in (0, 40, 40, 80)]
    motion = read_blendshape_json(write_json(tmp_path / "a.json", frames))
    assert len(motion) == 3
    assert "frame 2: has the time of a row before it and is left out; 1 in all" in motion.notes[0]


@pytest.mark.parametrize("separator", [";", "\t", ","])
@pytest.mark.parametrize("hint", ["", "sep={}\n"])
def test_a_csv_that_a_spreadsheet_saved(tmp_path: Path, separator: str, hint: str) -> None:
    rows = [row(f"0:00:00:0{index}.5", JawOpen=index / 8, HeadYaw=0.25) for index in range(3)]
    quote = '"' if separator == "," else ""
    lines = [separator.join(f"{quote}{cell.replace('.', ',')}{quote}" for cell in cells) for cells in (COLUMNS, *rows)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join([hint.format(separator) + lines[0], *lines[1:]]), encoding="utf-8-sig")
    motion = read_live_link_face(path)
    assert jaw(motion) == [0, 0.125, 0.25]
    assert motion.head_rotation[0] == pytest.approx([0, -0.25, 0])


def test_a_missing_tongue_is_said(tmp_path: Path, capsys) -> None:
    rows = [[*cells[:53], *cells[54:]] for cells in (COLUMNS, *rows_of("0:0:0:1"))]
    path = write_csv(tmp_path / "a.csv", *rows[1:], columns=rows[0])
    motion = read_live_link_face(path)
    assert motion.notes == (f"{path}: has no column TongueOut, so the tongue stays in",)
    assert (motion.coefficients[:, ARKIT_NAMES.index("tongueOut")] == 0).all()
    read_recording(path, replace(make_small_face_model(), expression_names=("jawOpen", *map(str, range(7)))))
    assert "has no column TongueOut" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("write", [write for writers in LAYOUTS.values() for write in writers])
def test_every_layout_gives_the_same_motion(write, tmp_path: Path) -> None:
    frames: Frames = [{"jawOpen": index / 8, "eyeBlinkLeft": 0.5, "browInnerUp": 0.25} for index in range(5)]
    path = write(tmp_path, frames)
    motion = read_live_link_face(path) if path.suffix == ".csv" else read_blendshape_json(path)
    assert jaw(motion) == [0, 0.125, 0.25, 0.375, 0.5]
    assert motion.coefficients[:, ARKIT_NAMES.index("eyeBlinkLeft")].tolist() == [0.5] * 5
    assert motion.coefficients.sum() == pytest.approx(1.25 + 5 * 0.75)
    assert (motion.fps, motion.notes) == (pytest.approx(30, rel=0.02), ())
    if "facial_transformation_matrixes" in path.read_text():
        assert motion.head_translation[0] == pytest.approx([0, 0, -0.4])


def test_units_of_times_are_found_and_missing_times_are_said(tmp_path: Path) -> None:
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
        refuses(words, read, key, step)
    path = write_json(tmp_path / "a.json", [{"blendshapes": {"jawOpen": 0.5}}] * 3)
    motion = read_blendshape_json(path)
    assert motion.fps == pytest.approx(30)
    line = f'{path}: has no times ("timestamp_ms", or "time" in seconds), so 30 frames a second are assumed'
    assert motion.notes == (line,)
    weights = {"facsNames": ["jawOpen"], "weightMat": [[0.5]] * 3}
    assert "so 30 frames a second are assumed" in read_blendshape_json(write_json(path, weights)).notes[0]
    assert read_blendshape_json(write_json(path, {**weights, "exportFps": 60})).fps == pytest.approx(60)


def test_names_that_are_not_arkits(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    weights = {"exportFps": 30, "facsNames": ["JawOpen", "mouthSmile_L", "tongueTipUp"], "weightMat": [[0.5, 0.25, 1]]}
    motion = read_blendshape_json(write_json(path, weights))
    assert jaw(motion) == [0.5]
    assert motion.coefficients[0, ARKIT_NAMES.index("mouthSmileLeft")] == 0.25
    assert motion.notes == (f"{path}: 1 of its 3 names are not ARKit's and are left out ('tongueTipUp')",)
    good = {"names": ["jawOpen"], "frames": [{"weights": [0.5], "time": 0.0}]}
    for content, words in (
        ({**weights, "facsNames": ["jawDrop", "lipSuck", "jawOpen"]}, "names are not ARKit's, such as 'jawDrop'"),
        ({**weights, "exportFps": 1e-320}, "exportFps is 1e-320; give frames per second, from 1 to 500"),
        ({**weights, "weightMat": [[0.5]]}, "frame 0: has 1 weights for 3 names"),
        ({**weights, "weightMat": [[0.5, "wide", 0]]}, "mouthSmile_L is 'wide'"),
        ({**good, "frames": [1]}, '"frames" is not a list of frames'),
        ({**good, "frames": [{"weights": 3}]}, "frame 0: has 3 weights for 1 names"),
        ({**good, "frames": [{"weights": None}]}, "no frame has a face"),
        ({"names": 3, "frames": [{}]}, "has no list of names"),
        ({"weightMat": []}, '"weightMat" is not a list of frames'),
    ):
        refuses(words, read_blendshape_json, write_json(path, content))
    turned = {**good, "frames": [{"weights": [0.5], "time": 0.0, "rotation": [0.1, 0.2, 0.3]}]}
    assert '"rotation" is not read' in read_blendshape_json(write_json(path, turned)).notes[0]


def test_transposed_matrices_are_read_and_others_refused(tmp_path: Path) -> None:
    """All matrices of a file decide whether they are transposed, because one without translation does not tell."""
    turn = np.array([[0.8, -0.6, 0, 0], [0.6, 0.8, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    moved = turn + np.array(STILL) * np.array([0, 0, 0, 1]) - np.diag([0, 0, 0, 1])
    path = tmp_path / "a.json"

    def read(*matrices: np.ndarray) -> Motion:
        frames: list[dict[str, Any]] = [
            {"time": index / 30, "face_blendshapes": [[]], "facial_transformation_matrixes": [one.tolist()]}
            for index, one in enumerate(matrices)
        ]
        return read_blendshape_json(write_json(path, frames))

    plain, other = read(turn, moved, moved), read(turn.T, moved.T, moved.T)
    np.testing.assert_allclose(plain.head_rotation[:, 2], np.arccos(0.8), atol=1e-6)
    np.testing.assert_allclose(plain.head_translation, [[0, 0, 0], [0, 0, -0.4], [0, 0, -0.4]], atol=1e-6)
    for name in ("head_rotation", "head_translation"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(other, name))
    assert plain.notes == ()
    assert other.notes == (f"{path}: its facial transformation matrices are transposed, and are read so",)
    wrong = moved.copy()
    wrong[3] = [0, 0, 0.5, 1]
    for second in (wrong, moved.T):
        refuses("frame 1: the last row of its facial .* not 0 0 0 1", read, moved, second)
