"""Send hostile messages to a running viewer: `PYTHONPATH=tests python -m fuzzing.viewer_messages --count 200 --seed 1`.

The messages come from WebSocket clients with the viewer's token, as a browser that somebody has taken over. Afterwards,
a fresh browser must get a picture, the memory must be bounded, and SIGTERM must end the process soon."""

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

from fuzzing.kinds import DEEP, edge_value
from mien import runtime
from web_case import drawn_head

MOST_MEMORY = 2 << 30
"""Most memory that the viewer may take, in bytes."""
MOST_SECONDS = 90.0
"""Longest time from SIGTERM to the end of the process, in seconds."""
_PATIENCE_SECONDS = 60.0
_EXPECTED = r"Open http|.*take\.json: its face at rest is "
"""Lines that the viewer prints without any message."""
_TIMES = (1, 1, 1, 1, 3, 300)
"""How often a message is sent, by chance."""
_CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.0, 0.0, 0.0), "fov": 0.4, "near": 0.01,
    "far": 100.0, "image_height": 64, "image_width": 96, "look_at": (0.0, 0.0, 1.0), "up_direction": (0.0, -1.0, 0.0),
}  # fmt: skip
_TYPES = _messages.Message._subclass_from_type_string()
"""All messages that viser knows, by name."""
_BUTTONS = ("Screenshot", "Video", "Random face", "Play", "Camera as filmed", "Motion")


@dataclass
class Figures:
    """What a campaign gave."""

    messages: int = 0
    connections: int = 0
    memory_mib: float = 0.0
    end_seconds: float = 0.0
    findings: list[str] = field(default_factory=list)


class Viewer:
    """A process of `mien view`."""

    def __init__(self, folder: Path) -> None:
        """Start it, and wait until it can be opened."""
        runtime.write_portable(folder / "head.mien", drawn_head(1000))
        take = [{"timestamp_ms": 100 * step, "blendshapes": {"jawOpen": step / 10}} for step in range(10)]
        (folder / "take.json").write_text(json.dumps(take), encoding="utf-8")
        words = ["view", str(folder / "head.mien"), "--play", str(folder / "take.json")]
        self._told = folder / "told"
        with self._told.open("w") as told:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "mien.cli", *words], stdout=told, stderr=told,
                env={**os.environ, "MIEN_THREADS": "1"},
            )  # fmt: skip
        ends = time.monotonic() + _PATIENCE_SECONDS
        while not (opened := re.match(r"Open http://127\.0\.0\.1:(\d+)(/\S*)\s", self.told())):
            assert self.process.poll() is None, self.told()
            assert time.monotonic() < ends, self.told()
            time.sleep(0.1)
        self.port = int(opened[1])
        page = http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)
        page.request("GET", opened[2])
        self.cookie = (page.getresponse().getheader("Set-Cookie") or "").partition(";")[0]
        page.close()

    def told(self) -> str:
        return self._told.read_text(encoding="utf-8")

    def connect(self) -> Any:
        return websockets.connect(
            f"ws://127.0.0.1:{self.port}", subprotocols=[websockets.Subprotocol(f"viser-v{viser.__version__}")],
            additional_headers={"Cookie": self.cookie}, max_size=None, open_timeout=_PATIENCE_SECONDS,
        )  # fmt: skip

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


async def look(connection: Any) -> tuple[dict[str, tuple[str, list[str]]], bool]:
    """Look at the viewer as a browser does. Return controls by label (uuid, options), and whether a picture came."""
    await connection.send(_packed(_CAMERA))
    controls: dict[str, tuple[str, list[str]]] = {}
    seen = False
    try:
        async with asyncio.timeout(_PATIENCE_SECONDS):
            while not (seen and controls):
                content = await connection.recv()
                packed = content[16 : 16 + int.from_bytes(content[8:16], "little")]
                for message in msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(packed))["messages"]:
                    seen |= message["type"] == "BackgroundImageMessage" and message["rgb_data"] is not None
                    if message["type"].startswith("Gui") and "label" in message.get("props", ()):
                        options = list(message["props"].get("options", ()))
                        controls[message["props"]["label"]] = message["uuid"], options
    except (TimeoutError, websockets.ConnectionClosed):
        pass
    return controls, seen


def hostile(dice: Random, controls: dict[str, tuple[str, list[str]]]) -> tuple[str, list[Any]]:
    """One hostile message with its kind, or a few that belong together."""
    kind = dice.choice(("control", "control", "control", "camera", "other", "upload", "bytes", "huge", "clicks"))
    uuid, options = dice.choice(list(controls.values()))
    times = dice.choice(_TIMES)
    if kind == "control":
        name = dice.choice(("value",) * 9 + ("visible", "props", "uuid", "removed", "update_cb", "__class__", "x"))
        return kind, [_update(uuid, dice.choice((_odd(dice), *options[:1], "purple")), name)] * times
    if kind == "camera":
        camera: dict[str, Any] = dict(_CAMERA)
        for name in dice.sample(sorted(set(camera) - {"type"}), dice.randint(1, 3)):
            parts = isinstance(camera[name], tuple) and dice.random() < 0.8
            camera[name] = [_odd(dice) for _ in camera[name]] if parts else _odd(dice)
        return kind, [_packed(camera)] * times
    if kind == "other":
        return kind, [_packed(_any_message(dice, uuid))] * times
    if kind == "upload":  # a file that nobody asked for
        known, count = {"source_component_uuid": uuid, "transfer_uuid": f"t{dice.random()}"}, dice.choice((0, 1, 10))
        start = {"filename": "x", "mime_type": "x", "part_count": count + 1, "size_bytes": 1 << 40}
        content = b"x" * dice.choice((1000, 1000, 4 << 20))
        parts = [{"type": "FileTransferPart", **known, "part_index": n, "content": content} for n in range(count)]
        return kind, [_packed({"type": "FileTransferStartUpload", **known, **start}), *map(_packed, parts)]
    if kind == "huge":
        return kind, [_update(uuid, "x" * dice.choice((1000, 60_000, 70_000, 20_000_000)))]
    if kind == "clicks":
        uuid, options = controls[dice.choice([label for label in controls if label in _BUTTONS])]
        return kind, [_update(uuid, dice.choice(options or [True]))] * dice.choice((1, 30, 300))
    whole = _packed(_CAMERA)
    return kind, [dice.choice((
        b"", b"\xc1", dice.randbytes(dice.choice((1, 20, 5000))), whole[: dice.randrange(len(whole))], "text",
        b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff\xa4type", b"\xc6\xff\xff\xff\xff", b"\x91" * 60_000,
        b"\x81\xa4type" * 9000, b"\x81\xa4type\xa4none", b"\x81\xa4type\x01", b"\x90", b"\xc0", b"\xa3\xff\xfe\xfd",
    ))]  # fmt: skip


def _update(uuid: str, value: Any, name: str = "value") -> bytes:
    return _packed({"type": "GuiUpdateMessage", "uuid": uuid, "updates": {name: value}})


def _odd(dice: Random) -> Any:
    value = edge_value(dice)
    return "[" * 1000 if isinstance(value, str) and value.startswith(DEEP) else value


def _any_message(dice: Random, uuid: str) -> dict[str, Any]:
    """A message of any type that viser knows, with odd fields of which some have the right type."""
    name = dice.choice(sorted(_TYPES))
    kind: Any = _TYPES[name]
    hints = get_type_hints(kind)
    message: dict[str, Any] = {"type": name}
    plain: dict[Any, Any] = {int: 1, float: 1.0, str: "x", bool: True, bytes: b"x", dict: {}, tuple: ()}
    for entry in dataclasses.fields(kind) if dataclasses.is_dataclass(kind) else ():
        usual = uuid if "uuid" in entry.name else plain.get(get_origin(hints[entry.name]) or hints[entry.name])
        message[entry.name] = usual if dice.random() < 0.7 else _odd(dice)
    return message


def _packed(message: dict[str, Any]) -> bytes:
    """The message as viser's page packs it. msgpack has no integers of more than 64 bits, and no halves of pairs."""
    return msgspec.msgpack.encode({key: _narrow(value) for key, value in message.items()})


def _narrow(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _narrow(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_narrow(one) for one in value]
    if isinstance(value, int) and not -(2**63) <= value < 2**64:
        return float(np.clip(value, -1e300, 1e300)) if abs(value) < 1e300 else 1e300
    return value.encode(errors="replace").decode() if isinstance(value, str) else value


async def _attack(viewer: Viewer, dice: Random, count: int, figures: Figures) -> None:
    """Send the messages, over new connections when one is closed or by chance."""
    connection, controls, last = None, {}, ""
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
            await asyncio.sleep(0.02)
        except (websockets.ConnectionClosed, OSError, AttributeError):
            # websockets aborts a transport twice (AttributeError) if the viewer closes it within a long message.
            connection = None
        if viewer.process.poll() is not None:
            figures.findings.append(f"the viewer ended after message {figures.messages}: {last}")
            return
        if connection is not None and dice.random() < 0.2 and not connection.transport.is_closing():
            connection.transport.abort()  # the cable is pulled
            connection = None


async def _judge(viewer: Viewer, figures: Figures) -> None:
    """Look at the viewer afresh, and end it, while another browser asks for pictures and takes none."""
    async with viewer.connect() as greedy, viewer.connect() as fresh:
        controls, _ = await look(greedy)
        for _ in range(300 * ("Screenshot" in controls)):
            await greedy.send(_update(controls["Screenshot"][0], True))
        if not (await look(fresh))[1]:
            figures.findings.append("afterwards, a fresh browser got no picture")
        status = Path(f"/proc/{viewer.process.pid}/status").read_text(encoding="utf-8")
        figures.memory_mib = int(re.findall(r"VmHWM:\s+(\d+)", status)[0]) >> 10
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
    if viewer.process.returncode != 128 + signal.SIGTERM:
        figures.findings.append(f"exit code {viewer.process.returncode}")
    if told:
        figures.findings.append(f"it printed {len(told)} lines: {' | '.join(told)[-1500:]}")
    if figures.memory_mib * 2**20 > MOST_MEMORY:
        figures.findings.append(f"it took {figures.memory_mib} MiB")
    if figures.end_seconds > MOST_SECONDS:
        figures.findings.append(f"it ended {figures.end_seconds} s after SIGTERM")
    return figures


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="fuzzing.viewer_messages", description=__doc__)
    parser.add_argument("--count", type=int, default=200, help="hostile messages")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    figures = campaign(asked.count, asked.seed)
    print(json.dumps(dataclasses.asdict(figures), indent=1))
    sys.exit(bool(figures.findings))
