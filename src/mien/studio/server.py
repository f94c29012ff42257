"""The studio's server: uvicorn on a socket of loopback, and with `lan` on another one for phones."""

import contextlib
import logging
import threading
from http import HTTPStatus
from pathlib import Path
from urllib.parse import urlsplit

import uvicorn
from starlette.responses import PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from mien.disk.locks import hold
from mien.studio.app import Studio
from mien.studio.making import Maker
from mien.studio.people import People
from mien.studio.phone import Phones, address_on_network
from mien.viewer.access import HEADERS, LOOPBACK_NAMES, Door, address_of, listen

_HEADERS = {
    **HEADERS, "X-Frame-Options": "SAMEORIGIN", "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
}  # fmt: skip
_STRANGE = PlainTextResponse(
    "This address is not that of the studio. Open the whole address that mien printed.\n", HTTPStatus.FORBIDDEN
)
_MOST_CONNECTIONS = 64


class Guard:
    """Asks the door about each request of this machine's browsers, and the host about each of phones."""

    def __init__(self, door: Door, port: int, app: ASGIApp, phones: Phones | None) -> None:
        """Guard the answers of `app` at a port of loopback, and those of `phones` at every other socket."""
        self._door, self._port, self._app = door, port, app
        self._for_phones = None if phones is None else phones.app()
        self._host_of_phones = "" if phones is None else urlsplit(phones.address).netloc

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                given = {name.lower() for name, _ in message["headers"]}
                added = [(name.lower().encode(), value.encode()) for name, value in _HEADERS.items()]
                message["headers"] = [*message["headers"], *(pair for pair in added if pair[0] not in given)]
            await send(message)

        if scope["type"] == "http":
            await self._answer(scope)(scope, receive, guarded)

    def _answer(self, scope: Scope) -> ASGIApp:
        headers = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}
        host, origin = headers.get("host", ""), headers.get("origin")
        if tuple(scope["server"]) != (self._door.host, self._port):
            known = host == self._host_of_phones and origin in (None, f"http://{host}")
            return self._for_phones if known and self._for_phones is not None else _STRANGE
        if host not in {f"{f'[{name}]' if ':' in name else name}:{self._port}" for name in LOOPBACK_NAMES}:
            return _STRANGE
        told = self._door.answer(scope["path"] + "?" + scope["query_string"].decode("latin-1"), headers)
        return self._app if told is None else Response(told.body, told.status, told.headers)


class Serving:
    """A studio that runs."""

    def __init__(self, root: Path, port: int = 0, lan: bool = False, maker: Maker | None = None) -> None:
        """Start the server of a folder, and go on with its queue. `maker` replaces it, for trials."""
        with contextlib.ExitStack() as closing:
            people = People(root)
            closing.enter_context(hold(root / ".studio" / "server", remedy="use that studio, or end it first"))
            self.door = Door.of("127.0.0.1")
            own = closing.enter_context(contextlib.closing(listen(self.door.host, port)))
            self.port, sockets = int(own.getsockname()[1]), [own]
            self.address = address_of(self.door, own)
            phones = None
            if lan:
                sockets.append(closing.enter_context(contextlib.closing(listen(address_on_network(), 0))))
                host, at = sockets[1].getsockname()[:2]
                phones = Phones(people, f"http://{host}:{at}")
            self.phones, self.maker = phones, maker or Maker(people)
            guard = Guard(self.door, self.port, Studio(people, self.maker, phones).app, phones)
            logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL)  # a client that vanishes is no error
            config = uvicorn.Config(
                guard, log_config=None, access_log=False, lifespan="off", ws="none", http="h11", loop="asyncio",
                server_header=False, proxy_headers=False, limit_concurrency=_MOST_CONNECTIONS,
                timeout_graceful_shutdown=2,
            )  # fmt: skip
            self._server = uvicorn.Server(config)
            self._thread = threading.Thread(target=self._server.run, kwargs={"sockets": sockets}, daemon=True)
            self._thread.start()
            self.maker.start()
            self._closing = closing.pop_all()

    def wait(self) -> None:
        """Wait until the server ends, which is a bug. Ctrl-C and SIGTERM end the wait, too."""
        while self._thread.is_alive():
            self._thread.join(0.5)

    def stop(self) -> None:
        """Stop what is made, which the next studio goes on with, and close all connections."""
        self._server.should_exit = True
        self.maker.end()
        self._thread.join(10.0)
        self._closing.close()
