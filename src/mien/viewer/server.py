"""The viewer's server: viser shows our pictures behind its controls, and `mien.viewer.access` guards every request."""

import contextlib
import gzip
import http.client
import io
import logging
import math
import socket
import threading
import warnings
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import viser
import viser.transforms
import websockets.asyncio.server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from mien.machine.terminal import tell
from mien.plugins import missing_package
from mien.viewer.access import HEADERS, Door, address_of
from mien.viewer.camera import CameraSwitch
from mien.viewer.drawing import View
from mien.viewer.loop import DrawingLoop
from mien.viewer.panel import Panel, filmed_from
from mien.viewer.session import Session, center_of

_SCRIPT = """<script>
// mien draws the pictures, not the browser: without these words viser does not ask whether the browser has a GPU.
for (const kind of [self.WebGLRenderingContext, self.WebGL2RenderingContext]) {
  if (!kind) continue;
  const get = kind.prototype.getExtension;
  kind.prototype.getExtension = function (name) {
    return name === "WEBGL_debug_renderer_info" ? null : get.call(this, name);
  };
}
// On phones, viser's panel lies over the avatar: it begins folded, and a touch of its title unfolds it. How wide the
// window is shows only after this script, because the words on the viewport come later in the page.
new MutationObserver((changes, watch) => {
  const isTitle = ({ style }) => style.height === "3.5em" && style.cursor === "pointer";
  const title = [...document.querySelectorAll("div")].find(isTitle);
  if (!title) return;
  watch.disconnect();
  if (matchMedia("(max-width: 36em)").matches) title.click();
}).observe(document, { childList: true, subtree: true });
</script>"""
"""What mien adds to viser's page: no warning of a missing GPU, and a folded panel on phones."""


def serve(
    session: Session, door: Door, listener: socket.socket, title: str, camera: CameraSwitch | None = None
) -> None:
    """Show a session to browsers until Ctrl-C or SIGTERM, or until its camera ends.

    `door` says who may use it. Browsers may wait already at the listener, which `listen` returned.
    """
    serving = Serving(session, door, listener, title, camera)
    try:
        serving.wait()
    finally:
        serving.stop()


class Serving:
    """A server that runs."""

    def __init__(
        self, session: Session, door: Door, listener: socket.socket, title: str, camera: CameraSwitch | None = None
    ) -> None:
        """Start the server; the arguments are those of `serve`."""
        self.session, self.door, self._camera = session, door, camera
        self.failures: list[str] = []
        """The first failures of requests of browsers. The viewer goes on."""
        self._failing = threading.Lock()
        self.port = int(listener.getsockname()[1])
        # A client that vanishes in the middle of a request is no error of the viewer.
        logging.getLogger("websockets").setLevel(logging.CRITICAL)
        # viser prints on standard output.
        with contextlib.redirect_stdout(io.StringIO()), _guarded(door, listener):
            self.server = viser.ViserServer(host=door.host, port=self.port, label="mien", verbose=False)
        try:
            _check_guard(door.host, self.port)
            # viser could pass this server on through a machine of its makers.
            self.server.request_share_url = lambda verbose=True: None
            self.server.get_event_loop().set_exception_handler(self._task_failed)
            self._show(title)
        except BaseException:
            with contextlib.redirect_stdout(io.StringIO()):
                self.server.stop()
            raise
        self.address = address_of(door, listener)

    def wait(self) -> None:
        """Wait until the camera ends, or the loop fails, which is a bug. Ctrl-C and SIGTERM end the wait, too."""
        while self.loop.running and not (self._camera is not None and self._camera.ended):
            self.loop.wait(0.5)
        if self.loop.error is not None:
            raise self.loop.error

    def stop(self) -> None:
        """Close all connections, and end all threads."""
        # Connections that are still open are cut, which asyncio would report.
        logging.getLogger("asyncio").setLevel(logging.CRITICAL)
        self.panel.stop()
        self.loop.stop()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def _show(self, title: str) -> None:
        server, session = self.server, self.session
        server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        server.gui.main_panel.dock_right()
        position, target, up = filmed_from(session)
        camera = session.avatar.camera
        server.scene.set_up_direction(up)
        server.initial_camera.position = position
        server.initial_camera.look_at = center_of(session.avatar)
        server.initial_camera.up = up
        server.initial_camera.fov = 2 * math.atan(0.5 * camera.height / float(camera.K[1, 1]))
        self.loop = DrawingLoop(session.picture, session.advance, failed=self._failed)
        session.changed = self.loop.change
        self.panel = Panel(server, session, title, view_of, self._failed, self._camera)
        self.loop.start()
        # A browser may leave while its picture is drawn; viser would warn about that.
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
        server.on_client_connect(self._welcome)
        server.on_client_disconnect(self._forget)

    def _failed(self, error: BaseException) -> None:
        """Tell that something could not be done for a browser, and go on for the others."""
        missing = missing_package(error, "view") if isinstance(error, ImportError) else None
        words = missing or f"a browser's request failed, and the viewer goes on ({type(error).__name__}: {error})"
        with self._failing:
            if words in self.failures or len(self.failures) >= 10:  # a browser could cause them again and again
                return
            self.failures.append(words)
        tell(f"mien: {words}")
        for client in self.server.get_clients().values() if missing else ():
            client.add_notification("mien", words, color="red")

    def _task_failed(self, loop: Any, context: dict[str, Any]) -> None:
        error = context.get("exception")
        if isinstance(error, Exception):
            self._failed(error)

    async def _welcome(self, client: viser.ClientHandle) -> None:
        words = client.gui.add_markdown("", order=0.5)
        first, moved = view_of(client.camera), False

        def show(picture: Any, full: bool) -> None:
            client.scene.set_background_image(picture, format="jpeg", jpeg_quality=92 if full else 75)
            seen = self.session.taken()
            if seen is not None and self._camera is not None:
                self._camera.shown(seen)
            self.panel.follow()
            if not self.session.playing:
                words.content = self.session.words(view_of(client.camera))

        async def look(camera: viser.CameraHandle) -> None:
            nonlocal moved
            view = view_of(camera)
            moved = moved or not np.array_equal(view.viewmat, first.viewmat)
            if not moved:
                # The page has not taken the camera yet that it is told to begin with. Its own is far beside the head.
                view = replace(view, viewmat=self.session.avatar.camera.viewmat.astype(np.float64))
            if view.is_possible:
                self.loop.look(client.client_id, view)

        self.loop.add(client.client_id, show)
        client.camera.on_update(look)
        await look(client.camera)  # a browser may have waited for the avatar

    async def _forget(self, client: viser.ClientHandle) -> None:
        self.loop.remove(client.client_id)


def view_of(camera: viser.CameraHandle) -> View:
    """The view of a browser's camera. viser's cameras have OpenCV axes, too."""
    rotation = viser.transforms.SO3(camera.wxyz).as_matrix()
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation.T
    viewmat[:3, 3] = -rotation.T @ camera.position
    return View(viewmat, float(camera.fov), int(camera.image_width), int(camera.image_height))


@contextlib.contextmanager
def _guarded(door: Door, listener: socket.socket) -> Iterator[None]:
    """Let servers that start inside listen at a socket, and ask the door about each request. viser cannot do that."""
    module: Any = websockets.asyncio.server
    start = module.serve

    def guarded(
        handler: Callable[[Any], Awaitable[None]], host: str, port: int,
        process_request: Callable[[Any, Request], Response | None], **named: Any,
    ) -> Any:  # fmt: skip
        def process(connection: Any, request: Request) -> Response | None:
            told = door.answer(request.path, dict(request.headers.raw_items()))
            if told is not None:
                response = Response(told.status.value, told.status.phrase, Headers(told.headers), told.body)
            else:
                given = process_request(connection, request)
                response = None if given is None else _adapted(given)
            if response is not None:
                response.headers.update(HEADERS)
            return response

        named |= {"max_size": 1 << 16, "close_timeout": 1.0}  # bytes of a message; seconds for a browser's answer
        return start(handler, sock=listener, process_request=process, **named)

    module.serve = guarded
    try:
        yield
    finally:
        module.serve = start


def _adapted(response: Response) -> Response:
    """The answer with mien's script, if it is viser's page. Any other answer stays as it is."""
    if not response.headers.get("Content-Type", "").startswith("text/html"):
        return response
    packed = response.headers.get("Content-Encoding") == "gzip"
    body = gzip.decompress(response.body) if packed else response.body
    body = body.replace(b"<head>", b"<head>" + _SCRIPT.encode(), 1)
    body = gzip.compress(body) if packed else body
    headers = Headers(response.headers.raw_items())
    del headers["Content-Length"]
    headers["Content-Length"] = str(len(body))
    return Response(response.status_code, response.reason_phrase, headers, body)


def _check_guard(host: str, port: int) -> None:
    """Check that a request which the door refuses is refused, so that no version of viser can go around it."""
    reached = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
    connection = http.client.HTTPConnection(reached, port, timeout=10)
    try:
        connection.request("GET", "/", headers={"Host": "stranger.invalid"})
        status = connection.getresponse().status
    finally:
        connection.close()
    assert status == http.HTTPStatus.FORBIDDEN, f"the viewer's door is open: {status}"
