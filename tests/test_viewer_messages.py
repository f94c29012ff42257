"""Messages of browsers to the viewer: every value is checked and clamped, and nobody can end the viewer for others."""

import asyncio
import contextlib
import gc
import math
import threading
from collections.abc import AsyncIterator, Iterator
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser")

import msgspec
import websockets
from viser import _messages

from fuzzing.viewer_messages import campaign
from mien import runtime
from mien.viewer import panel
from mien.viewer.messages import MOST_TEXT, Gate
from mien.viewer.server import MOST_BROWSERS, Serving
from mien.viewer.session import Session
from test_viewer import clip_of
from test_viewer_page import Client, connect, served
from web_case import drawn_head, until

CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [0, 0, 0.5], "fov": 0.4, "near": 0.01, "far": 100,
    "image_height": 64, "image_width": 96, "look_at": [0, 0, 1], "up_direction": [0, -1, 0],
}  # fmt: skip


avatar = pytest.fixture(scope="module")(lambda: runtime.Avatar(drawn_head(500)))


@pytest.fixture
def serving(avatar: runtime.Avatar) -> Iterator[Serving]:
    with served(Session(avatar, None, {"clip": lambda: clip_of(avatar)})) as running:
        yield running


def control(serving: Serving, label: str) -> Any:
    handles = serving.server.gui._gui_input_handle_from_uuid.values()
    return next(handle for handle in handles if handle.label == label)  # type: ignore[attr-defined]


def update(serving: Serving, label: str, value: object, name: str = "value") -> bytes:
    message = {"type": "GuiUpdateMessage", "uuid": control(serving, label)._impl.uuid, "updates": {name: value}}
    return msgspec.msgpack.encode(message)


def passed(serving: Serving, label: str, value: object, name: str = "value") -> object:
    gate = Gate()
    gate.open(serving.server.gui)
    message = gate.checked(update(serving, label, value, name))
    return None if message is None else msgspec.msgpack.decode(message)["updates"]["value"]


def test_values_are_checked_and_clamped(serving: Serving) -> None:
    for label, value, expected in (
        ("jaw open", 0.25, 0.25), ("jaw open", 1, 1.0), ("jaw open", 1e300, float(np.float32(1.2))),
        ("jaw open", -5, 0.0), ("jaw open", math.nan, None), ("jaw open", math.inf, None), ("jaw open", "0.5", None),
        ("jaw open", True, None), ("jaw open", [0.5], None), ("Frame", 1e300, 1), ("Frame", 0.7, 0),
        ("Height in pixels", 1e300, 1080), ("Height in pixels", -(2**63), 128),
        ("Height in pixels", 2**64 - 1, 1080), ("Background", "grey", "grey"), ("Background", "purple", None),
        ("Motion", "clip", "clip"), ("Motion", "../clip", None), ("Filmed frame beside it", True, True),
        ("Filmed frame beside it", 1, None), ("Search", "smile left", "smile left"),
        ("Search", "x" * 50_000, "x" * MOST_TEXT), ("Search", 5, None), ("Random face", {"no": "value"}, None),
        ("Random face", "anything", True),
    ):  # fmt: skip
        through = passed(serving, label, value)
        assert (through, type(through)) == (expected, type(expected)), (label, value)


def test_only_values_of_controls_pass(serving: Serving) -> None:
    for name in ("visible", "props", "removed", "update_cb", "__class__", "label"):
        assert passed(serving, "jaw open", 0.5, name) is None
    gate = Gate()
    good = update(serving, "jaw open", 0.5)
    assert gate.checked(good) is None, "it is not open yet"
    gate.open(serving.server.gui)
    assert gate.checked(good) is not None
    strange = {"type": "GuiUpdateMessage", "uuid": "none", "updates": {"value": 0.5}}
    odd = (b"", "text", good[:-1], good + b"\x00", b"\x91" * 60_000, b"\xdd\xff\xff\xff\xff", b"\xa3\xff\xfe\xfd")
    for message in (msgspec.msgpack.encode(strange), b"\x81\xa4type\xa4none", *odd):
        assert gate.checked(message) is None, message[:40]
    for kind in _messages.Message._subclass_from_type_string():
        message = {**strange, **CAMERA, "uuid": control(serving, "Play")._impl.uuid, "type": kind}
        known = kind in ("GuiUpdateMessage", "ViewerCameraMessage")
        assert (gate.checked(msgspec.msgpack.encode(message)) is not None) is known, kind


def test_cameras_are_checked_and_clamped() -> None:
    def camera(**changes: object) -> dict[str, Any] | None:
        message = Gate().checked(msgspec.msgpack.encode({**CAMERA, **changes}))
        return None if message is None else msgspec.msgpack.decode(message)

    plain = camera()
    assert plain == {**CAMERA, "near": pytest.approx(0.01)}
    for name, value in (
        ("wxyz", [0, 0, 0, 0]), ("wxyz", [1, 0, 0]), ("wxyz", [math.nan, 0, 0, 1]), ("wxyz", [1e300, 0, 0, 0]),
        ("position", [1e300, 0, 0]), ("position", [math.inf, 0, 0]), ("look_at", [0, math.nan, 0]),
        *((name, [0, at, 0]) for name in ("position", "look_at", "up_direction") for at in (1.1e5, -1.1e5, math.nan)),
        ("up_direction", "up"), ("fov", math.nan), ("fov", None), ("image_width", math.inf),
    ):  # fmt: skip
        assert camera(**{name: value}) is None, (name, value)
    for name, value, expected in (
        ("image_width", 1e300, 1 << 14), ("image_height", -1, 0), ("image_height", 700.5, 700), ("fov", 1e-300, 0.01),
        ("fov", 9, math.pi - 0.01), ("far", 1e300, 1e5),
    ):  # fmt: skip
        clamped = camera(**{name: value})
        assert clamped is not None
        assert clamped[name] == expected, name


def test_one_browser_cannot_end_the_viewer_for_others(serving: Serving) -> None:
    session = serving.session
    joint = serving.panel.sliders[f"{session.avatar.joint_names[0]}_x"].label
    upload = {"source_component_uuid": control(serving, "Search")._impl.uuid, "transfer_uuid": "t"}
    start = {"type": "FileTransferStartUpload", "filename": "x", "mime_type": "x", "part_count": 9, "size_bytes": 9}
    part = {"type": "FileTransferPart", "part_index": 0, "content": b"x" * 1000}
    messages = [
        *(update(serving, joint, value) for value in (math.nan, math.inf, -math.inf)),
        update(serving, "Background", "purple"), update(serving, "Search", "x" * 60_000),
        *(update(serving, label, 1e300) for label in ("Height in pixels", "Frame", "jaw open")),
        *(msgspec.msgpack.encode(upload | message) for message in (start, part)),
        update(serving, "Background", "grey"), "text", update(serving, "Search", "x" * 100_000),
    ]  # fmt: skip

    async def talk() -> None:
        async with connect(serving) as hostile, connect(serving) as other:
            for each in (hostile, other):
                await Client(each).look(session, 96, 64)
            for message in messages:
                await hostile.send(message)
            with pytest.raises(websockets.ConnectionClosed, match="1009"):
                await Client(hostile).picture(9999)
            async with connect(serving) as fresh:
                for client in (Client(fresh), Client(other)):
                    await client.look(session, 50, 100)
                    picture = await client.picture(100)
                    assert np.abs(picture[0, 0].astype(int) - 128).max() < 5, "what was right counts"

    asyncio.run(talk())
    assert np.isfinite(session.face.joints).all()
    assert (session.height, control(serving, "Search").value) == (1080, "x" * MOST_TEXT)
    assert serving.server.gui._current_file_upload_states == {}
    assert (serving.loop.error, serving.failures) == (None, [])


@contextlib.asynccontextmanager
async def watching(serving: Serving) -> AsyncIterator[Client]:
    async with connect(serving) as connection:
        client = Client(connection)
        await client.look(serving.session, 96, 64)
        await client.picture(64)
        yield client


def press(serving: Serving, *pressed: tuple[str, object]) -> None:
    async def talk() -> None:
        async with watching(serving) as client:
            for label, value in pressed:
                await client.connection.send(update(serving, label, value))
            await client.look(serving.session, 48, 32)
            await client.picture(32)

    asyncio.run(talk())


def test_queued_screenshots_are_dropped(serving: Serving, monkeypatch: pytest.MonkeyPatch) -> None:
    taken, go_on = [], threading.Event()

    def slow(*arguments: object) -> bytes:
        taken.append(arguments)
        go_on.wait(10)
        return b"x" * 100

    monkeypatch.setattr(panel, "screenshot", slow)
    press(serving, *[("Screenshot", True)] * 300)
    until(lambda: len(taken) == 1)
    threading.Timer(0.2, go_on.set).start()
    serving.stop()
    assert len(taken) == 1


def test_files_wait_until_a_browser_takes_them(serving: Serving, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a browser does not take stays in memory, so no more is made for it."""
    monkeypatch.setattr(panel, "MOST_PARTS", -1)
    monkeypatch.setattr(panel, "screenshot", lambda *_: pytest.fail("a picture was drawn"))

    async def talk() -> None:
        async with watching(serving) as client:
            await client.connection.send(update(serving, "Screenshot", True))
            while "still on its way" not in str(await client.told()):
                pass

    asyncio.run(talk())
    assert serving.failures == []


def test_a_failure_is_told_and_the_viewer_goes_on(serving: Serving, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    def fail(*arguments: object) -> None:
        raise ArithmeticError("a bug")

    monkeypatch.setattr(serving.session, "set_expression", fail)
    monkeypatch.setattr(panel, "screenshot", fail)
    press(serving, ("jaw open", 0.5), ("Screenshot", True))
    until(lambda: len(serving.failures) == 2)
    assert capsys.readouterr().err.count("which is a bug in mien, and the viewer goes on (ArithmeticError: a bug)") == 2


def test_there_are_only_so_many_browsers(serving: Serving) -> None:
    async def talk() -> None:
        async with contextlib.AsyncExitStack() as stack:
            there = [await stack.enter_async_context(connect(serving)) for _ in range(MOST_BROWSERS)]
            async with connect(serving) as one_more:
                with pytest.raises(websockets.ConnectionClosed, match="too many browsers"):
                    await one_more.recv()
            await there[0].close()
            for _ in range(1000):
                with contextlib.suppress(websockets.ConnectionClosed):
                    async with watching(serving):
                        return
                await asyncio.sleep(0.05)
            pytest.fail("nobody else gets in")

    asyncio.run(talk())


@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_hostile_messages_do_no_harm() -> None:
    """A real viewer and a real WebSocket client; `make fuzz` does the same at length."""
    figures = campaign(30, 1)
    gc.collect()  # connections that the campaign has cut, which warn in whatever test comes next otherwise
    assert (figures.findings, figures.messages) == ([], 30)
