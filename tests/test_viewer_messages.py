"""Messages of browsers to the viewer: they concern one browser, and slow work is bounded."""

import asyncio
import contextlib
import math
import threading
from collections.abc import AsyncIterator, Iterator
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser")

import msgspec
import websockets

from mien import runtime
from mien.viewer import panel
from mien.viewer.server import Serving
from mien.viewer.session import Session
from test_viewer import clip_of
from test_viewer_page import Client, connect, served
from web_case import drawn_head, until

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


def test_a_damaged_message_concerns_its_browser_alone(serving: Serving) -> None:
    session = serving.session
    joint = serving.panel.sliders[f"{session.avatar.joint_names[0]}_x"].label
    messages = [
        *(update(serving, joint, value) for value in (math.nan, math.inf)), update(serving, "Background", "purple"),
        update(serving, "jaw open", 1e300), update(serving, "Background", "grey"), "text",
    ]  # fmt: skip

    async def talk() -> None:
        async with connect(serving) as hostile, connect(serving) as other:
            for each in (hostile, other):
                await Client(each).look(session, 96, 64)
            for message in messages:
                await hostile.send(message)
            with pytest.raises(websockets.ConnectionClosed):
                await Client(hostile).picture(9999)
            async with connect(serving) as fresh:
                for client in (Client(fresh), Client(other)):
                    await client.look(session, 50, 100)
                    picture = await client.picture(100)
                    assert np.abs(picture[0, 0].astype(int) - 128).max() < 5, "what was right counts"

    asyncio.run(talk())
    assert np.isfinite(session.face.joints).all()
    assert serving.loop.error is None


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


def test_a_failure_is_told_and_the_viewer_goes_on(serving: Serving, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    def fail(*arguments: object) -> None:
        raise ArithmeticError("a bug")

    monkeypatch.setattr(serving.session, "set_expression", fail)
    monkeypatch.setattr(panel, "screenshot", fail)
    press(serving, ("jaw open", 0.5), ("Screenshot", True))
    until(lambda: bool(serving.failures))
    assert capsys.readouterr().err.count("failed, and the viewer goes on (ArithmeticError: a bug)") == 1
