"""What browsers may send: every message is checked and clamped here, before viser reads it.

Everybody who has the address can send any bytes, and viser passes on whatever value they hold. The gate therefore lets
two kinds of messages through, a camera and a new value of a control, and writes them anew from the checked values:
numbers are finite and within the slider's range, choices are among those offered, texts are short. All other messages
are dropped, uploads among them, because no control of ours takes a file.
"""

import math
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import viser

MOST_BYTES = 1 << 16
"""Largest message of a browser, in bytes. A browser that sends a larger one is disconnected."""
MOST_TEXT = 100
"""Number of characters of a text that are kept."""
_MOST_DISTANCE = 1e5
"""Largest distance of a camera along an axis, in metres."""
_MOST_ROTATION = 2.0
"""Largest component of a quaternion, which is normalised. The inverse is its least length."""
_LEAST_FIELD, _MOST_FIELD = 0.01, math.pi - 0.01
"""Fields of view of a browser, in radians."""
_MOST_SIDE = 1 << 14
"""Largest side of a browser's canvas, in pixels."""

_Triple = tuple[float, float, float]
Plain = bool | int | float | str
"""Values of controls."""


class _Camera(msgspec.Struct, tag_field="type", tag="ViewerCameraMessage"):
    wxyz: tuple[float, float, float, float]
    position: _Triple
    fov: float
    near: float
    far: float
    image_height: float
    image_width: float
    look_at: _Triple
    up_direction: _Triple


class _Value(msgspec.Struct):
    value: Plain


class _Update(msgspec.Struct, tag_field="type", tag="GuiUpdateMessage"):
    uuid: str
    updates: _Value


_DECODER = msgspec.msgpack.Decoder(_Camera | _Update)


class Gate:
    """Lets the messages through that a viewer expects."""

    def __init__(self) -> None:
        """Make a gate that is closed: messages wait until `open`, and nothing else passes."""
        self._control: Callable[[str], Any] = lambda uuid: None
        self.is_open = False

    def open(self, gui: viser.GuiApi) -> None:
        """Let messages through from now on, for the controls of `gui`."""
        self._control, self.is_open = gui._gui_input_handle_from_uuid.get, True

    def checked(self, message: bytes | str) -> bytes | None:
        """The message with checked values, or None if it is dropped."""
        if isinstance(message, str):
            return None
        try:
            read = _DECODER.decode(message)
        except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError):
            return None
        passed = _checked_camera(read) if isinstance(read, _Camera) else self._checked_update(read)
        return None if passed is None else msgspec.msgpack.encode(passed)

    def _checked_update(self, update: _Update) -> dict[str, Any] | None:
        value = checked_value(self._control(update.uuid), update.updates.value)
        if value is None:
            return None
        return {"type": "GuiUpdateMessage", "uuid": update.uuid, "updates": {"value": value}}


def checked_value(control: Any, value: Plain) -> Plain | None:
    """The value that a control takes, clamped, or None if it takes no such value."""
    if isinstance(control, viser.GuiButtonHandle):
        return True
    if isinstance(control, viser.GuiCheckboxHandle):
        return value if isinstance(value, bool) else None
    if isinstance(control, viser.GuiDropdownHandle):
        return value if value in control.options else None
    if isinstance(control, viser.GuiTextHandle):
        return value[:MOST_TEXT] if isinstance(value, str) else None
    if isinstance(control, viser.GuiSliderHandle):
        if isinstance(value, bool | str) or not math.isfinite(value):
            return None
        return type(control.value)(min(max(value, control.min), control.max))
    return None


def _checked_camera(camera: _Camera) -> dict[str, Any] | None:
    """The message of a camera, or None if nothing can be seen from there. A hidden window has no size."""
    rotation = np.array(camera.wxyz)
    places = np.array((camera.position, camera.look_at, camera.up_direction))
    numbers = np.array((camera.fov, camera.near, camera.far, camera.image_height, camera.image_width))
    if not all(np.isfinite(values).all() for values in (rotation, places, numbers)):
        return None
    if np.abs(rotation).max() > _MOST_ROTATION:
        return None
    length = float(np.linalg.norm(rotation))
    if not (length > 1 / _MOST_ROTATION and np.abs(places).max() <= _MOST_DISTANCE):
        return None
    return {
        "type": "ViewerCameraMessage",
        "wxyz": tuple((rotation / length).tolist()),
        "position": camera.position,
        "fov": min(max(camera.fov, _LEAST_FIELD), _MOST_FIELD),
        "near": min(max(camera.near, 0.0), _MOST_DISTANCE),
        "far": min(max(camera.far, 0.0), _MOST_DISTANCE),
        "image_height": int(min(max(camera.image_height, 0), _MOST_SIDE)),
        "image_width": int(min(max(camera.image_width, 0), _MOST_SIDE)),
        "look_at": camera.look_at,
        "up_direction": camera.up_direction,
    }
