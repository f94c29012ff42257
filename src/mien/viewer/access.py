"""Who may use the viewer: checks of every request, before anything of it is answered.

Any page in a browser may open a connection to any address, so a server on loopback is not private by itself. Requests
therefore need the host that they were sent to, and the origin of that same host. Beyond loopback they also need a
token, which the printed address has; the first request turns it into a cookie.
"""

import hmac
import ipaddress
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qsl, urlsplit

LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")
_FORBIDDEN = "This viewer is private. Open the whole address that mien printed, with its token.\n"


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
    """An answer of the door, instead of the viewer's."""

    status: HTTPStatus
    headers: Mapping[str, str]
    body: str = ""


@dataclass(frozen=True)
class Door:
    """The rules of one viewer."""

    host: str
    """The host that it listens on."""
    token: str | None
    """What requests beyond loopback need. None on loopback."""

    @staticmethod
    def of(host: str) -> "Door":
        """The door of a host, with a new random token if it is not loopback."""
        return Door(host, None if is_loopback(host) else secrets.token_urlsafe(18))

    def answer(self, path: str, headers: Mapping[str, str]) -> Answer | None:
        """None if a request may go on, or what to answer instead.

        Args:
            path: The request's path with its query.
            headers: Its headers, under any capitals.
        """
        given = {name.lower(): value for name, value in headers.items()}
        host = given.get("host", "")
        origin = given.get("origin")
        if origin is not None and urlsplit(origin).netloc != host:
            return _refusal()
        if self.token is None:
            return None if _name_of(host) in (*LOOPBACK_NAMES, self.host) else _refusal()
        asked = dict(parse_qsl(path.partition("?")[2])).get("token")
        if asked is not None:
            if not _same(asked, self.token):
                return _refusal()
            cookie = f"{self._cookie}={self.token}; HttpOnly; SameSite=Strict; Path=/"
            return Answer(HTTPStatus.SEE_OTHER, {"Location": "/", "Set-Cookie": cookie})
        return None if _same(self._token_in(given.get("cookie", "")), self.token) else _refusal()

    def address(self, host: str, port: int) -> str:
        """The address that people open."""
        shown = f"[{host}]" if ":" in host else host
        return f"http://{shown}:{port}/" + (f"?token={self.token}" if self.token else "")

    @property
    def _cookie(self) -> str:
        # Cookies are the same for all ports of a host, so each viewer has its own name.
        return f"mien_{self.token[:6] if self.token else ''}"

    def _token_in(self, cookies: str) -> str:
        try:
            found = SimpleCookie(cookies).get(self._cookie)
        except CookieError:
            return ""
        return found.value if found is not None else ""


def _refusal() -> Answer:
    return Answer(HTTPStatus.FORBIDDEN, {"Content-Type": "text/plain; charset=utf-8"}, _FORBIDDEN)


def _name_of(host: str) -> str:
    """The name in a Host header, without its port."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


def _same(given: str, token: str) -> bool:
    return hmac.compare_digest(given.encode(errors="replace"), token.encode())
