"""A driver who never rests keeps its expression, and a driver who does is transferred as before."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mien.avatar import neutral_of
from mien.commands.options import check_neutral
from mien.commands.stages.driving import open_driver
from mien.driving import drive, facing, rest_of, with_neutral
from mien.driving.constants import DRIVING
from mien.driving.drivers import Driver
from mien.driving.rest import kept_share
from mien.errors import UserError
from mien.face import FaceModel, FaceParams
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle
from refusals import refuses
from small_face_model import make_small_face_model
from test_motion import row, write_csv
from toy_scene import toy_face_model, toy_sequence
from toy_workspace import write_sequence

NAMES = (
    "jawOpen", "browInnerUp", "browOuterUpLeft", "browOuterUpRight", "mouthSmileLeft", "mouthSmileRight",
    "eyeBlinkLeft", "other",
)  # fmt: skip
FRAMES = 100


def model() -> FaceModel:
    small = make_small_face_model()
    return replace(small, expression_names=NAMES[: small.expression_basis.shape[0]])


def talking(held: dict[str, float], head: float = 0.0, eyes: float = 0.0) -> FaceParams:
    """Return a person who talks a little around what is held throughout. Angles to the left are in degrees."""
    random, given = np.random.default_rng(0), model()
    expression = 0.1 * random.uniform(size=(FRAMES, len(given.expression_names)))
    for name, value in held.items():
        expression[:, given.expression_names.index(name)] += value
    expression[:5] *= 0.9
    joints = torch.zeros(FRAMES, len(given.free_joint_names), 3)
    for index, name in enumerate(given.free_joint_names):
        if "eye" in name:
            joints[:, index, 1] = np.radians(eyes)
    rotation = torch.zeros(FRAMES, 3)
    rotation[:, 1] = np.radians(head)
    rotation[:, 0] = 0.02 * torch.sin(torch.arange(FRAMES) / 9)
    return FaceParams(
        given.neutral().identity, torch.from_numpy(expression).float(), joints, rotation,
        torch.zeros(FRAMES, 3), given.neutral().vertex_offsets,
    )  # fmt: skip


def driven(face: FaceParams, neutral: str | None = None) -> FaceParams:
    driver = with_neutral(Driver(face, neutral_of(face), 25.0, None), model(), neutral, "clip")
    return drive(driver.face, driver.at_rest, model().neutral())


def test_what_is_held_throughout_reaches_the_avatar(capsys: pytest.CaptureFixture[str]) -> None:
    """An open mouth, raised brows and a grin that never end are motion. The default says so, and calm is as before."""
    for held in (
        {"jawOpen": 0.6}, {"browInnerUp": 0.8, "browOuterUpLeft": 0.7}, {"mouthSmileLeft": 0.7, "mouthSmileRight": 0.7},
    ):  # fmt: skip
        face, name = talking(held), list(held)[0]
        index = NAMES.index(name)
        torch.testing.assert_close(driven(face).expression[:, index], face.expression[:, index])
        told = capsys.readouterr().err
        for words in (
            "clip: its face at rest is the calmest tenth of its frames", f"clip: it never rests ({name} 0.",
            "--neutral calm",
        ):  # fmt: skip
            assert words in told
        assert driven(face, "calm").expression[:, index].mean() < 0.1
        torch.testing.assert_close(driven(face, "model").expression[:, index], face.expression[:, index])


def test_a_head_or_gaze_turned_throughout_reaches_the_avatar() -> None:
    head, gaze = talking({}, head=55), talking({}, eyes=26)
    for neutral in (None, "model"):
        torch.testing.assert_close(driven(head, neutral).head_rotation, head.head_rotation, atol=1e-5, rtol=0)
    assert driven(head, "calm").head_rotation.abs().max() < 0.05
    assert driven(gaze, "calm").joints.abs().max() < 1e-5
    # Eyes that make up for a turned head move with it: it looks into the camera still.
    for face in (gaze, talking({}, head=60, eyes=-50)):
        torch.testing.assert_close(driven(face).joints, face.joints, atol=1e-5, rtol=0)


def test_who_rests_is_transferred_as_before() -> None:
    for face in (talking({"browInnerUp": 0.2}, head=-25, eyes=24), talking({"jawOpen": 0.15}, eyes=10), talking({})):
        calm = neutral_of(face)
        rest = rest_of(calm, model())
        assert rest.moved == ()
        for name, tensor in calm.tensors().items():
            assert torch.equal(getattr(rest.face, name), tensor), name
    # What counts as ahead is the camera of any world. Who looks into it rests there.
    viewmat = torch.eye(4)
    viewmat[:3, :3] = matrix_from_axis_angle(torch.tensor([0.4, 2.2, -0.8]))
    ahead = facing(viewmat)
    calm = replace(neutral_of(talking({})), head_rotation=axis_angle_from_matrix(ahead)[None])
    assert rest_of(calm, model(), ahead).moved == ()
    aside = ahead @ matrix_from_axis_angle(torch.tensor([0.0, 1.0, 0.0]))
    rest = rest_of(replace(calm, head_rotation=axis_angle_from_matrix(aside)[None]), model(), ahead)
    torch.testing.assert_close(matrix_from_axis_angle(rest.face.head_rotation)[0], ahead, atol=1e-5, rtol=0)
    assert rest.moved == ("the head 57 degrees to the side",)


def test_motion_grows_without_a_jump() -> None:
    for limits in (DRIVING.rest_expression, DRIVING.rest_head, DRIVING.rest_gaze):
        sizes = torch.linspace(0, 2 * limits[1], 2001)
        moved = sizes * (1 - kept_share(sizes, limits))
        assert ((moved.diff() >= 0) & (moved.diff() < 0.01)).all()
        assert (moved[sizes <= limits[0]] == 0).all()
        torch.testing.assert_close(moved[sizes >= limits[1]], sizes[sizes >= limits[1]])


def tracked(folder: Path, first: float, then: float) -> Path:
    """Write a tracked sequence of 30 frames. Its first expression has two values, before and after frame 15."""
    _, sequence = toy_sequence(30, 32)
    expression = torch.zeros_like(sequence.tracking.face.expression)
    expression[:15, 0], expression[15:, 0] = first, then
    face = replace(sequence.tracking.face, expression=expression)
    write_sequence(folder, sequence.capture, replace(sequence.tracking, face=face))
    return folder


def recorded(path: Path, count: int, **values: float) -> Path:
    return write_csv(path, *(row(f"0:00:00:{index:02d}.0", JawOpen=0.5, **values) for index in range(count)))


def test_the_option_of_every_command(tmp_path: Path) -> None:
    workspace, other = tmp_path / "w", tmp_path / "other"
    tracked(workspace / "sequences" / "clip", 0.7, 0.5)
    still = tracked(other / "sequences" / "still", 0.1, 0.1)
    for neutral, expected in (
        (None, 0.5 / 3), ("first", 0.7), ("calm", 0.5), ("model", 0.0), (str(other), 0.1), (str(still), 0.1),
    ):  # fmt: skip
        driver = open_driver(workspace, None, toy_face_model(), neutral=neutral)
        assert float(driver.at_rest.expression[0, 0]) == pytest.approx(expected, abs=1e-6), neutral
    refuses(r"--neutral rest: no such file; give first, calm or model", check_neutral, "rest")
    with pytest.raises(UserError, match="was tracked with another face model"):
        open_driver(recorded(tmp_path / "a.csv", 3), None, model(), neutral=str(still))
    # The zero of a recording's coefficients is the recorder's neutral; its head may be turned throughout.
    by = recorded(tmp_path / "b.csv", 30, HeadYaw=0.9)
    for neutral, jaw, turn in ((None, 0.0, 0.0), ("calm", 0.5, 0.9), ("first", 0.5, 0.9), ("model", 0.0, 0.0)):
        rest = open_driver(by, None, model(), neutral=neutral).at_rest
        assert float(rest.expression[0, NAMES.index("jawOpen")]) == pytest.approx(jaw), neutral
        assert float(rest.head_rotation.norm()) == pytest.approx(turn, abs=1e-5), neutral
