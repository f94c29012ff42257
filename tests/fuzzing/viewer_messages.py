"""Send hostile messages to a running viewer: `PYTHONPATH=tests python -m fuzzing.viewer_messages --count 200 --seed 1`.

The messages come from WebSocket clients with the viewer's token, as a browser that somebody has taken over. Afterwards,
a fresh browser must get a picture, the memory must be bounded, and SIGTERM must end the process soon.
"""

import argparse
import asyncio
import dataclasses
import http.client
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any, get_origin, get_type_hints

import msgspec
import numpy as np
import viser
import websockets
import zstandard
from viser import _messages

from fuzzing.edges import DEEP, edge_value
from mien import runtime
from web_case import drawn_head

MOST_MEMORY = 2 << 30
"""Most memory that the viewer may take, in bytes."""
MOST_SECONDS = 90.0
"""Longest time from SIGTERM to the end of the process, in seconds."""
_PATIENCE_SECONDS = 60.0
_EXPECTED = r"Open http|.*take\.json: its face at rest is "
"""Lines that the viewer prints without any message."""
_HUGE = 20_000_000
"""Number of characters of the longest texts."""
_UPLOAD_PART = 4 << 20
_TIMES = (1, 1, 1, 1, 3, 300)
"""How often a message is sent, by chance."""
_PROTOCOL = f"viser-v{viser.__version__}"
_CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.0, 0.0, 0.0), "fov": 0.4, "near": 0.01,
    "far": 100.0, "image_height": 64, "image_width": 96, "look_at": (0.0, 0.0, 1.0), "up_direction": (0.0, -1.0, 0.0),
}  # fmt: skip
_TYPES = _messages.Message._subclass_from_type_string()
"""All messages that viser knows, by name."""


@dataclass
class Control:
    """A control of the page."""

    uuid: str
    kind: str
    label: str
    options: tuple[str, ...] = ()


@dataclass
class Figures:
    """What a campaign gave."""

    messages: int = 0
    sent: int = 0
    connections: int = 0
    refused_requests: int = 0
    memory_mib: float = 0.0
    end_seconds: float = 0.0
    findings: list[str] = field(default_factory=list)


class Viewer:
    """A process of `mien view`."""

    def __init__(self, folder: Path) -> None:
        """Start it, and wait until it can be opened."""
        file = folder / "head.mien"
        runtime.write_portable(file, drawn_head(1000))
        (folder / "take.json").write_text(json.dumps(_take()), encoding="utf-8")
        command = [sys.executable, "-m", "mien.cli", "view", str(file), "--play", str(folder / "take.json")]
        self._told = (folder / "told").open("w+", encoding="utf-8")
        environment = {**os.environ, "MIEN_THREADS": "1"}
        self.process = subprocess.Popen(command, stdout=self._told, stderr=self._told, env=environment)
        ends = time.monotonic() + _PATIENCE_SECONDS
        while not (line := self.told()).startswith("Open http") or "\n" not in line:
            assert self.process.poll() is None, line
            assert time.monotonic() < ends, line
            time.sleep(0.1)
        address = line.split()[1]
        self.port = int(address.split(":")[2].partition("/")[0])
        answer = self.request("/" + address.partition(str(self.port) + "/")[2], {})
        self.cookie = (answer.getheader("Set-Cookie") or "").partition(";")[0]

    def told(self) -> str:
        """What it has printed."""
        self._told.seek(0)
        return self._told.read()

    def forget(self) -> None:
        """Close the file of what it has printed."""
        self._told.close()

    def request(self, path: str, headers: dict[str, str]) -> http.client.HTTPResponse:
        """Send a request, and return the answer without its content."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)
        try:
            connection.putrequest("GET", path, skip_host="Host" in headers)
            for name, value in headers.items():
                connection.putheader(name, value.encode("utf-8", "replace"))
            connection.endheaders()
            answer = connection.getresponse()
            answer.read()
            return answer
        finally:
            connection.close()

    def connect(self) -> Any:
        """A WebSocket of a browser that has the token."""
        return websockets.connect(
            f"ws://127.0.0.1:{self.port}", subprotocols=[websockets.Subprotocol(_PROTOCOL)], max_size=None,
            additional_headers={"Cookie": self.cookie} if self.cookie else {}, open_timeout=_PATIENCE_SECONDS,
        )  # fmt: skip

    @property
    def memory(self) -> int:
        """Most memory that it has had, in bytes."""
        lines = Path(f"/proc/{self.process.pid}/status").read_text(encoding="utf-8").splitlines()
        return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))

    def end(self) -> float:
        """Send SIGTERM. Return the time until the process has ended, in seconds."""
        began = time.monotonic()
        self.process.send_signal(signal.SIGTERM)
        try:
            self.process.wait(2 * MOST_SECONDS)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        return time.monotonic() - began


def _take() -> list[dict[str, Any]]:
    """A motion in which the jaw opens."""
    return [{"timestamp_ms": 100 * step, "blendshapes": {"jawOpen": step / 10}} for step in range(10)]


async def look(connection: Any) -> tuple[list[Control], bool]:
    """Look at the viewer as a browser does. Return its controls, and whether a picture came."""
    await connection.send(_packed(_CAMERA))
    controls: list[Control] = []
    seen = False
    try:
        async with asyncio.timeout(_PATIENCE_SECONDS):
            while not (seen and controls):
                content = await connection.recv()
                packed = content[16 : 16 + int.from_bytes(content[8:16], "little")]
                for message in msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(packed))["messages"]:
                    seen |= message["type"] == "BackgroundImageMessage" and message["rgb_data"] is not None
                    if message["type"].startswith("Gui") and "label" in message.get("props", ()):
                        properties = message["props"]
                        options = tuple(properties.get("options", ()))
                        controls.append(Control(message["uuid"], message["type"], properties["label"], options))
    except (TimeoutError, websockets.ConnectionClosed):
        pass
    return controls, seen


def hostile(dice: Random, controls: list[Control]) -> tuple[str, list[bytes | str]]:
    """One hostile message with its kind, or a few that belong together."""
    kind = dice.choice(("control", "control", "control", "camera", "other", "upload", "bytes", "huge", "clicks"))
    control = dice.choice(controls)
    if kind == "control":
        name = dice.choice(("value",) * 9 + ("visible", "props", "uuid", "removed", "update_cb", "__class__", "x"))
        value = dice.choice((_odd(dice), *control.options[:1], "purple"))
        update = {"type": "GuiUpdateMessage", "uuid": control.uuid, "updates": {name: value}}
        return kind, [_packed(update)] * dice.choice(_TIMES)
    if kind == "camera":
        camera = dict(_CAMERA)
        for name in dice.sample(sorted(set(camera) - {"type"}), dice.randint(1, 3)):
            one = camera[name]
            camera[name] = [_odd(dice) for _ in one] if isinstance(one, tuple) and dice.random() < 0.8 else _odd(dice)
        return kind, [_packed(camera)] * dice.choice(_TIMES)
    if kind == "other":
        return kind, [_packed(_any_message(dice, control))] * dice.choice(_TIMES)
    if kind == "upload":
        return kind, _upload(dice, control)
    if kind == "huge":
        text = "x" * dice.choice((1000, 60_000, 70_000, _HUGE))
        return kind, [_packed(_clicked(control, text))]
    if kind == "clicks":
        labels = ("Screenshot", "Video", "Random face", "Play", "Camera as filmed", "Motion")
        button = dice.choice([one for one in controls if one.label in labels])
        value = dice.choice(button.options) if button.options else True
        return kind, [_packed(_clicked(button, value))] * dice.choice((1, 30, 300))
    return kind, [_odd_bytes(dice)]


def _clicked(control: Control, value: bool | str = True) -> dict[str, Any]:
    return {"type": "GuiUpdateMessage", "uuid": control.uuid, "updates": {"value": value}}


def _odd(dice: Random) -> Any:
    value = edge_value(dice)
    return "[" * 1000 if isinstance(value, str) and value.startswith(DEEP) else value


def _odd_bytes(dice: Random) -> bytes | str:
    whole = _packed(_CAMERA)
    return dice.choice(
        (
            b"", b"\xc1", dice.randbytes(dice.choice((1, 20, 5000))), whole[: dice.randrange(len(whole))], "text",
            b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff\xa4type", b"\xc6\xff\xff\xff\xff", b"\x91" * 60_000,
            b"\x81\xa4type" * 9000, b"\x81\xa4type\xa4none", b"\x81\xa4type\x01", b"\x90", b"\xc0", b"\xa3\xff\xfe\xfd",
        )
    )  # fmt: skip


def _any_message(dice: Random, control: Control) -> dict[str, Any]:
    """A message of any type that viser knows, with odd fields of which some have the right type."""
    name = dice.choice(sorted(_TYPES))
    kind: Any = _TYPES[name]
    hints = get_type_hints(kind)
    message: dict[str, Any] = {"type": name}
    for entry in dataclasses.fields(kind) if dataclasses.is_dataclass(kind) else ():
        hint = hints[entry.name]
        plain = {int: 1, float: 1.0, str: "x", bool: True, bytes: b"x", dict: {}, tuple: ()}
        usual = control.uuid if "uuid" in entry.name else plain.get(get_origin(hint) or hint)
        message[entry.name] = usual if dice.random() < 0.7 else _odd(dice)
    return message


def _upload(dice: Random, control: Control) -> list[bytes | str]:
    """A file that nobody asked for."""
    known = {"source_component_uuid": control.uuid, "transfer_uuid": f"t{dice.random()}"}
    count = dice.choice((0, 1, 10))
    start = {
        "type": "FileTransferStartUpload", **known, "filename": "x", "mime_type": "x", "part_count": count + 1,
        "size_bytes": 1 << 40,
    }  # fmt: skip
    size = dice.choice((1000, 1000, _UPLOAD_PART))
    parts = [{"type": "FileTransferPart", **known, "part_index": n, "content": b"x" * size} for n in range(count)]
    return [_packed(start), *map(_packed, parts)]


def _packed(message: Any) -> bytes:
    """The message as viser's page packs it. msgpack has no integers of more than 64 bits, and no halves of pairs."""
    if isinstance(message, dict):
        message = {key: _narrow(value) for key, value in message.items()}
    return msgspec.msgpack.encode(message)


def _narrow(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _narrow(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_narrow(one) for one in value]
    if isinstance(value, int) and not -(2**63) <= value < 2**64:
        return float(np.clip(value, -1e300, 1e300)) if abs(value) < 1e300 else 1e300
    return value.encode(errors="replace").decode() if isinstance(value, str) else value


def _odd_request(dice: Random, viewer: Viewer, figures: Figures) -> None:
    """A request with odd headers. It must be refused."""
    odd = ("http://[", "null", "//", "http://[::1]:x", "é", "x" * 4000, "http://a\u2100b", "\x80", "[", "file://")
    name, value = dice.choice(("Origin", "Host", "Cookie")), dice.choice(odd)
    headers = {"Cookie": viewer.cookie, name: value} if name != "Host" else {name: value}
    status = viewer.request(dice.choice(("/", "/?token=%ff", "/%00", "/../x")), headers).status
    figures.refused_requests += 1
    if status not in (400, 403):
        figures.findings.append(f"a request with {name} {value[:30]!r} was answered with {status}")


async def _attack(viewer: Viewer, dice: Random, count: int, figures: Figures) -> None:
    """Send the messages, over new connections when one is closed or by chance."""
    connection: Any = None
    controls: list[Control] = []
    last = ""
    while figures.messages < count:
        if connection is None:
            try:
                connection = await viewer.connect()
            except OSError as error:
                figures.findings.append(f"nobody could connect before message {figures.messages} ({error}): {last}")
                return
            figures.connections += 1
            controls, seen = await look(connection)
            if not seen:
                figures.findings.append(f"a fresh browser got no picture before message {figures.messages}: {last}")
                return
        kind, messages = hostile(dice, controls)
        last = f"{kind} {messages[0][:200]!r}"
        figures.messages += 1
        try:
            for message in messages:
                await connection.send(message)
                figures.sent += 1
            await asyncio.sleep(0.02)
        except (websockets.ConnectionClosed, OSError, AttributeError):
            # websockets aborts a transport twice (AttributeError) if the viewer closes it within a long message.
            connection = None
        if viewer.process.poll() is not None:
            figures.findings.append(f"the viewer ended after message {figures.messages}: {last}")
            return
        if dice.random() < 0.1:
            await asyncio.to_thread(_odd_request, dice, viewer, figures)
        if connection is not None and dice.random() < 0.2 and not connection.transport.is_closing():
            connection.transport.abort()  # the cable is pulled
            connection = None


async def _judge(viewer: Viewer, figures: Figures) -> None:
    """Look at the viewer afresh, and end it, while another browser asks for pictures and takes none."""
    async with viewer.connect() as greedy, viewer.connect() as fresh:
        controls, _ = await look(greedy)
        for control in controls:
            if control.label == "Screenshot":
                for _ in range(300):
                    await greedy.send(_packed(_clicked(control)))
        if not (await look(fresh))[1]:
            figures.findings.append("afterwards, a fresh browser got no picture")
        figures.memory_mib = round(viewer.memory / 2**20)
        figures.end_seconds = round(await asyncio.to_thread(viewer.end), 2)


def campaign(count: int, seed: int) -> Figures:
    """Send that many hostile messages, and judge the viewer afterwards."""
    figures = Figures()
    with tempfile.TemporaryDirectory() as folder:
        viewer = Viewer(Path(folder))
        try:
            asyncio.run(_attack(viewer, Random(seed), count, figures))
            if viewer.process.poll() is None:
                asyncio.run(_judge(viewer, figures))
        finally:
            viewer.process.kill()
            viewer.process.wait()
        told = [line for line in viewer.told().splitlines() if not re.match(_EXPECTED, line)]
        viewer.forget()
    if viewer.process.returncode != 128 + signal.SIGTERM:
        figures.findings.append(f"exit code {viewer.process.returncode}")
    if told:
        figures.findings.append(f"it printed {len(told)} lines: {' | '.join(told)[-1500:]}")
    if figures.memory_mib * 2**20 > MOST_MEMORY:
        figures.findings.append(f"it took {figures.memory_mib} MiB")
    if figures.end_seconds > MOST_SECONDS:
        figures.findings.append(f"it ended {figures.end_seconds} s after SIGTERM")
    return figures


def main() -> int:
    """Run a campaign. The exit code is 1 if something was found."""
    parser = argparse.ArgumentParser(prog="fuzzing.viewer_messages", description=__doc__)
    parser.add_argument("--count", type=int, default=200, help="hostile messages")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    figures = campaign(asked.count, asked.seed)
    print(json.dumps(dataclasses.asdict(figures), indent=1))
    return int(bool(figures.findings))


if __name__ == "__main__":
    sys.exit(main())
