"""Motion of other programs, as Live Link Face's csv or as json of blend shapes, is read, refused and applied."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mien.camera import camera_from_fov, look_at
from mien.driving import ARKIT_NAMES, drive, face_of_motion, read_blendshape_json, read_live_link_face
from mien.driving.motion import Motion, gaze_of
from mien.errors import UserError
from mien.face import load_face_model
from mien.render.mesh import rasterize_mesh
from mien.rotation import matrix_from_axis_angle
from mien.runtime.named import LOOK_ANGLE
from recordings import COLUMNS, row, write_csv, write_json
from small_face_model import make_small_face_model
from toy_scene import toy_face_model


def jaw(motion) -> list[float]:
    return motion.coefficients[:, ARKIT_NAMES.index("jawOpen")].tolist()


def test_values_times_and_turns(tmp_path: Path) -> None:
    assert (len(COLUMNS), COLUMNS[2], COLUMNS[53:55]) == (63, "EyeBlinkLeft", ["TongueOut", "HeadYaw"])
    first = row("11:59:59:58.5", JawOpen=0.25, HeadYaw=0.3, EyeLookOutLeft=1, EyeLookInRight=1, EyeLookDownLeft=0.5)
    motion = read_live_link_face(write_csv(tmp_path / "a.csv", first, row("11:59:59:59.5", JawOpen=0.5),
                                           row("12:00:00:00.5", JawOpen=1, HeadPitch=-0.2)))  # fmt: skip
    assert motion.fps == pytest.approx(60)
    assert jaw(motion) == [0.25, 0.5, 1]
    np.testing.assert_allclose(motion.head_rotation[0], [0, -0.3, 0], atol=1e-6)
    np.testing.assert_allclose(motion.head_rotation[2], [-0.2, 0, 0], atol=1e-6)
    # Both eyes to the subject's left, the left one down as well.
    np.testing.assert_allclose(motion.eyes[0], [[LOOK_ANGLE / 2, LOOK_ANGLE, 0], [0, LOOK_ANGLE, 0]], atol=1e-6)
    assert motion.lost == 0


def test_the_rate_is_the_lowest_that_has_the_frame_numbers(tmp_path: Path) -> None:
    """Frames of 30 a second have the numbers 0 to 29, so the number 30 means 48, the next rate."""
    for largest, rate in ((29, 30), (30, 48)):
        rows = [row(f"0:00:0{second}:{frame:02d}.0") for second in (0, 1) for frame in range(largest + 1)]
        motion = read_live_link_face(write_csv(tmp_path / "a.csv", *rows))
        assert (len(motion) - 1) / motion.fps == pytest.approx(1 + largest / rate, abs=0.02)


def test_dropped_rows_are_interpolated_and_lost_faces_held(tmp_path: Path) -> None:
    lost = ["0:00:00:05.0", "0"]
    rows = [row(f"0:00:00:0{index}.0", JawOpen=index / 10) for index in (0, 1, 3, 4)]
    motion = read_live_link_face(write_csv(tmp_path / "a.csv", *rows, lost, row("0:00:00:06.0", JawOpen=0)))
    np.testing.assert_allclose(jaw(motion), [0, 0.1, 0.2, 0.3, 0.4, 0.4, 0], atol=1e-6)
    assert motion.lost == 1


def test_eye_angles_count_where_coefficients_do_not(tmp_path: Path) -> None:
    motion = read_live_link_face(write_csv(tmp_path / "a.csv", row("0:0:0:0", LeftEyeYaw=0.2, RightEyePitch=0.1)))
    np.testing.assert_allclose(motion.eyes[0], [[0, -0.2, 0], [0.1, 0, 0]], atol=1e-6)


REAL_LOOKS = (
    # LookDown, In, Out, Up of the left eye, then of the right; yaw, pitch, roll of the left eye, then of the right.
    ((0, 0, 0.9879, 0.6407), (0, 1.0528, 0, 0.6236), (-0.6158, -0.3355, 0.1987), (-0.5769, -0.3355, 0.1879)),
    ((0, 0, 0.4733, 0.3900), (0, 0.5690, 0, 0.3827), (-0.3425, -0.1774, 0.0601), (-0.2848, -0.1774, 0.0503)),
    ((0.2948, 0.0970, 0, 0), (0.2953, 0.0095, 0, 0), (-0.0057, 0.1804, -0.0010), (0.0583, 0.1804, 0.0106)),
)
"""Rounded rows of real takes that give the gaze both as coefficients and as angles."""


def test_angles_have_the_signs_of_real_takes(tmp_path: Path) -> None:
    """Angles have the signs of real takes: yaw to the right and pitch down agree with the eyeLook coefficients."""
    columns = ("EyeLookDown", "EyeLookIn", "EyeLookOut", "EyeLookUp")
    for left, right, left_angles, right_angles in REAL_LOOKS:
        looks, angles = {}, {}
        for side, coefficients, turns in (("Left", left, left_angles), ("Right", right, right_angles)):
            looks |= {f"{name}{side}": value for name, value in zip(columns, coefficients, strict=True)}
            angles |= {f"{side}Eye{name}": value for name, value in zip(("Yaw", "Pitch", "Roll"), turns, strict=True)}
        by_looks = read_live_link_face(write_csv(tmp_path / "a.csv", row("0:0:0:0", **looks))).eyes[0]
        by_angles = read_live_link_face(write_csv(tmp_path / "b.csv", row("0:0:0:0", **angles))).eyes[0]
        # The calibration decides where the eyes look straight ahead. On these takes it differs by up to 7 degrees.
        assert np.abs(by_looks - by_angles).max() < math.radians(9)
        # A gaze up and to the side has hardly any torsion, once its roll is taken the right way.
        assert np.abs(by_angles[:, 2]).max() < 0.12


def test_head_angles_are_unreals(tmp_path: Path) -> None:
    """Head angles follow Unreal: yaw to the subject's right, pitch down, roll to the left shoulder."""
    turns = {"HeadYaw": 0.3, "HeadPitch": 0.2, "HeadRoll": 0.1}
    rotation = read_live_link_face(write_csv(tmp_path / "a.csv", row("0:0:0:0", **turns))).head_rotation[0]
    turned = matrix_from_axis_angle(torch.from_numpy(rotation)).numpy()
    ahead, left = turned[:, 2], turned[:, 0]
    assert ahead[0] == pytest.approx(-math.sin(0.3) * math.cos(0.2), abs=1e-6)
    assert ahead[1] == pytest.approx(-math.sin(0.2), abs=1e-6)
    assert left[1] == pytest.approx(-math.sin(0.1) * math.cos(0.2), abs=1e-6)


def test_bad_csv_files(tmp_path: Path) -> None:
    good = row("0:00:00:01.0")
    without = [name for name in COLUMNS if name not in ("JawOpen", "TongueOut")]
    for rows, columns, part in (
        ([good[: len(without)]], without, "lacks the columns JawOpen; give"),
        ([good, row("0:00:00:02.0", JawOpen="nan")], COLUMNS, "line 3: JawOpen is nan"),
        ([row("0:00:00:02.0", JawOpen="")], COLUMNS, "line 2: JawOpen is ''"),
        ([row("0:00:00:02.0", JawOpen=45)], COLUMNS, "line 2: JawOpen is 45; coefficients go from 0 to 1"),
        ([row("0:00:00:02.0", HeadYaw=20)], COLUMNS, "convert it if it is in degrees"),
        ([good, good], COLUMNS, "line 3: its Timecode does not come after"),
        ([row("soon")], COLUMNS, "line 2: Timecode 'soon'"),
        ([good[:30]], COLUMNS, "line 2: has 30 of 63 values"),
        ([[*good[:1], "0"]], COLUMNS, "no row has a face"),
        ([], COLUMNS, "has no frames"),
    ):
        with pytest.raises(UserError, match=part):
            read_live_link_face(write_csv(tmp_path / "a.csv", *rows, columns=columns))
    (tmp_path / "b.csv").write_bytes(b"\xff\xfe\x00\x81" * 9)
    with pytest.raises(UserError, match="cannot be read as csv"):
        read_live_link_face(tmp_path / "b.csv")


def test_plain_json(tmp_path: Path) -> None:
    """Plain json of blend shapes is read, and a frame without a face repeats the one before."""
    frames = [{"timestamp_ms": 40 * i, "blendshapes": {"jawOpen": i / 4, "_neutral": 0.9}} for i in range(4)]
    frames[2]["blendshapes"] = None
    motion = read_blendshape_json(write_json(tmp_path / "a.json", frames))
    assert motion.fps == pytest.approx(25)
    assert jaw(motion) == [0, 0.25, 0.25, 0.75]
    assert motion.lost == 1


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


def test_bad_json_files(tmp_path: Path) -> None:
    good = {"timestamp_ms": 0, "blendshapes": {}}
    for content, part in (
        ([], "is not a list of frames"),
        ("jawOpen", "is not a list of frames"),
        ([{"jawOpen": 1}], 'frame 0: has no "blendshapes"'),
        ([good, good], "frame 1: its timestamp_ms does not come after"),
        ([good, {"blendshapes": {}}], "frame 1: timestamp_ms is None"),
        ([{"blendshapes": {"jawopen": 1}}], "did you mean jawOpen"),
        ([{"blendshapes": {"jawOpen": float("nan")}}], "jawOpen is nan"),
        ([{"blendshapes": {"jawOpen": "wide"}}], "jawOpen is 'wide'"),
        ([{"blendshapes": {"jawOpen": 60}}], "jawOpen is 60"),
        ([{"blendshapes": None}], "no frame has a face"),
        ([{"faceBlendshapes": [{"categories": [{}]}]}], "layout of a FaceLandmarker"),
        (
            [{"faceBlendshapes": [], "facialTransformationMatrixes": [{"data": [1, 2]}]}],
            "layout of a FaceLandmarker",
        ),
        ([{"faceBlendshapes": [], "facialTransformationMatrixes": [{"data": [0] * 16}]}], "is not a rotation"),
    ):
        with pytest.raises(UserError, match=part):
            read_blendshape_json(write_json(tmp_path / "a.json", content))
    (tmp_path / "a.json").write_text("[{")
    with pytest.raises(UserError, match="cannot be read as json"):
        read_blendshape_json(tmp_path / "a.json")


def test_an_avatar_does_what_the_phone_saw(tmp_path: Path) -> None:
    names = ("jawOpen", "mouthLeft", *(f"other{i}" for i in range(6)))
    model = replace(make_small_face_model(), expression_names=names)
    rows = [
        row(f"0:00:00:0{i}.0", JawOpen=i / 10, EyeLookUpLeft=1, EyeLookUpRight=1, HeadYaw=0.1 * i) for i in range(3)
    ]
    motion = read_live_link_face(write_csv(tmp_path / "a.csv", *rows))
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
    with pytest.raises(UserError, match="no landmarks, by which expressions are transferred"):
        face_of_motion(motion, toy_face_model())


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
