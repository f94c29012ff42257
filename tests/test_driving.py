"""Drivers of every kind: how `mien drive --by` opens them, their sides, times, and transfer to the avatar's frame."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from known import known
from mien.avatar import neutral_of
from mien.avatar.resting import at_rest
from mien.camera import camera_from_fov
from mien.capture.capture import Capture
from mien.capture.quality import frame_rate, pace_report
from mien.disk.workspace import Workspace
from mien.driving import drive
from mien.driving.blendshape_json import read_blendshape_json
from mien.driving.drivers import Driver, read_tracked_driver
from mien.driving.live_link_face import read_live_link_face
from mien.driving.motion import ARKIT_NAMES, PAIRS, Motion, gaze_of
from mien.driving.transfer import face_of_motion
from mien.errors import UserError
from mien.face import FaceParams, load_face_model
from mien.media.video import probe_video, write_video
from mien.pipeline import drive as driving
from mien.pipeline.drive import open_driver, run_driving_stage
from mien.render.camera_paths import turned_camera
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle
from mien.runtime.camera_paths import turntable
from mien.tracking.tracking import Tracking
from recordings import LAYOUTS, row, write_csv
from refusals import refuses
from shared_things import write_sequence, write_toy_workspace
from small_face_model import make_small_face_model
from toy_scene import toy_face_model, toy_sequence


def _face(timesteps: int, seed: int = 0, expressions: int = 6) -> FaceParams:
    shapes = (4,), (timesteps, expressions), (timesteps, 3, 3), (timesteps, 3), (timesteps, 3), (5, 3)
    generator = torch.Generator().manual_seed(seed)
    numbers = [torch.randn(shape, generator=generator) for shape in shapes]
    return FaceParams(numbers[0], numbers[1].abs(), 0.2 * numbers[2], 0.3 * numbers[3], 0.1 * numbers[4], numbers[5])


def test_driving_an_avatar_with_itself_changes_nothing() -> None:
    face, avatar, other = _face(7), neutral_of(_face(9, 1)), neutral_of(_face(9, 2))
    neutral = neutral_of(face)
    for driven, expected in ((drive(face, neutral, neutral), face), (drive(other, other, avatar), avatar)):
        for name, tensor in expected.tensors().items():
            torch.testing.assert_close(getattr(driven, name), tensor, atol=1e-5, rtol=1e-5)
    free = drive(face, neutral, avatar)
    bounded = drive(face, neutral, avatar, torch.tensor([[0.0, 1.0]]).expand(6, 2))
    torch.testing.assert_close(free.expression, avatar.expression + face.expression - neutral.expression)
    torch.testing.assert_close(bounded.expression, free.expression.clamp(0, 1))
    few = _face(3, expressions=5)
    refuses("different face models", drive, few, neutral_of(few), avatar)
    # The face at rest ignores talking and a bad frame.
    talking, rest = _face(100), torch.tensor([0.3, 0.0, 0.0, 0.1, 0.0, 0.0])
    talking.expression[40:60] = rest
    talking.expression[70] = 50.0
    torch.testing.assert_close(neutral_of(talking).expression, rest[None])


def test_the_person_at_rest_has_closed_lips_and_open_eyes() -> None:
    """All frames part the lips, and the calmest ones blink. What belongs to the person stays."""
    model = load_face_model("anny")
    jaw, brow, blink = (model.expression_names.index(name) for name in ("jawOpen", "browInnerUp", "eyeBlinkLeft"))
    face, value = (many := model.neutral(40)), many.expression
    value[:, jaw], value[:, brow], value[:4, blink] = torch.linspace(0.2, 0.5, 40), 0.2, 0.2
    rest = at_rest(face, model).expression[0]
    assert [float(rest[each]) for each in (jaw, brow, blink)] == pytest.approx([0.0, 0.2, 0.0], abs=0.02)


def test_motion_is_done_in_the_avatars_own_frame() -> None:
    rest = replace(neutral_of(_face(3)), head_rotation=torch.tensor([[0.0, math.pi / 2, 0.0]]))
    avatar = replace(neutral_of(_face(3, 5)), head_rotation=torch.zeros(1, 3))
    turn = matrix_from_axis_angle(rest.head_rotation)
    nod, ahead = torch.tensor([[0.3, 0, 0]]), torch.tensor([0, 0, 0.1])
    turned = axis_angle_from_matrix(turn @ matrix_from_axis_angle(nod))
    driver = replace(rest, head_rotation=turned, head_translation=rest.head_translation + turn @ ahead)
    driven = drive(driver, rest, avatar)
    torch.testing.assert_close(driven.head_rotation, nod, atol=1e-5, rtol=0)
    torch.testing.assert_close(driven.head_translation[0] - avatar.head_translation[0], ahead, atol=1e-6, rtol=0)
    still = drive(driver, rest, avatar, with_head_pose=False)
    assert torch.equal(still.head_rotation, avatar.head_rotation)


def test_turntables_and_cameras_aside_keep_the_center_in_its_place() -> None:
    camera = camera_from_fov(0.5, 64, 48, torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])))
    center = torch.tensor([0.02, 0.05, -0.6])
    path = [turned_camera(camera, center, *angles) for angles in turntable(8, 2 * math.pi)]
    place, depth = camera.project(center)
    for view in path:
        pixel, far = view.project(center)
        torch.testing.assert_close(pixel, place, atol=1e-3, rtol=0)
        torch.testing.assert_close(far, depth)
        assert float(view.position[1]) == pytest.approx(0, abs=1e-6)
    torch.testing.assert_close(path[0].viewmat, camera.viewmat)
    # A quarter turn, counter-clockwise from above (from +z towards +x), looks along -x.
    for index, offset, most in ((2, [0.6, -0.05, 0.02], 1e-6), (4, [0.02, -0.05, -0.6], 1e-5)):
        torch.testing.assert_close(path[index].position, center + torch.tensor(offset), atol=most, rtol=0)
    swing = turntable(8, span=1.0)
    assert [swing[index][0] for index in (0, 2, 6, 4)] == pytest.approx([0, 0.5, -0.5, 0])
    # A yaw of 90 degrees looks at the person's left side, a pitch of 30 from above, and 0 changes no bit.
    camera = camera_from_fov(0.5, 64, 48, torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])))
    center, ahead = torch.tensor([0.0, 0.0, -0.6]), 0.6 * math.sqrt(0.75)
    for yaw, pitch, place in ((90, 0, [0.6, 0.0, 0.0]), (0, 30, [0.0, 0.3, ahead]), (90, 30, [ahead, 0.3, 0.0])):
        turned = turned_camera(camera, center, math.radians(yaw), math.radians(pitch))
        torch.testing.assert_close(turned.position - center, torch.tensor(place), atol=1e-6, rtol=0)
        torch.testing.assert_close(turned.project(center)[0], camera.project(center)[0], atol=1e-3, rtol=0)
    assert turned_camera(camera, center, 0.0, 0.0).viewmat.equal(camera.viewmat)


PARTS = {"clip-1": 3, "clip-2": 4, "clip-10": 2}
"""Timesteps of the parts of a video with cuts. There are so many that by letters clip-10 would come second."""


@pytest.fixture
def video(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a video whose capture and tracking are given. Each part has its own grey and its own head pose."""

    def run_capture_stage(workspace: Workspace, *_: object) -> list[str]:
        for number, (name, timesteps) in enumerate(PARTS.items(), 1):
            capture, tracking = part(number, timesteps)
            write_sequence(workspace.sequence_dir(name), capture, tracking)
        return list(PARTS)

    def run_tracking_stage(*_: object, **__: object) -> dict[str, Tracking]:
        return {name: part(1, PARTS[name])[1] for name in sorted(PARTS)}

    monkeypatch.setattr(driving, "run_capture_stage", run_capture_stage)
    monkeypatch.setattr(driving, "run_tracking_stage", run_tracking_stage)
    monkeypatch.setattr(driving, "cache_folder", lambda: tmp_path / "cache")
    path = tmp_path / "clip.mp4"
    write_video(path, [np.zeros((32, 32, 3), np.uint8)] * 2, 25.0)
    return path


def part(number: int, timesteps: int) -> tuple[Capture, Tracking]:
    _, sequence = toy_sequence(timesteps, 32)
    face = replace(sequence.tracking.face, head_rotation=torch.full((timesteps, 3), 0.01 * number))
    gray = np.full_like(sequence.capture.images, 10 * number)
    return replace(sequence.capture, images=gray), replace(sequence.tracking, face=face)


@pytest.mark.unchecked
def test_one_part_of_a_video_can_be_chosen(video: Path, tmp_path: Path) -> None:
    numbers = [1] * 3 + [2] * 4 + [3] * 2
    for part_name, expected in ((None, numbers), ("clip-2", [2] * 4)):
        driver = open_driver(video, part_name, toy_face_model())
        torch.testing.assert_close(driver.face.head_rotation[:, 0], 0.01 * torch.tensor(expected))
        shown = [int(known(driver.pictures)(index)[0, 0, 0]) for index in range(len(expected))]
        assert shown == [10 * number for number in expected]
        # All parts share one neutral face, with the head where it mostly is.
        assert float(driver.at_rest.head_rotation[0, 0]) == pytest.approx(0.02)
    refuses("no sequence 'clip-3'; there are: clip-1, clip-10, clip-2", open_driver, video, "clip-3", toy_face_model())
    write_toy_workspace(tmp_path / "w")
    run_driving_stage(tmp_path / "w/runs/toy", video, tmp_path / "driven.mp4")
    assert probe_video(tmp_path / "driven.mp4").frames == len(numbers)


def test_the_rate_of_a_csv_can_be_given(tmp_path: Path) -> None:
    names = ("jawOpen", *(f"other{index}" for index in range(7)))
    model = replace(make_small_face_model(), expression_names=names)
    take = write_csv(tmp_path / "a.csv", *(row(f"0:00:00:{2 * index:02d}.0", JawOpen=index / 4) for index in range(4)))
    for fps, expected in ((None, 30.0), (24.0, 12.0), (48.0, 24.0)):
        driver = open_driver(take, None, model, fps)
        assert (driver.fps, len(driver.face)) == (pytest.approx(expected), 4)
    for by, fps in ((take, -1.0), (take, float("nan")), (tmp_path, 25.0)):
        refuses("--fps", open_driver, by, None, model, fps)
    refuses(r"--sequence a: .*a\.csv has no sequences", open_driver, take, "a", model)


PERFORMERS = [name for pair in PAIRS for name in pair]
OBSERVERS = {"Live Link Face (.csv)": ("jawLeft", "jawRight", "mouthLeft", "mouthRight")}
"""Coefficients whose left is the right of the face, by source: `mien.driving.sides` once more, on purpose."""
SLIDES = ("jawLeft", "jawRight", "mouthLeft", "mouthRight")


@pytest.mark.parametrize(("source", "write"), [(source, write) for source in LAYOUTS for write in LAYOUTS[source]])
def test_coefficients_of_observers_change_their_side(source: str, write, tmp_path: Path) -> None:
    path = write(tmp_path, [{}, *({name: 1.0} for name in PERFORMERS)])
    motion = read_live_link_face(path) if path.suffix == ".csv" else read_blendshape_json(path)
    assert (motion.coefficients[0] == 0).all()
    assert {name for name in ARKIT_NAMES if "Left" in name or "Right" in name} == set(PERFORMERS)
    other = {one: two for pair in PAIRS for one, two in (pair, pair[::-1])}
    for name, coefficients in zip(PERFORMERS, motion.coefficients[1:], strict=True):
        expected = other[name] if name in OBSERVERS.get(source, ()) else name
        assert coefficients.sum() == coefficients[ARKIT_NAMES.index(expected)] == 1, name


@pytest.mark.unchecked
def test_each_coefficient_moves_its_side_of_a_face() -> None:
    """The subject's left is +x. A slide moves points to its side, and all others move points on their side."""
    coefficients = np.zeros((1 + len(PERFORMERS), len(ARKIT_NAMES)), np.float32)
    coefficients[range(1, len(coefficients)), [ARKIT_NAMES.index(name) for name in PERFORMERS]] = 1
    still = np.zeros((len(coefficients), 3), np.float32)
    model = load_face_model("anny")
    face, _ = face_of_motion(Motion(30.0, coefficients, gaze_of(coefficients), still, still, 0), model)
    vertices = model.head_vertices(face)
    moved = vertices[1:] - vertices[:1]
    on_left = vertices[0, :, 0] > 0
    for index, name in enumerate(PERFORMERS):
        size = moved[index].norm(dim=1)
        assert size.max() > 1e-3, name
        to_left = moved[index, :, 0].sum() if name in SLIDES else size[on_left].sum() - size[~on_left].sum()
        assert bool(to_left > 0) == name.endswith("Left"), name
    for name, way in (("eyeLookInLeft", -1), ("eyeLookOutLeft", 1), ("eyeLookInRight", 1), ("eyeLookOutRight", -1)):
        irises = moved[PERFORMERS.index(name)][model.faces[model.region_mask("irises")].long().flatten()]
        assert way * irises[:, 0].sum() > 0, name


def test_pauses_and_dropped_and_odd_frames_do_not_change_the_rate(capsys: pytest.CaptureFixture[str]) -> None:
    """A pause of 20 s in a clip at 30 frames a second leaves 30, however the file states its rate."""
    times = np.concatenate([np.arange(30), 600 + np.arange(30)]) / 30
    for nominal in (30.0, 60 / times[-1], 1000.0):
        assert frame_rate(times, nominal) == pytest.approx(30)
    assert pace_report("clip", times)["pauses"] == 1
    assert "clip: a pause of 19.0 s without a frame, after 1.0 s" in capsys.readouterr().err
    pace_report("clip", np.concatenate([times[:40], 60 + times]))
    assert "3 pauses, the longest of 39.7 s without a frame, after 20.3 s" in capsys.readouterr().err
    kept = np.flatnonzero(np.random.default_rng(0).uniform(size=300) > 0.2)
    assert frame_rate((kept - kept[0]) / 25, 25.0) == 25
    assert frame_rate((kept - kept[0]) / 25, 19.9) == pytest.approx(25)
    assert frame_rate(np.cumsum([0, *[2, 3] * 20]) / 60, 60.0) == pytest.approx(24)  # a film
    # Files of whole milliseconds say 33, 33 and 34 ms.
    assert frame_rate(np.round(np.arange(100) / 30, 3), 30.0) == 30
    for fps in (24.0, 29.97, 60.0):
        times = np.arange(90) / fps
        assert frame_rate(times, fps) == fps
        assert frame_rate(times, 2 * fps) == (len(times) - 1) / times[-1]
        assert "pauses" not in pace_report("clip", times)
    assert frame_rate(np.zeros(3), 25.0) == frame_rate(np.zeros(1), 25.0) == frame_rate(np.zeros(0), 25.0) == 25


def filmed_at(folder: Path, frames: np.ndarray, fps: float = 25.0) -> Driver:
    """Return a driver with some frames of 25 a second. Its head turns by 0.01 radians a frame; grey is their index."""
    _, sequence = toy_sequence(len(frames), 32)
    turned = torch.zeros(len(frames), 3)
    turned[:, 1] = 0.01 * torch.from_numpy(frames).float()
    gray = np.zeros_like(sequence.capture.images) + np.arange(len(frames), dtype=np.uint8)[:, None, None, None, None]
    tracking = replace(sequence.tracking, face=replace(sequence.tracking.face, head_rotation=turned))
    write_sequence(folder, replace(sequence.capture, timestamps=frames / 25, fps=fps, images=gray), tracking)
    return read_tracked_driver([folder])


def test_a_driver_moves_at_the_times_of_its_video(tmp_path: Path) -> None:
    """Every second frame of the second half is missing, and the file states the mean rate."""
    frames = np.concatenate([np.arange(20), 20 + 2 * np.arange(10)])
    driver = filmed_at(tmp_path / "half", frames, float(25 * len(frames) / frames[-1]))
    assert driver.fps == pytest.approx(25)
    torch.testing.assert_close(driver.face.head_rotation[:, 1], 0.01 * torch.arange(39), atol=1e-6, rtol=0)
    shown = [int(known(driver.pictures)(index)[0, 0, 0]) for index in range(39)]
    assert shown[:21] == list(range(21))
    assert np.abs(frames[shown] - np.arange(39)).max() <= 1
    assert shown[-1] == 29
    steady = filmed_at(tmp_path / "steady", np.arange(9))
    assert steady.fps == 25
    assert torch.equal(steady.face.head_rotation[:, 1], 0.01 * torch.arange(9).float())
    filmed_at(tmp_path / "slow", np.arange(4) * 2, 12.5)
    assert read_tracked_driver([tmp_path / "slow", tmp_path / "steady"]).fps == 25, "the rate of the longer one"


def test_a_driver_waits_in_a_pause_but_not_in_one_that_never_ends(tmp_path: Path) -> None:
    """In a pause of two seconds, the face is held, and it moves on just before the next frame."""
    angles = filmed_at(tmp_path, np.concatenate([np.arange(10), 60 + np.arange(10)])).face.head_rotation[:, 1]
    assert len(angles) == 70
    assert (angles[9:60] - angles[9]).abs().max() < 1e-6
    torch.testing.assert_close(angles[60:], 0.01 * torch.arange(60, 70), atol=1e-6, rtol=0)
    with pytest.raises(UserError, match="frame 5: comes 100 s after the one before"):
        filmed_at(tmp_path, np.concatenate([np.arange(5), 2500 + np.arange(5)]))
