"""Films from phones: a page of its own for the local network, which takes one film for each invitation.

The page is plain http, since its file input needs no more: the phone's camera application films. Everything on that
socket needs the token in its path. The token is in the QR code alone, and ends with the film.
"""

import hmac
import secrets
import socket
import threading
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import segno
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from mien.errors import UserError
from mien.studio.app import answered, append, json_of, page_response
from mien.studio.people import NotThereError, People


@dataclass
class Invitation:
    """The permission to send one film of a person."""

    name: str
    token: str
    film: str | None = None
    """Its name, once it has begun."""
    sent_as: tuple[str, int] = ("", -1)
    """The ending and the size in bytes by which a phone that comes back knows it; the size is -1 if none was told."""
    done: bool = False


class Phones:
    """The invitations, and the answers to phones."""

    def __init__(self, people: People, address: str) -> None:
        """Prepare the answers. `address` is where phones find them, such as http://192.168.1.2:8000."""
        self.people, self.address = people, address
        self._invited: dict[str, Invitation] = {}
        self._change = threading.Lock()

    def invite(self, name: str) -> dict[str, str]:
        """Invite a phone, and return the address and its QR code as svg. They stay the same while a film comes."""
        with self._change:
            invited = self._invited.get(name)
            if invited is None or invited.done or invited.film is None:
                self._invited[name] = invited = Invitation(name, secrets.token_urlsafe(18))
        url = f"{self.address}/{invited.token}/"
        return {"url": url, "svg": segno.make(url, error="m").svg_inline(scale=6, border=4, dark="#000", light="#fff")}

    def end(self, name: str, film: str | None = None) -> None:
        """End the invitation of a person; with `film`, only the one by which that film comes."""
        with self._change:
            invited = self._invited.get(name)
            if invited is not None and film in (None, invited.film):
                del self._invited[name]

    def state(self, name: str) -> dict[str, Any] | None:
        """Whether a phone is invited to film a person, and how far its film is; None without an invitation."""
        with self._change:
            invited = self._invited.get(name)
        return invited and {"film": invited.film, "size": invited.sent_as[1], "done": invited.done}

    def app(self) -> Starlette:
        """The answers to phones."""
        routes = (
            ("GET", "/{token}/", self._page), ("POST", "/{token}/begin", self._begin),
            ("PUT", "/{token}/piece", self._append), ("POST", "/{token}/done", self._done),
        )  # fmt: skip
        app = Starlette(routes=[Route(path, answered(answer), methods=[method]) for method, path, answer in routes])
        app.router.redirect_slashes = False
        return app

    def _invitation(self, request: Request) -> Invitation:
        token = request.path_params["token"].encode()
        with self._change:
            for invited in self._invited.values():
                if hmac.compare_digest(invited.token.encode(), token) and not invited.done:
                    return invited
        raise NotThereError("this address has ended; ask for a new code in the studio")

    def _sending(self, request: Request) -> tuple[Invitation, str]:
        invited = self._invitation(request)
        if invited.film is None:
            raise UserError("the film has not begun; begin it first")
        return invited, invited.film

    async def _page(self, request: Request) -> Response:
        self._invitation(request)
        return page_response("phone.html")

    async def _begin(self, request: Request) -> Response:
        """Begin a film, or go on with the same one, and tell how many of its bytes are here."""
        invited, content = self._invitation(request), await json_of(request)
        ending, size = str(content.get("ending", "")), content.get("size")
        sent_as = (ending, size if isinstance(size, int) else -1)
        return JSONResponse({"at": await run_in_threadpool(self._begun, invited, sent_as)})

    def _begun(self, invited: Invitation, sent_as: tuple[str, int]) -> int:
        """The bytes that are here of a film that a phone begins, or goes on with after it had gone away."""
        films = {film.name: film.size for film in self.people.films(invited.name) if not film.whole}
        if invited.film in films and invited.sent_as == sent_as and sent_as[1] != -1:
            return films[invited.film]
        earlier, invited.film = invited.film, self.people.begin_film(invited.name, sent_as[0])
        invited.sent_as = sent_as
        if earlier in films:  # the phone sends another film in its place
            self.people.remove_film(invited.name, earlier)
        return 0

    async def _append(self, request: Request) -> Response:
        invited, film = self._sending(request)
        return await append(request, self.people, invited.name, film)

    async def _done(self, request: Request) -> Response:
        invited, film = self._sending(request)
        await json_of(request)
        facts = await run_in_threadpool(self.people.finish_film, invited.name, film)
        invited.done = True
        return JSONResponse(facts)


def address_on_network() -> str:
    """The address of this machine on its local network. Nothing is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking, suppress(OSError):
        asking.connect(("192.0.2.1", 9))  # an address for documentation: only the route to it is looked up
        found = str(asking.getsockname()[0])
        if not found.startswith("127."):
            return found
    raise UserError("--lan: this machine is on no network; connect it, or leave --lan out")
