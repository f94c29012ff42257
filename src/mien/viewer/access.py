"""Who may use the viewer: checks of every request, before anything of it is answered.

A server on loopback is not private by itself: any page in a browser may open a connection to it, and so may every
other user of the machine. Requests therefore need a token, which the printed address has; the first request turns it
into a cookie. They also need the origin of the host that they were sent to.
"""

import errno
import hmac
import ipaddress
import secrets
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from urllib.parse import SplitResult, parse_qsl, urlsplit

from mien.errors import UserError
from mien.machine.terminal import printable

LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")
HEADERS: Mapping[str, str] = {
    "X-Frame-Options": "DENY",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}
"""Headers of every answer: no page of another origin may show the viewer in a frame, and none is told its address."""
_PAGE = "index.html"
"""Where the first request is sent on, relative to its address. The name keeps a proxy's sub-path: viser's page connects
to its own address without the last slash, and proxies answer that with a redirect, which no WebSocket follows."""
_NO_TOKEN = "This page is private. Open the whole address that mien printed, with its token.\n"
_STRANGE_ORIGIN = (
    "This server answers only pages of its own: the request came from a page of {origin}, and its Host is {host}. "
    "Behind a proxy, let the proxy pass on the browser's Host header.\n"
)
_STRANGE_HOST = (
    "This viewer runs without a token, so it answers only as localhost, and the request's Host is {host}. Open the "
    "address that mien printed. Behind a proxy, start mien without --no-token.\n"
)


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach a host."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True)
class Answer:
    """What a request gets in place of what it asked for."""

    status: HTTPStatus
    headers: Mapping[str, str]
    body: bytes = b""


@dataclass(frozen=True)
class Door:
    """The rules of one server."""

    host: str
    """The host that it listens on."""
    token: str | None
    """What requests need. None for a viewer on loopback that every user of this machine may open."""

    @staticmethod
    def of(host: str, with_token: bool = True) -> "Door":
        """The door of a host, with a new random token."""
        if not with_token and not is_loopback(host):
            raise UserError(f"--no-token: other machines can reach --host {host}; leave --no-token out")
        return Door(host, secrets.token_urlsafe(18) if with_token else None)

    def answer(self, path: str, headers: Mapping[str, str]) -> Answer | None:
        """None if a request may go on, or what to answer instead. `path` has the query, too."""
        given = {name.lower(): value for name, value in headers.items()}
        host = given.get("host", "")
        origin = given.get("origin")
        parts = None if origin is None else _parts_of(origin)
        if origin is not None and (parts is None or parts.netloc != host):
            return _refusal(_STRANGE_ORIGIN.format(origin=_shown(origin), host=_shown(host)))
        if self.token is None:
            parts = _parts_of(f"//{host}")
            known = parts is not None and parts.hostname in (*LOOPBACK_NAMES, self.host)
            return None if known else _refusal(_STRANGE_HOST.format(host=_shown(host)))
        asked = dict(parse_qsl(path.partition("?")[2])).get("token")
        if asked is not None:
            if not _same(asked, self.token):
                return _refusal(_NO_TOKEN)
            # Without a path, the cookie is for the folder of the address, which may be a proxy's sub-path.
            cookie = f"{self.cookie}; HttpOnly; SameSite=Strict"
            return Answer(HTTPStatus.SEE_OTHER, {"Location": _PAGE, "Set-Cookie": cookie, "Content-Length": "0"})
        return None if _same(self._token_in(given.get("cookie", "")), self.token) else _refusal(_NO_TOKEN)

    def address(self, host: str, port: int) -> str:
        """The address that people open."""
        shown = f"[{host}]" if ":" in host else host
        return f"http://{shown}:{port}/" + (f"?token={self.token}" if self.token else "")

    @property
    def cookie(self) -> str:
        """The cookie of a browser that may use the viewer, NAME=VALUE."""
        # Cookies are the same for all ports of a host, so each viewer has its own name.
        return f"mien_{self.token[:6] if self.token else ''}={self.token}"

    def _token_in(self, cookies: str) -> str:
        try:
            found = SimpleCookie(cookies).get(self.cookie.partition("=")[0])
        except CookieError:
            return ""
        return found.value if found is not None else ""


def listen(host: str, port: int) -> socket.socket:
    """Listen at a port, or at a free one if it is 0. Browsers that connect wait until a server takes the socket."""
    try:
        family, kind, protocol, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listener = socket.socket(family, kind, protocol)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(place)
            listener.listen()
        except OSError:
            listener.close()
            raise
        return listener
    except (OSError, UnicodeError) as error:
        number = getattr(error, "errno", None)
        if number == errno.EADDRINUSE:
            raise UserError(
                f"--port {port}: another program uses it; give another port, or leave --port out for a free one"
            ) from None
        if number == errno.EACCES:
            raise UserError(f"--port {port}: is not allowed for this user; give one above 1023") from None
        raise UserError(
            f"--host {host}: is no address of this machine; give one of its addresses, or 0.0.0.0 for all"
        ) from None


def address_of(door: Door, listener: socket.socket) -> str:
    """The address that people open to reach a socket."""
    host = socket.gethostname() if door.host in ("0.0.0.0", "::") else door.host
    return door.address(host, int(listener.getsockname()[1]))


def _refusal(words: str) -> Answer:
    body = words.encode()
    headers = {"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))}
    return Answer(HTTPStatus.FORBIDDEN, headers, body)


def _parts_of(address: str) -> SplitResult | None:
    """The parts of an address, or None if it is none."""
    try:
        return urlsplit(address)
    except ValueError:
        return None


def _shown(header: str) -> str:
    """A header as an answer repeats it."""
    return printable(header[:100]) or "missing"


def _same(given: str, token: str) -> bool:
    return hmac.compare_digest(given.encode(errors="replace"), token.encode())
