"""The viewer without a browser: its session, its loop, its pictures, its door, and its command."""

import itertools
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from urllib.parse import urljoin

import cv2
import numpy as np
import pytest

from mien import runtime
from mien.capture.video import count_frames
from mien.cli import main
from mien.errors import UserError
from mien.export import Motion
from mien.export.pictures import to_rgb
from mien.face import load_face_model
from mien.runtime.posing import rig_points
from mien.viewer.access import Door, is_loopback
from mien.viewer.drawing import Look, Mesh, View, beside, draw, words_about_view
from mien.viewer.faces import (
    PRESETS,
    RANDOM_EXPRESSIONS,
    group_of,
    grouped,
    matches,
    preset_expression,
    presets_for,
    random_expression,
    readable,
)
from mien.viewer.files import TURNTABLE_FRAMES, Stopped, around, screenshot, video
from mien.viewer.loop import STILL_SECONDS, DrawingLoop
from mien.viewer.session import Clip, Session, center_of
from mien.viewer.work import Worker
from toy_workspace import write_toy_workspace
from web_case import drawn_head, faces_of

NAMES = load_face_model("anny").expression_names
BOUNDS = load_face_model("anny").expression_bounds.numpy()


@pytest.fixture(scope="module")
def avatar() -> runtime.Avatar:
    return runtime.Avatar(drawn_head(2000))


@pytest.fixture
def session(avatar: runtime.Avatar) -> Session:
    baked = avatar.portable.baked
    assert isinstance(baked, runtime.MeshBound)
    mesh = Mesh(baked.rig, baked.faces, np.linspace(0, 1, len(baked.faces), dtype=np.float32))
    return Session(avatar, mesh, {"clip": lambda: clip_of(avatar)})


def clip_of(avatar: runtime.Avatar, fps: float = 10.0) -> Clip:
    faces = faces_of(avatar.portable, 4)
    motion = Motion(*(np.stack([getattr(face, name) for face in faces]) for name in vars(faces[0])), fps=fps)
    return Clip(motion, lambda timestep: np.full((40, 20, 3), 10 * timestep, np.uint8))


def front_view(avatar: runtime.Avatar, width: int = 96, height: int = 64) -> View:
    """Return the view of the avatar's camera in a browser window."""
    camera = avatar.camera
    field = 2 * np.arctan(0.5 * camera.height / camera.K[1, 1])
    return View(camera.viewmat.astype(float), float(field), width, height)


# Faces.


def test_expressions_are_in_groups_for_people() -> None:
    groups = grouped(NAMES, BOUNDS)
    assert list(groups) == ["Jaw", "Mouth", "Eyes", "Brows", "Cheeks and nose"]
    assert sorted(sum(groups.values(), [])) == sorted(n for n, b in zip(NAMES, BOUNDS, strict=True) if b[0] < b[1])
    assert {group_of(name) for name in ("expr_00", "", "Jaw")} == {"Other"}
    assert readable("mouthSmileLeft") == "mouth smile left"
    assert readable("left_eye") == "left eye"


@pytest.mark.parametrize(
    ("text", "found"), [("", True), ("smile", True), ("SMILE left", True), ("left smile", True), ("smile right", False)]
)
def test_search_finds_words_in_any_order(text: str, found: bool) -> None:
    assert matches(text, "mouthSmileLeft") is found


def test_presets_stay_in_bounds_and_need_their_expressions() -> None:
    assert presets_for(NAMES) == list(PRESETS)
    assert presets_for(("jawOpen", "expr_1")) == ["open mouth"]
    rest = np.full(len(NAMES), 0.5, np.float32)
    for preset in PRESETS:
        values = preset_expression(preset, NAMES, rest, BOUNDS)
        assert (values >= BOUNDS[:, 0]).all()
        assert (values <= BOUNDS[:, 1]).all()
    assert preset_expression("open mouth", NAMES, rest * 0, BOUNDS)[NAMES.index("jawOpen")] == pytest.approx(0.7)


def test_random_faces_differ_and_are_alike_on_both_sides() -> None:
    rest, random = np.zeros(len(NAMES), np.float32), np.random.default_rng(0)
    faces = [random_expression(NAMES, rest, BOUNDS, random) for _ in range(20)]
    assert all(not np.array_equal(one, other) for one, other in itertools.pairwise(faces))
    for face in faces:
        assert (face >= BOUNDS[:, 0]).all()
        assert (face <= BOUNDS[:, 1]).all()
        moved = {
            name.removesuffix("Left").removesuffix("Right") for name, value in zip(NAMES, face, strict=True) if value
        }
        assert 0 < len(moved) <= RANDOM_EXPRESSIONS
        assert face[NAMES.index("mouthSmileLeft")] == face[NAMES.index("mouthSmileRight")]


# The loop.


class Stage:
    """A loop with a clock that stands still, and drawings that take as long as one wants."""

    def __init__(self, seconds: float = 0.1, advance: Callable[[float], float | None] | None = None) -> None:
        self.now, self.seconds = 100.0, seconds
        self.drawn: list[tuple[int, bool]] = []
        self.shown: list[tuple[int, int, bool]] = []
        self.loop = DrawingLoop(self.draw, advance, lambda: self.now)

    def draw(self, view: View, full: bool) -> int:
        self.now += self.seconds
        self.drawn.append((view.width, full))
        return view.width

    def add(self, client: int) -> None:
        self.loop.add(client, lambda picture, full: self.shown.append((client, picture, full)))

    def look(self, client: int, width: int) -> None:
        self.loop.look(client, View(np.eye(4), 0.5, width, 10))


def test_the_newest_request_wins() -> None:
    stage = Stage()
    stage.add(1)
    assert stage.loop.step() is None
    for width in (11, 12, 13):
        stage.look(1, width)
    assert stage.loop.step() == 0
    assert stage.shown == [(1, 13, False)]


def test_pictures_are_full_when_nothing_moves() -> None:
    stage = Stage()
    stage.add(1)
    stage.look(1, 11)
    stage.loop.step()
    rest = stage.loop.step()
    assert rest == pytest.approx(STILL_SECONDS - stage.seconds)
    stage.now += rest
    stage.loop.step()
    assert stage.shown == [(1, 11, False), (1, 11, True)]
    assert stage.loop.step() is None
    stage.loop.change()
    stage.loop.step()
    assert stage.shown[2:] == [(1, 11, False)]


def test_quick_pictures_are_always_full() -> None:
    stage = Stage(seconds=0.004)
    stage.add(1)
    sizes = []
    for seconds in (0.004, 0.016, 0.016, 0.03, 0.03, 0.03, 0.09, 0.0225, 0.0075, *[0.0035] * 6):
        stage.seconds = seconds
        stage.look(1, 11)
        stage.loop.step()
        sizes.append(stage.drawn[-1][1])
    # It starts with half size; 30 ms do not change it, 90 ms do, and back only far below.
    assert sizes[:9] == [False, *[True] * 6, False, False]
    assert sizes[-1]


def test_two_clients_take_turns() -> None:
    stage = Stage()
    stage.add(1)
    stage.add(2)
    for width in range(11, 17):
        stage.look(1, width)
        stage.look(2, width)
        stage.loop.step()
    counts = [sum(client == shown for shown, _, _ in stage.shown) for client in (1, 2)]
    assert counts == [3, 3]


def test_a_client_that_vanished_is_not_shown() -> None:
    stage = Stage()
    stage.add(1)
    stage.add(2)
    stage.look(1, 11)
    stage.look(2, 12)
    stage.loop.remove(1)
    stage.loop.remove(7)
    stage.look(1, 13)
    while stage.loop.step() == 0:
        pass
    assert {client for client, _, _ in stage.shown} == {2}
    original = stage.draw

    def vanish(view: View, full: bool) -> int:
        stage.loop.remove(2)
        return original(view, full)

    stage.loop._draw = vanish
    stage.look(2, 14)
    stage.loop.step()
    assert all(picture != 14 for _, picture, _ in stage.shown)


def test_the_loop_wakes_for_what_plays() -> None:
    times = iter((None, 100.7))
    stage = Stage(advance=lambda now: next(times))
    assert stage.loop.step() is None
    assert stage.loop.step() == pytest.approx(0.7)


def test_a_picture_that_fails_concerns_its_client_alone() -> None:
    failures: list[Exception] = []

    def draw(view: View, full: bool) -> int:
        if view.width == 13:
            raise ArithmeticError("a bug")
        return view.width

    stage = Stage()
    stage.loop = DrawingLoop(draw, clock=lambda: stage.now, failed=failures.append)
    stage.add(1)
    stage.add(2)
    stage.look(1, 13)
    stage.look(2, 14)
    assert [stage.loop.step() for _ in range(2)] == [0, 0]
    assert stage.shown == [(2, 14, False)]
    assert [str(failure) for failure in failures] == ["a bug"]
    stage.now += STILL_SECONDS
    assert [stage.loop.step() for _ in range(2)] == [0, None], "what failed is not tried again"
    stage.look(1, 15)
    assert stage.loop.step() == 0
    assert stage.shown[-1][:2] == (1, 15)


def test_a_picture_that_cannot_be_shown_concerns_its_client_alone() -> None:
    def show(picture: int, full: bool) -> None:
        raise ConnectionError("the browser is gone")

    failures: list[Exception] = []
    stage = Stage()
    stage.loop = DrawingLoop(stage.draw, failed=failures.append)
    stage.loop.add(1, show)
    stage.look(1, 13)
    assert stage.loop.step() == 0
    assert len(failures) == 1


def test_a_failure_that_concerns_all_ends_the_loop_and_is_kept() -> None:
    def fail(now: float) -> float:
        raise ArithmeticError("a bug")

    loop = DrawingLoop(lambda view, full: 0, fail)
    loop.start()
    loop.wait(10.0)
    assert not loop.running
    assert isinstance(loop.error, ArithmeticError)
    loop.stop()


def test_the_loop_stops() -> None:
    loop = DrawingLoop(lambda view, full: 0, lambda now: now + 1000)
    loop.start()
    loop.stop()
    assert not loop.running
    assert loop.error is None


# Slow work.


def test_a_worker_bounds_what_waits() -> None:
    begun, go_on, done, failures = threading.Event(), threading.Event(), [], []

    def slow() -> None:
        begun.set()
        go_on.wait()
        done.append("slow")

    worker = Worker("test", failures.append, most=2)
    assert worker.ask("a", slow)
    assert begun.wait(10)
    assert worker.ask("b", lambda: done.append("old"))
    assert worker.ask("b", lambda: done.append("new")), "the newest of a kind wins"
    assert worker.ask("c", lambda: done.append(1 // 0))
    assert not worker.ask("d", lambda: done.append("too much"))
    go_on.set()
    while len(failures) < 1:
        time.sleep(0.001)
    assert done == ["slow", "new"]
    assert isinstance(failures[0], ZeroDivisionError)
    worker.stop()
    assert not worker.ask("e", lambda: done.append("stopped"))


def test_a_worker_without_a_queue_takes_nothing_while_it_works() -> None:
    begun, go_on = threading.Event(), threading.Event()

    def slow() -> None:
        begun.set()
        go_on.wait()

    worker = Worker("test", print, most=0)
    assert worker.ask(1, slow)
    assert begun.wait(10)
    assert not worker.ask(2, slow)
    go_on.set()
    worker.stop()


# The session.


def test_sliders_change_the_face_within_bounds(session: Session) -> None:
    changes = []
    session.changed = lambda: changes.append(session.version)
    index = session.avatar.expression_names.index("jawOpen")
    session.set_expression("jawOpen", 0.5)
    assert session.face.expression[index] == 0.5
    session.set_expression("jawOpen", 7.0)
    assert session.face.expression[index] == session.avatar.portable.expression_bounds[index, 1]
    for wrong in (float("nan"), float("inf"), -float("inf")):
        with pytest.raises(UserError, match=f"jawOpen {wrong}: is not finite"):
            session.set_expression("jawOpen", wrong)
        with pytest.raises(UserError, match="is not finite"):
            session.set_joint(session.avatar.joint_names[0], 1, wrong)
    for asked, told in (
        ({"background": "purple"}, "background 'purple': there is none; give one of white, grey, black"),
        ({"surface": "inside"}, "surface 'inside': there is none"),
        ({"height": 10**300}, "give 1 to 2048 pixels"),
    ):
        with pytest.raises(UserError, match=told):
            session.show(**asked)
    session.set_joint(session.avatar.joint_names[0], 1, 0.25)
    assert session.face.joints[0, 1] == 0.25
    assert session.face.expression[index] > 0
    session.take_preset("smile")
    assert session.face.expression[session.avatar.expression_names.index("mouthSmileLeft")] > 0.5
    session.take_random(np.random.default_rng(0))
    session.rest()
    np.testing.assert_array_equal(session.face.expression, session.avatar.portable.neutral.expression)
    assert len(changes) == 6
    assert changes == sorted(changes)


def test_random_faces_keep_to_what_was_filmed(session: Session) -> None:
    portable = session.avatar.portable
    count = len(portable.neutral.expression) + portable.neutral.joints.size
    nothing = np.zeros(count, np.float32)
    limits = runtime.Filmed(
        nothing, nothing, np.eye(count, dtype=np.float32), *(np.ones(n, np.float32) for n in (1, (2, 2)))
    )
    limited = Session(runtime.Avatar(replace(portable, filmed=limits)))
    for one in (session, limited):
        one.take_random(np.random.default_rng(3))
    most = 0.2 * np.abs(portable.expression_bounds).max()
    assert np.abs(limited.face.expression).max() < most < np.abs(session.face.expression).max()


def test_a_motion_plays_by_the_clock(session: Session) -> None:
    assert session.advance(0.0) is None
    session.play(True, 0.0)
    assert not session.playing
    session.choose("clip")
    motion = session.clip.motion if session.clip else None
    assert motion is not None
    session.play(True, 10.0)
    assert session.advance(10.05) == pytest.approx(10.1)
    assert session.timestep == 0
    assert session.advance(10.1) == pytest.approx(10.2)
    assert session.timestep == 1
    np.testing.assert_array_equal(session.face.expression, motion.expression[1])
    session.advance(10.35)  # a slow machine leaves timesteps out
    assert session.timestep == 3
    session.advance(10.45)
    assert session.timestep == 0
    session.advance(10.55)
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
    assert session.clip is None
    session.seek(1)
    assert session.timestep == 0


def test_a_motion_that_cannot_be_loaded_leaves_all_as_it_was(avatar: runtime.Avatar) -> None:
    def damaged() -> Clip:
        raise UserError("a.csv: is damaged")

    session = Session(avatar, None, {"good": lambda: clip_of(avatar), "bad": damaged})
    session.choose("good")
    session.seek(2)
    with pytest.raises(UserError, match=r"a\.csv"):
        session.choose("bad")
    assert session.clip is not None
    assert session.timestep == 2


def test_pictures_have_the_shape_of_the_window(session: Session) -> None:
    view = front_view(session.avatar, 960, 640)
    assert session.picture(view).shape == (512, 768, 3)
    assert session.picture(view, full=False).shape == (256, 384, 3)
    session.show(height=128)
    assert session.picture(view).shape == (128, 192, 3)
    small = front_view(session.avatar, 30, 20)
    assert session.picture(small).shape == (20, 30, 3)
    assert front_view(session.avatar, 9000, 20).sized(512)[0] == 2048


def test_a_view_is_that_of_the_native_renderer(session: Session) -> None:
    camera = session.avatar.camera.resized(64, 64)
    expected, _ = session.avatar.render(session.avatar.pose(), camera)
    np.testing.assert_array_equal(session.picture(front_view(session.avatar, 64, 64)), to_rgb(expected))


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
    assert columns.min() >= pixels[:, 0].min() - 2
    assert columns.max() <= pixels[:, 0].max() + 2
    session.show(wireframe=False, surface="mesh", background="black")
    mesh = session.picture(view)
    assert (mesh[0, 0] == 0).all()
    inside = mesh[mesh.any(-1)].astype(int)
    assert np.abs(inside - inside.mean(1, keepdims=True)).max() <= 1, "the mesh is grey"
    session.show(surface="confidence")
    colored = session.picture(view)
    assert (colored[..., 0].astype(int) - colored[..., 2]).max() > 20
    assert (colored[..., 2].astype(int) - colored[..., 0]).max() > 20
    without = Session(session.avatar)
    without.show(wireframe=True)
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
    np.testing.assert_array_equal(session.picture(view, timestep=0)[32, 24], 0)
    frame = beside(np.zeros((10, 40, 3), np.uint8), np.full((30, 20, 3), 7, np.uint8), "grey")
    assert frame.shape == (30, 40, 3)
    assert (frame[15, :20] == 0).all()
    assert (frame[2, :20] == 128).all()


def test_words_tell_which_side_was_filmed(session: Session) -> None:
    face, view = session.avatar.face(head_rotation=(0, 0, 0), head_translation=(0, 0, 0)), View(np.eye(4), 0.5, 9, 9)
    limits = np.radians(np.array([[-30, 40], [-10, 10]])).astype(np.float32)
    nothing = np.zeros(1, np.float32)
    filmed = runtime.Filmed(nothing, nothing, nothing[None], nothing, limits)

    def seen_from(yaw: float, pitch: float) -> str:
        yaw, pitch = np.radians(yaw), np.radians(pitch)
        viewmat = np.eye(4)
        viewmat[:3, 3] = -np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
        return words_about_view(filmed, face, replace(view, viewmat=viewmat))

    assert seen_from(35, 5) == "This side was filmed."
    assert seen_from(60, 0).startswith("Beyond what was filmed by 20° sideways:")
    assert seen_from(-60, 30).startswith("Beyond what was filmed by 30° sideways and 20° up or down:")
    assert "not known" in words_about_view(None, face, view)


# Files.


def test_a_screenshot_has_the_pixels_of_the_window(session: Session) -> None:
    view = front_view(session.avatar, 96, 640)
    picture = cv2.imdecode(np.frombuffer(screenshot(session, view), np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    assert picture.shape == (640, 96, 3)


def test_videos_hold_the_motion_or_a_turn(session: Session, tmp_path: Path) -> None:
    session.show(height=32)
    view, center = front_view(session.avatar, 48, 32), center_of(session.avatar)
    (tmp_path / "turn.mp4").write_bytes(video(session, view, center))
    assert count_frames(tmp_path / "turn.mp4") == TURNTABLE_FRAMES
    session.choose("clip")
    (tmp_path / "clip.mp4").write_bytes(video(session, view, center))
    assert count_frames(tmp_path / "clip.mp4") == 4
    assert session.timestep == 0
    with pytest.raises(Stopped):
        video(session, view, center, lambda: False)


def test_a_turntable_keeps_its_distance(session: Session) -> None:
    view, center = front_view(session.avatar), center_of(session.avatar).astype(float)
    half = around(view, center, np.pi)
    for turned in (half, around(view, center, 0.3)):
        before, after = (one.viewmat[:3, :3] @ center + one.viewmat[:3, 3] for one in (view, turned))
        np.testing.assert_allclose(before, after, atol=1e-6)
    np.testing.assert_allclose(half.viewmat[2, :3], -view.viewmat[2, :3], atol=1e-6)
    np.testing.assert_allclose(around(half, center, np.pi).viewmat, view.viewmat, atol=1e-6)


# The door.


@pytest.mark.parametrize(
    ("host", "is_one"),
    [
        ("127.0.0.1", True),
        ("::1", True),
        ("localhost", True),
        ("0.0.0.0", False),
        ("example.org", False),
        ("192.168.1.2", False),
    ],
)
def test_loopback(host: str, is_one: bool) -> None:
    assert is_loopback(host) is is_one
    assert Door.of(host).token is not None
    if is_one:
        assert Door.of(host, with_token=False).token is None
    else:
        with pytest.raises(UserError, match=f"--no-token: other machines can reach --host {host}"):
            Door.of(host, with_token=False)


def test_without_a_token_strange_hosts_and_origins_are_refused() -> None:
    door = Door.of("127.0.0.1", with_token=False)
    assert door.answer("/", {"Host": "127.0.0.1:80"}) is None
    assert door.answer("/", {"Host": "localhost:80", "Origin": "http://localhost:80"}) is None
    for headers in (
        {},
        {"Host": "rebound.example:80"},
        {"Host": "127.0.0.1:80", "Origin": "http://evil.example"},
        {"Host": "127.0.0.1:80", "Origin": "http://127.0.0.1:81"},
        {"Host": "127.0.0.1:80", "Origin": "null"},
        {"Host": "127.0.0.1:80", "Origin": "http://["},
        {"Host": "127.0.0.1:80", "Origin": "http://[v1.\udc80]"},
        {"Host": "[::1"},
    ):
        answer = door.answer("/", headers)
        assert answer is not None, headers
        assert answer.status == 403
        assert answer.body.isascii() or "\udc80" not in answer.body


def test_a_proxy_with_a_path_of_its_own() -> None:
    """The redirect and the cookie stay below that path, and other hosts are fine with the token."""
    door = Door.of("127.0.0.1")
    there = {"Host": "me.example", "Origin": "https://me.example"}
    first = door.answer(f"/?token={door.token}", there)
    assert first is not None
    assert (
        urljoin("https://me.example/mien/?token=x", first.headers["Location"]) == "https://me.example/mien/index.html"
    )
    assert "Path" not in first.headers["Set-Cookie"]
    assert door.answer("/index.html", {**there, "Cookie": door.cookie}) is None
    lost = door.answer("/", {"Host": "127.0.0.1:80", "Origin": "https://me.example", "Cookie": door.cookie})
    assert lost is not None
    assert "page of https://me.example, and its Host is 127.0.0.1:80" in lost.body
    assert "let the proxy pass on the browser's Host header" in lost.body


def test_a_token_becomes_a_cookie() -> None:
    door = Door.of("0.0.0.0")
    assert door.token is not None
    assert len(door.token) >= 20
    assert door.token != Door.of("0.0.0.0").token
    here = {"Host": "me.example:80"}
    first = door.answer(f"/?token={door.token}", here)
    assert first is not None
    assert (first.status, first.headers["Location"]) == (303, "index.html")
    cookie = first.headers["Set-Cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    given = cookie.partition(";")[0]
    assert door.answer("/", {**here, "Cookie": f"a=b; {given}"}) is None
    assert door.answer("/", {**here, "cookie": given, "origin": "http://me.example:80"}) is None
    for path, headers in (
        ("/", {}),
        ("/?token=", {}),
        ("/?token=wrong", {"Cookie": given}),
        ("/", {"Cookie": given[:-1]}),
        ("/", {"Cookie": given, "Origin": "http://evil.example"}),
        ("/", {"Cookie": "é=[,"}),
    ):
        answer = door.answer(path, {**here, **headers})
        assert answer is not None, (path, headers)
        assert answer.status == 403
    assert door.address("::1", 7).startswith("http://[::1]:7/?token=")


# The command.


def complaint(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(["view", *arguments]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    return told


def test_mistakes_are_told_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_toy_workspace(tmp_path / "W")
    workspace, file = str(tmp_path / "W"), tmp_path / "a.mien"
    runtime.write_portable(file, drawn_head(10))
    capsys.readouterr()
    assert "no such file" in complaint(capsys, str(tmp_path / "gone.mien"))
    assert "no such folder" in complaint(capsys, str(tmp_path / "gone"))
    assert "is no .mien file" in complaint(capsys, str(Path(__file__)))
    assert "leave --run out" in complaint(capsys, str(file), "--run", "toy")
    assert "no run 'x'" in complaint(capsys, workspace, "--run", "x")
    assert "from 1 to 65535" in complaint(capsys, workspace, "--port", "65536")
    assert "gone.csv: no such file" in complaint(capsys, workspace, "--play", "gone.csv")
    assert "--no-token: other machines can reach --host 0.0.0.0" in complaint(
        capsys, str(file), "--host", "0.0.0.0", "--no-token"
    )
    assert "--host nowhere.invalid: is no address of this machine" in complaint(
        capsys, workspace, "--host", "nowhere.invalid"
    )
    file.write_bytes(file.read_bytes()[:5000])
    assert "a.mien: is damaged" in complaint(capsys, str(file))
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert "run `pip install 'mien[viewer]'`" in complaint(capsys, workspace)


def test_draw_without_a_mesh_draws_the_avatar(avatar: runtime.Avatar) -> None:
    camera = avatar.camera.resized(32, 32)
    face = avatar.face()
    shown = draw(avatar.pose(), face, None, Look(surface="mesh", wireframe=True), camera)
    np.testing.assert_array_equal(shown, to_rgb(avatar.render(camera=camera)[0]))
