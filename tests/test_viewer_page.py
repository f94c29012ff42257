"""The viewer's server: real connections, two clients, clients that vanish, the door, and a real browser."""

import asyncio
import contextlib
import gzip
import http.client
import signal
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from known import known

pytest.importorskip("viser")

import msgspec
import viser
import websockets
import zstandard
from viser._messages import ViewerCameraMessage
from viser.transforms import SO3

from forked import ForkServer
from mien import runtime
from mien.errors import UserError
from mien.viewer.access import Door, listen
from mien.viewer.files import SCREENSHOT_HEIGHT
from mien.viewer.panel import filmed_from
from mien.viewer.server import Serving
from mien.viewer.session import Session
from test_viewer import clip_of
from web_case import browse, drawn_head, until

PROTOCOL = f"viser-v{viser.__version__}"
PATIENCE_SECONDS = 60.0


avatar = pytest.fixture(scope="module")(lambda: runtime.Avatar(drawn_head(1000)))
session = pytest.fixture(lambda avatar: Session(avatar, None, {"clip": lambda: clip_of(avatar)}))


@contextlib.contextmanager
def served(session: Session, door: Door | None = None, port: int = 0) -> Iterator[Serving]:
    door = door or Door.of("127.0.0.1")
    running = Serving(session, door, listen(door.host, port), "drawn")
    try:
        yield running
    finally:
        running.stop()


@pytest.fixture
def serving(session: Session) -> Iterator[Serving]:
    with served(session) as running:
        yield running


class Client:
    """A browser that only sends its camera and takes pictures."""

    def __init__(self, connection: Any) -> None:
        self.connection = connection

    async def look(self, session: Session, width: int, height: int, aside: float = 0.0) -> None:
        position, target, up = filmed_from(session)
        turned = SO3.from_matrix(session.avatar.camera.viewmat[:3, :3].T.astype(float)).wxyz
        where = (tuple(turned), tuple(position + aside), 0.4, 0.01, 100.0)
        message = ViewerCameraMessage(*where, height, width, tuple(target), tuple(up))
        await self.connection.send(msgspec.msgpack.encode(message.as_serializable_dict()))

    async def told(self) -> list[dict[str, Any]]:
        content = await asyncio.wait_for(self.connection.recv(), PATIENCE_SECONDS)
        packed = content[16 : 16 + int.from_bytes(content[8:16], "little")]
        return msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(packed))["messages"]

    async def picture(self, height: int) -> np.ndarray:
        while True:
            for message in await self.told():
                if message["type"] == "BackgroundImageMessage" and message["rgb_data"] is not None:
                    picture = known(cv2.imdecode(np.frombuffer(message["rgb_data"], np.uint8), cv2.IMREAD_COLOR))
                    if len(picture) == height:
                        return picture


def connect(serving: Serving, **headers: str) -> Any:
    return websockets.connect(
        f"ws://127.0.0.1:{serving.port}", subprotocols=[websockets.Subprotocol(PROTOCOL)], max_size=None,
        additional_headers={"Cookie": serving.door.cookie, **headers},
    )  # fmt: skip


def request(port: int, path: str = "/", **headers: str) -> tuple[int, dict[str, str], bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    content = answer.read()
    connection.close()
    return answer.status, dict(answer.getheaders()), content


def test_the_page_does_not_look_for_a_gpu_and_folds_its_panel_on_phones(serving: Serving) -> None:
    for encoding in ("identity", "gzip"):
        asked = {"Cookie": serving.door.cookie, "Accept-Encoding": encoding}
        status, headers, body = request(serving.port, "/index.html", **asked)
        page = gzip.decompress(body) if headers["Content-Encoding"] == "gzip" else body
        assert (status, headers["Content-Length"]) == (200, str(len(body)))
        assert page.index(b"<script>\n// mien draws the pictures") == page.index(b"<script"), "it runs before viser's"
        assert b"WEBGL_debug_renderer_info" in page
        assert b"max-width: 36em" in page


def test_two_clients_see_their_own_views_and_one_may_vanish(serving: Serving, session: Session) -> None:
    async def talk() -> None:
        async with connect(serving) as first:
            near = Client(first)
            await near.look(session, 96, 64)
            shown = await near.picture(64)
            assert shown.shape == (64, 96, 3)
            assert shown.std() > 10, "there is a head"
            async with connect(serving) as second:
                far = Client(second)
                await far.look(session, 50, 100)
                assert (await far.picture(100)).shape == (100, 50, 3)
                session.set_expression("jawOpen", 0.8)
                opened = [await near.picture(64), await far.picture(100)]
                assert np.abs(opened[0].astype(int) - shown).max() > 30
                second.transport.abort()  # the cable is pulled
            session.rest()
            await near.look(session, 96, 64)
            assert np.abs((await near.picture(64)).astype(int) - shown).mean() < 2
            await near.look(session, 0, 0)  # a window that is hidden
            await near.look(session, 96, 64, float("nan"))
            await near.look(session, 48, 32)
            await near.picture(32)
        async with connect(serving) as third:  # the page is loaded again
            await Client(third).look(session, 96, 64)
            await Client(third).picture(64)

    asyncio.run(talk())
    assert (serving.loop.error, serving.failures) == (None, [])
    until(lambda: not serving.server.get_clients())


def test_the_first_picture_is_that_of_the_filmed_camera(serving: Serving, session: Session) -> None:
    """The page tells first where viser would stand, far beside the head, and then where it was told to begin."""

    async def talk() -> None:
        async with connect(serving) as connection:
            client = Client(connection)
            await client.look(session, 96, 64, aside=3.0)
            first = await client.picture(64)
            await client.look(session, 96, 64)
            assert np.abs((await client.picture(64)).astype(int) - first).mean() < 2
            await client.look(session, 96, 64, aside=3.0)
            assert np.abs((await client.picture(64)).astype(int) - first).mean() > 2

    asyncio.run(talk())


def test_a_missing_package_is_named_and_no_bug(session: Session, capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    def draw(*_: object) -> None:
        raise ModuleNotFoundError("No module named 'torch'", name="torch")

    async def talk(serving: Serving) -> None:
        async with connect(serving) as connection:
            await Client(connection).look(session, 96, 64)
            while not any(one["type"] == "NotificationShowMessage" for one in await Client(connection).told()):
                pass

    monkeypatch.setattr(session, "picture", draw)
    with served(session) as serving:
        asyncio.run(talk(serving))
        assert len(serving.failures) == 1
    told = capsys.readouterr().err
    assert told.count("mien: this needs the package torch, which is not installed; run `pip install") == 1
    assert "bug" not in told


def test_the_panel_says_what_is_shown_and_that_it_waits(avatar: runtime.Avatar) -> None:
    """Play waits for a motion that loads, and keeps the preset, which any other change takes away."""
    loads = threading.Event()
    slow = Session(avatar, None, {"clip": lambda: (loads.wait(PATIENCE_SECONDS), clip_of(avatar))[1]})
    with served(slow) as running:
        preset, button = running.panel.preset, running.panel.play_button
        assert preset is not None
        assert button is not None

        async def press() -> None:
            async with connect(running) as connection:
                update = {"type": "GuiUpdateMessage", "uuid": button._impl.uuid, "updates": {"value": True}}
                await Client(connection).look(slow, 96, 64)
                await connection.send(msgspec.msgpack.encode(update))
                await Client(connection).picture(64)

        slow.take_preset("smile")
        running.panel.move_sliders()
        asyncio.run(press())
        until(lambda: (button.label, button.disabled) == ("Loading ...", True))
        loads.set()
        until(lambda: slow.playing)
        until(lambda: (button.label, button.disabled) == ("Pause", False))
        assert (slow.preset, preset.value) == ("smile", "smile")
        slow.rest()
        running.panel.move_sliders()
        assert preset.value == "none"


def test_strangers_get_nothing(serving: Serving) -> None:
    cookie = serving.door.cookie
    status, headers, _ = request(serving.port, Cookie=cookie)
    assert status == 200
    for origin in ("http://evil.example", "null", "http://[", "//", "http://\u2100.example"):
        given = {"Origin": origin.encode().decode("latin-1")}
        status, refused, content = request(serving.port, Cookie=cookie, **given)
        assert (status, b"its Host is 127.0.0.1" in content) == (403, True), origin
        with pytest.raises(websockets.InvalidStatus, match="403"):
            asyncio.run(open_and_close(serving, **given))
        for sent in (headers, refused):
            assert (sent["X-Frame-Options"], sent["Content-Security-Policy"]) == ("DENY", "frame-ancestors 'none'")
    asyncio.run(open_and_close(serving, Origin=f"http://127.0.0.1:{serving.port}"))


async def open_and_close(serving: Serving, **headers: str) -> None:
    async with connect(serving, **headers):
        pass


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_nothing_goes_without_the_token(session: Session, host: str) -> None:
    """Other users of this machine can reach loopback, too."""
    door = Door.of(host)
    with served(session, door) as running:
        assert f"?token={door.token}" in running.address
        status, _, content = request(running.port)
        assert (status, b"the whole address that mien printed" in content) == (403, True)
        assert request(running.port, "/index.html?token=guess")[0] == 403
        with pytest.raises(websockets.InvalidStatus, match="403"):
            asyncio.run(open_and_close(running, Cookie="none=1"))
        status, headers, _ = request(running.port, f"/?token={door.token}")
        assert (status, headers["Location"]) == (303, "index.html")
        cookie = headers["Set-Cookie"].partition(";")[0]
        assert request(running.port, Cookie=cookie)[0] == 200
        asyncio.run(open_and_close(running, Cookie=cookie))


def test_without_a_token_only_loopback_is_answered_and_nothing_is_passed_on(session: Session) -> None:
    """viser has a button and a message that make a server public through a machine of its makers."""
    with served(session, Door.of("127.0.0.1", with_token=False)) as running:
        assert "token" not in running.address
        assert request(running.port)[0] == 200
        status, _, content = request(running.port, Host="rebound.example")
        assert (status, b"Host is rebound.example" in content, b"--no-token" in content) == (403, True, True)
        assert running.server.request_share_url() is None
        assert running.server._share_tunnel is None


def test_a_port_that_is_taken_is_told_and_nothing_is_left_after_the_end(session: Session, capfd) -> None:
    def threads() -> set[threading.Thread]:
        return {thread for thread in threading.enumerate() if not thread.name.startswith("ThreadPool")}

    before = threads()
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(UserError, match=f"--port {port}: another program uses it"), served(session, None, port):
            pass
    with served(session, None, port) as running:
        assert running.port == port
        asyncio.run(open_and_close(running))
    assert threads() <= before
    with pytest.raises(OSError):  # noqa: PT011
        request(port)
    assert (running.failures, capfd.readouterr().out) == ([], "")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 0), (signal.SIGTERM, 143)])
def test_signals_end_the_command(number: signal.Signals, code: int, tmp_path: Path, fork_server: ForkServer) -> None:
    """Also while a browser has sent half of a request."""
    runtime.write_portable(tmp_path / "a.mien", drawn_head(100))
    process = fork_server.mien("view", tmp_path / "a.mien")
    try:
        until(lambda: "\n" in process.stderr)
        assert process.stderr.startswith("Open http://127.0.0.1:")
        address = process.stderr.split()[1]
        port = int(address.split(":")[2].partition("/")[0])
        with socket.create_connection(("127.0.0.1", port)) as vanished:
            vanished.sendall(b"GET / HT")
            assert request(port, address.partition(str(port))[2])[0] == 303
        process.send_signal(number)
        assert process.wait() == code
    finally:
        process.kill()
    assert process.stderr.partition("\n")[2] == ("The viewer is closed\n" if code == 0 else "")
    assert process.stdout == ""


def seen_by_browser(address: str, steps: list[dict[str, Any]], size: tuple[int, int] = (1100, 700)) -> dict[str, Any]:
    told = browse(address, size=size, device=["mobile"] if size[0] < 600 else [], steps=steps)
    here = "/".join(address.split("/")[:3])
    assert told["messages"] == []
    assert [one for one in told["requests"] if not one.startswith((here, f"blob:{here}", "data:"))] == []
    return told


def test_a_browser_shows_the_avatar_and_a_phone_the_whole_head(serving: Serving, session: Session, tmp_path) -> None:
    shots = [tmp_path / f"{index}.png" for index in range(4)]
    steps: list[dict[str, Any]] = [
        {"see": "Expressions"}, {"settled": shots[0]}, {"click": "Random face"}, {"settled": shots[1]},
        {"drag": [120, 0]}, {"settled": shots[2]}, {"click": "Save"}, {"save": ["Screenshot", tmp_path / "saved.png"]},
        {"fill": ["Search", "smile left"]}, {"reload": True}, {"see": "Expressions"}, {"settled": shots[3]},
    ]  # fmt: skip
    told = seen_by_browser(serving.address, steps)
    rest, random, turned, again = (read(path)[:, :700].astype(int) for path in shots)
    assert 0.1 < (rest[350:] < 250).any(-1).mean() < 0.9, "a head over white"
    assert np.abs(random - rest).max() > 30
    assert np.abs(turned - random).mean() > 3 > np.abs(again - random).mean(), "a new page has the same face"
    assert np.abs(session.face.expression - session.avatar.portable.neutral.expression).max() > 0
    saved = read(tmp_path / "saved.png")
    assert len(saved) == SCREENSHOT_HEIGHT
    assert [saved.shape[1] / len(saved)] == pytest.approx(told["shapes"], rel=0.01)
    visible = {name for name, slider in serving.panel.sliders.items() if slider.visible}
    assert visible & set(session.avatar.expression_names) == {"mouthSmileLeft"}
    assert (serving.loop.error, serving.failures) == (None, [])
    # The head fits the narrow window, and the panel, which would cover half of it, is folded.
    seen_by_browser(serving.address, [{"see": "mien"}, {"settled": tmp_path / "a.png"}], (390, 844))
    drawn = np.any(read(tmp_path / "a.png")[:700] < 250, axis=-1)
    columns = np.flatnonzero(drawn.any(0))
    assert 10 < columns[0] < columns[-1] < 380
    assert drawn[:, :195].mean() == pytest.approx(drawn[:, 195:].mean(), rel=0.3), "nothing lies over a half"


def read(path: Path) -> np.ndarray:
    return known(cv2.imread(str(path)))
