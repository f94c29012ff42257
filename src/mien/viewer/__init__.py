"""The viewer: an avatar in a browser, drawn by mien's own renderer on the processor.

Session, pictures and the loop that draws know nothing of the browser. Only
`server.py`, `panel.py` and `messages.py` call viser.
"""

from typing import TYPE_CHECKING

from mien.lazy import lazy_names

if TYPE_CHECKING:
    from mien.viewer.access import Door, is_loopback
    from mien.viewer.drawing import Look, Mesh, View
    from mien.viewer.following import CameraSwitch
    from mien.viewer.loop import DrawingLoop
    from mien.viewer.server import address_of, listen, serve
    from mien.viewer.session import Clip, Seen, Session
else:
    __getattr__, __dir__ = lazy_names(__name__, __file__)

__all__ = [
    "CameraSwitch",
    "Clip",
    "Door",
    "DrawingLoop",
    "Look",
    "Mesh",
    "Seen",
    "Session",
    "View",
    "address_of",
    "is_loopback",
    "listen",
    "serve",
]
