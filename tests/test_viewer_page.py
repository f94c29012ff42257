"""The viewer's server: real connections, two clients, clients that vanish, the door, and a real browser."""

import asyncio
import contextlib
import gzip
import http.client
import signal
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

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
from mien.viewer.access import Door
from mien.viewer.files import SCREENSHOT_HEIGHT
from mien.viewer.panel import filmed_from
from mien.viewer.server import Serving
from mien.viewer.session import Session
from test_viewer import clip_of
from web_case import browse, drawn_head, until

PROTOCOL = f"viser-v{viser.__version__}"
PATIENCE_SECONDS = 60.0


@pytest.fixture(scope="module")
def avatar() -> runtime.Avatar:
    return runtime.Avatar(drawn_head(1000))


@pytest.fixture
def session(avatar: runtime.Avatar) -> Session:
    return Session(avatar, None, {"clip": lambda: clip_of(avatar)})


@pytest.fixture
def serving(session: Session) -> Iterator[Serving]:
    running = Serving(session, Door.of("127.0.0.1"), 0, "drawn")
    yield running
    running.stop()


class Client:
    """A browser that only sends its camera and takes pictures."""

    def __init__(self, connection: Any) -> None:
        self.connection = connection
        self.pictures: list[np.ndarray] = []

    async def look(self, session: Session, width: int, height: int, aside: float = 0.0) -> None:
        position, target, up = filmed_from(session)
        viewmat = session.avatar.camera.viewmat
        message = ViewerCameraMessage(
            tuple(SO3.from_matrix(viewmat[:3, :3].T.astype(float)).wxyz), tuple(position + aside), 0.4, 0.01, 100.0,
            height, width, tuple(target), tuple(up),
        )  # fmt: skip
        await self.connection.send(msgspec.msgpack.encode(message.as_serializable_dict()))

    async def picture(self, height: int) -> np.ndarray:
        """Return the first picture of that height from now on."""
        while True:
            content = await asyncio.wait_for(self.connection.recv(), PATIENCE_SECONDS)
            packed = content[16 : 16 + int.from_bytes(content[8:16], "little")]
            for message in msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(packed))["messages"]:
                if message["type"] == "BackgroundImageMessage" and message["rgb_data"] is not None:
                    picture = cv2.imdecode(np.frombuffer(message["rgb_data"], np.uint8), cv2.IMREAD_COLOR)
                    assert picture is not None
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
        status, headers, body = request(
            serving.port, "/index.html", Cookie=serving.door.cookie, **{"Accept-Encoding": encoding}
        )
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
            again = await near.picture(64)
            assert np.abs(again.astype(int) - shown).mean() < 2
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


def test_moving_pictures_are_smaller_and_still_ones_full(session: Session) -> None:
    sizes: list[tuple[int, bool]] = []
    original = session.picture

    def slow(view: Any, full: bool) -> np.ndarray:
        time.sleep(0.05)
        picture = original(view, full)
        sizes.append((len(picture), full))
        return picture

    session.picture = slow  # type: ignore[method-assign]
    running = Serving(session, Door.of("127.0.0.1"), 0, "drawn")
    try:

        async def talk() -> None:
            async with connect(running) as connection:
                client = Client(connection)
                await client.look(session, 96, 64)
                await client.picture(32)
                await client.picture(64)

        asyncio.run(talk())
    finally:
        running.stop()
    assert sizes[0] == (32, False)
    assert sizes[-1] == (64, True)


def test_strangers_get_nothing(serving: Serving) -> None:
    cookie = serving.door.cookie
    status, headers, _ = request(serving.port, Cookie=cookie)
    assert status == 200
    for origin in ("http://evil.example", "null", "http://[", "http://[::1", "//", "http://\u2100.example"):
        status, refused, content = request(serving.port, Cookie=cookie, Origin=origin.encode().decode("latin-1"))
        assert (status, b"its Host is 127.0.0.1" in content) == (403, True), origin
        with pytest.raises(websockets.InvalidStatus, match="403"):
            asyncio.run(open_and_close(serving, Origin=origin.encode().decode("latin-1")))
        for given in (headers, refused):
            assert given["X-Frame-Options"] == "DENY"
            assert given["Content-Security-Policy"] == "frame-ancestors 'none'"
    asyncio.run(open_and_close(serving, Origin=f"http://127.0.0.1:{serving.port}"))


async def open_and_close(serving: Serving, **headers: str) -> None:
    async with connect(serving, **headers):
        pass


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_nothing_goes_without_the_token(session: Session, host: str) -> None:
    """Other users of this machine can reach loopback, too."""
    door = Door.of(host)
    running = Serving(session, door, 0, "drawn")
    try:
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
    finally:
        running.stop()


def test_without_a_token_only_loopback_is_answered(session: Session) -> None:
    running = Serving(session, Door.of("127.0.0.1", with_token=False), 0, "drawn")
    try:
        assert "token" not in running.address
        assert request(running.port)[0] == 200
        status, _, content = request(running.port, Host="rebound.example")
        assert (status, b"Host is rebound.example" in content, b"--no-token" in content) == (403, True, True)
    finally:
        running.stop()


def test_the_viewer_is_never_passed_on(serving: Serving) -> None:
    """viser has a button and a message that make a server public through a machine of its makers."""
    assert serving.server.request_share_url() is None
    assert serving.server._share_tunnel is None


def test_a_port_that_is_taken_is_told(session: Session) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(UserError, match=f"--port {port}: another program uses it"):
            Serving(session, Door.of("127.0.0.1"), port, "drawn")
    running = Serving(session, Door.of("127.0.0.1"), port, "drawn")
    assert running.port == port
    running.stop()


def test_nothing_is_left_after_the_end(session: Session, capfd: pytest.CaptureFixture[str]) -> None:
    before = {thread for thread in threading.enumerate() if not thread.name.startswith("ThreadPool")}
    running = Serving(session, Door.of("127.0.0.1"), 0, "drawn")
    asyncio.run(open_and_close(running))
    running.stop()
    after = {thread for thread in threading.enumerate() if not thread.name.startswith("ThreadPool")}
    assert after <= before
    with pytest.raises(OSError):  # noqa: PT011
        request(running.port)
    assert running.failures == []
    assert capfd.readouterr().out == ""


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
    """Do steps of web/tests/browser.mjs at an address. Nothing may fail, or be asked for from elsewhere."""
    told = browse(address, size=size, device=["mobile"] if size[0] < 600 else [], steps=steps)
    here = "/".join(address.split("/")[:3])
    assert told["messages"] == []
    assert [one for one in told["requests"] if not one.startswith((here, f"blob:{here}", "data:"))] == []
    return told


def test_a_browser_shows_the_avatar(serving: Serving, session: Session, tmp_path: Path) -> None:
    shots = [tmp_path / f"{index}.png" for index in range(4)]
    steps: list[dict[str, Any]] = [
        {"see": "Expressions"}, {"settled": shots[0]}, {"click": "Random face"}, {"settled": shots[1]},
        {"drag": [120, 0]}, {"settled": shots[2]}, {"click": "Save"}, {"save": ["Screenshot", tmp_path / "saved.png"]},
        {"fill": ["Search", "smile left"]}, {"reload": True}, {"see": "Expressions"}, {"settled": shots[3]},
    ]  # fmt: skip
    told = seen_by_browser(serving.address, steps)
    rest, random, turned, again = (read(path)[:, :700] for path in shots)
    view = (rest[350:] < 250).any(-1)
    assert 0.1 < view.mean() < 0.9, "a head over white"
    assert np.abs(random.astype(int) - rest).max() > 30
    assert np.abs(turned.astype(int) - random).mean() > 3
    assert np.abs(session.face.expression - session.avatar.portable.neutral.expression).max() > 0
    assert np.abs(again.astype(int) - random).mean() < 3, "a new page has the same face, seen from the front"
    saved = read(tmp_path / "saved.png")
    assert len(saved) == SCREENSHOT_HEIGHT
    assert [saved.shape[1] / len(saved)] == pytest.approx(told["shapes"], rel=0.01)
    visible = {name for name, slider in serving.panel.sliders.items() if slider.visible}
    assert visible & set(session.avatar.expression_names) == {"mouthSmileLeft"}
    assert (serving.loop.error, serving.failures) == (None, [])


def test_a_phone_shows_the_whole_head(serving: Serving, tmp_path: Path) -> None:
    """The head fits the narrow window, and the panel, which would cover half of it, is folded."""
    shot = tmp_path / "phone.png"
    seen_by_browser(serving.address, [{"see": "mien"}, {"settled": shot}], (390, 844))
    drawn = np.any(read(shot)[:700] < 250, axis=-1)
    columns = np.nonzero(drawn.any(0))[0]
    assert 10 < columns[0] < columns[-1] < 380
    left, right = drawn[:, :195].mean(), drawn[:, 195:].mean()
    assert left == pytest.approx(right, rel=0.3), "nothing lies over a half"


@contextlib.contextmanager
def proxied(port: int, folder: str) -> Iterator[int]:
    """Pass requests below a folder on to a port, without the folder's name, as nginx does. Yield the proxy's port."""

    async def pipe(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(ConnectionError):
            while data := await reader.read(1 << 16):
                writer.write(data)
                await writer.drain()
        writer.close()

    writers: list[asyncio.StreamWriter] = []

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writers.append(writer)
        with contextlib.suppress(asyncio.IncompleteReadError):
            head = await reader.readuntil(b"\r\n\r\n")
            if not head.startswith(b"GET /%s/" % folder.encode()):
                writer.write(b"HTTP/1.1 301 Moved\r\nLocation: /%s/\r\nContent-Length: 0\r\n\r\n" % folder.encode())
                writer.close()
                return
            inner, onward = await asyncio.open_connection("127.0.0.1", port)
            writers.append(onward)
            onward.write(head.replace(b"/%s/" % folder.encode(), b"/", 1))
            await asyncio.gather(pipe(inner, writer), pipe(reader, onward))

    async def end() -> None:
        server.close()
        for task in asyncio.all_tasks() - {asyncio.current_task()}:
            task.cancel()
        for writer in writers:
            writer.close()
        await asyncio.gather(*(writer.wait_closed() for writer in writers), return_exceptions=True)

    loop = asyncio.new_event_loop()
    server = loop.run_until_complete(asyncio.start_server(answer, "127.0.0.1", 0))
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    try:
        yield server.sockets[0].getsockname()[1]
    finally:
        asyncio.run_coroutine_threadsafe(end(), loop).result(60)
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


def test_a_browser_behind_a_proxy_with_a_path_of_its_own(serving: Serving, tmp_path: Path) -> None:
    shot = tmp_path / "shot.png"
    with proxied(serving.port, "deep/mien") as port:
        address = f"http://127.0.0.1:{port}/deep/mien/?token={serving.door.token}"
        seen_by_browser(address, [{"see": "Expressions"}, {"settled": shot}])
    assert 0.1 < (read(shot)[350:, :700] < 250).any(-1).mean() < 0.9, "a head over white"


def read(path: Path) -> np.ndarray:
    picture = cv2.imread(str(path))
    assert picture is not None
    return picture
