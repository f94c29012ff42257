"""The answers of the studio's server: pages, people, films, the making and what is taken away (Starlette)."""

import contextlib
import hashlib
import re
from base64 import b64encode
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import asdict
from functools import cache
from http import HTTPStatus
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route

from mien.avatar.methods import method_names
from mien.disk.config import decode
from mien.disk.reading import check_unlinked, parse_json
from mien.errors import CannotWriteError, UserError
from mien.formats.shared.webcam import webcam_files
from mien.machine.terminal import tell
from mien.machine.threads import thread_count
from mien.studio.advice import advice_for
from mien.studio.making import QUALITIES, Maker, Settings
from mien.studio.people import MOST_CHUNK, FullError, NotThereError, OtherPlaceError, People
from mien.studio.phone import Phones
from mien.studio.taking import TAKINGS, place_of, take

_MOST_JSON = 16 << 10
_PAGES = Path(__file__).parent
_FRAMED = "sandbox allow-scripts allow-downloads; frame-ancestors 'self'"
"""Policy of files: a page from a workspace has no origin, so it can ask the studio for nothing."""
_STATUS = {
    NotThereError: HTTPStatus.NOT_FOUND, OtherPlaceError: HTTPStatus.CONFLICT,
    FullError: HTTPStatus.INSUFFICIENT_STORAGE, CannotWriteError: HTTPStatus.INSUFFICIENT_STORAGE,
}  # fmt: skip
Answering = Callable[[Request], Awaitable[Response]]


@cache
def page(name: str) -> tuple[bytes, str]:
    """A page of the studio, built from web/, and its policy: it loads nothing, and runs its own script alone."""
    text = (_PAGES / name).read_text(encoding="utf-8")

    def allowed(tag: str) -> str:
        inside = re.findall(rf"<{tag}>(.*?)</{tag}>", text, re.DOTALL)
        return " ".join(f"'sha256-{b64encode(hashlib.sha256(each.encode()).digest()).decode()}'" for each in inside)

    policy = (
        f"default-src 'none'; script-src {allowed('script')} blob: 'wasm-unsafe-eval'; style-src {allowed('style')}; "
        "worker-src blob:; connect-src 'self'; img-src 'self' blob: data:; media-src 'self' blob:; frame-src 'self'; "
        "form-action 'none'; base-uri 'none'; frame-ancestors 'none'"
    )
    return text.encode(), policy


def page_response(name: str) -> Response:
    """The answer that is a page."""
    content, policy = page(name)
    return Response(content, media_type="text/html", headers={"Content-Security-Policy": policy})


async def body_of(request: Request, most: int) -> bytes:
    """The body of a request, which is refused if it has more bytes than that, however it is sent."""
    parts, size = [], 0
    async for part in request.stream():
        size += len(part)
        if size > most:
            raise FullError(f"the request has more than {most:,} bytes; send less at a time")
        parts.append(part)
    return b"".join(parts)


async def json_of(request: Request) -> Mapping[str, Any]:
    """The object that a request brings as json. Forms of other pages cannot send that type."""
    if request.headers.get("content-type", "").partition(";")[0] != "application/json":
        raise UserError("the request's Content-Type is not application/json; send json")
    try:
        content = parse_json((await body_of(request, _MOST_JSON)).decode())
    except ValueError as error:
        raise UserError(f"the request is no json ({error!s:.100}); send json") from None
    if not isinstance(content, dict):
        raise UserError("the request is no object of json; send {...}")
    return content


def answered(answer: Answering) -> Answering:
    """An answer whose mistakes become words for the page."""

    async def answering(request: Request) -> Response:
        try:
            return await answer(request)
        except (UserError, UnicodeError) as error:
            status = next((code for kind, code in _STATUS.items() if isinstance(error, kind)), HTTPStatus.BAD_REQUEST)
            return JSONResponse({"error": str(error)}, status)

    return answering


async def append(request: Request, people: People, name: str, film: str) -> Response:
    """Append the piece of a film that a request brings."""
    place = request.query_params.get("at", "")
    if not re.fullmatch(r"\d{1,15}", place):
        raise UserError(f"at={place:.20}: is no place in a film; give a number of bytes")
    piece = await body_of(request, MOST_CHUNK)
    return JSONResponse({"size": await run_in_threadpool(people.append, name, film, int(place), piece)})


class Studio:
    """The answers to a browser on this machine. The door has let it in."""

    def __init__(self, people: People, maker: Maker, phones: Phones | None) -> None:
        """Prepare the answers. Without `phones`, none can send a film."""
        self.people, self.maker, self.phones = people, maker, phones
        person, film = "/api/people/{name}", "/api/people/{name}/films/{film}"
        routes: list[tuple[str, str, Answering]] = [
            ("GET", "/", self.home), ("GET", "/index.html", self.home), ("GET", "/landmarker/{part}", self.landmarker),
            ("GET", "/api/people", self.list), ("POST", "/api/people", self.add),
            ("GET", person, self.show), ("DELETE", person, self.remove),
            ("GET", f"{person}/face", self.face), ("PUT", f"{person}/face", self.set_face),
            ("POST", f"{person}/films", self.begin_film), ("PUT", film, self.append),
            ("POST", film, self.finish_film), ("DELETE", film, self.remove_film), ("GET", film, self.film),
            ("POST", f"{person}/making", self.make), ("DELETE", f"{person}/making", self.stop),
            ("GET", f"{person}/growing", self.growing), ("GET", f"{person}/fit", self.fit),
            ("POST", f"{person}/take/{{kind}}", self.prepare), ("GET", f"{person}/take/{{kind}}", self.take),
            ("POST", f"{person}/phone", self.open_phone), ("DELETE", f"{person}/phone", self.close_phone),
        ]  # fmt: skip
        found = [Route(path, answered(answer), methods=[method]) for method, path, answer in routes]
        self.app = Starlette(routes=found, exception_handlers={Exception: _failed})

    async def home(self, request: Request) -> Response:
        """The page."""
        return page_response("studio.html")

    async def landmarker(self, request: Request) -> Response:
        """A part of the face landmarker that the page runs."""
        part = request.path_params["part"]
        parts = await run_in_threadpool(_landmarker)
        if part not in parts:
            raise NotThereError(f"{part:.40}: is no part of the landmarker")
        return Response(parts[part], media_type="application/octet-stream")

    async def list(self, request: Request) -> Response:
        """All people, and what the page offers."""
        people = await run_in_threadpool(lambda: [self._short(name) for name in self.people.names()])
        offered = {
            "qualities": QUALITIES,
            "methods": method_names(),
            "threads": thread_count(),
            "lan": bool(self.phones),
        }
        return JSONResponse({"folder": self.people.root.resolve().name, "people": people, "offered": offered})

    async def add(self, request: Request) -> Response:
        """Add a person, who must have agreed."""
        content = await json_of(request)
        if content.get("agreed") is not True:
            raise UserError("the person has to agree before the first recording; ask, and confirm it")
        name = content.get("name")
        if not isinstance(name, str):
            raise UserError("the request has no name; give one")
        await run_in_threadpool(self.people.add, name)
        return JSONResponse({"name": name}, HTTPStatus.CREATED)

    async def show(self, request: Request) -> Response:
        """Everything about a person."""
        return JSONResponse(await run_in_threadpool(self._whole, request.path_params["name"]))

    async def remove(self, request: Request) -> Response:
        """Remove a person with everything."""
        name = request.path_params["name"]
        self.people.folder(name)

        def remove() -> None:
            self.maker.drop(name)
            self.people.remove(name)
            self.maker.forget(name)

        await run_in_threadpool(remove)
        return JSONResponse({})

    async def face(self, request: Request) -> Response:
        """The picture that stands for a person."""
        return self._file(self.people.folder(request.path_params["name"]) / "face.jpg")

    async def set_face(self, request: Request) -> Response:
        """Take that picture."""
        content = await body_of(request, 1 << 20)
        await run_in_threadpool(self.people.write_face, request.path_params["name"], content)
        return JSONResponse({})

    async def begin_film(self, request: Request) -> Response:
        """Begin a film."""
        ending = str((await json_of(request)).get("ending", ""))
        film = await run_in_threadpool(self.people.begin_film, request.path_params["name"], ending)
        return JSONResponse({"film": film}, HTTPStatus.CREATED)

    async def append(self, request: Request) -> Response:
        """Take a piece of a film."""
        return await append(request, self.people, request.path_params["name"], request.path_params["film"])

    async def finish_film(self, request: Request) -> Response:
        """End a film."""
        await json_of(request)
        given = request.path_params
        return JSONResponse(await run_in_threadpool(self.people.finish_film, given["name"], given["film"]))

    async def remove_film(self, request: Request) -> Response:
        """Remove a film."""
        given = request.path_params
        await run_in_threadpool(self.people.remove_film, given["name"], given["film"])
        return JSONResponse({})

    async def film(self, request: Request) -> Response:
        """A film, or the part of it that the browser plays."""
        return self._file(self.people.film(request.path_params["name"], request.path_params["film"]))

    async def make(self, request: Request) -> Response:
        """Put a person into the queue."""
        settings = decode(Settings, await json_of(request), "settings", "choose again")
        await run_in_threadpool(self.maker.add, request.path_params["name"], settings)
        return JSONResponse({}, HTTPStatus.ACCEPTED)

    async def stop(self, request: Request) -> Response:
        """Stop the work on a person."""
        self.people.folder(request.path_params["name"])
        await run_in_threadpool(self.maker.drop, request.path_params["name"])
        return JSONResponse({})

    async def growing(self, request: Request) -> Response:
        """The avatar while it trains."""
        name = request.path_params["name"]
        self.people.folder(name)
        return self._file(self.maker.growing(name))

    async def fit(self, request: Request) -> Response:
        """The page that shows the fit of the face while it runs."""
        return self._file(self.people.folder(request.path_params["name"]) / "tracking_preview.html")

    async def prepare(self, request: Request) -> Response:
        """Have a file written that is taken away."""
        await json_of(request)
        await run_in_threadpool(take, *self._taken(request))
        return JSONResponse({})

    async def take(self, request: Request) -> Response:
        """A file that is taken away: for a frame of the page, or to be saved."""
        folder, run, kind = self._taken(request)
        found = place_of(folder, run, kind)
        if found is None:
            raise NotThereError(f"{kind}: is not there yet; prepare it first")
        saved = f"{folder.name} {found.name}" if "save" in request.query_params else None
        return self._file(found, saved)

    async def open_phone(self, request: Request) -> Response:
        """Let a phone send a film of a person, once."""
        await json_of(request)
        if self.phones is None:
            raise UserError("phones cannot reach this studio; start it with `mien studio DIR --lan`")
        self.people.folder(request.path_params["name"])
        return JSONResponse(self.phones.invite(request.path_params["name"]))

    async def close_phone(self, request: Request) -> Response:
        """End the invitation."""
        if self.phones is not None:
            self.phones.end(request.path_params["name"])
        return JSONResponse({})

    def _short(self, name: str) -> dict[str, Any]:
        folder, progress = self.people.folder(name), self.maker.progress(name)
        face = folder / "face.jpg"
        newest = max(path.stat().st_mtime for path in (folder, *folder.glob("me.html"), *folder.glob("films")))
        return {
            "name": name, "face": face.stat().st_mtime_ns if face.is_file() else None, "changed": round(newest),
            "progress": asdict(progress), "made": self.maker.run_of(name) is not None,
        }  # fmt: skip

    def _whole(self, name: str) -> dict[str, Any]:
        folder, run, noted = self.people.folder(name), self.maker.run_of(name), self.people.read(name)
        growing, fit = self.maker.growing(name), folder / "tracking_preview.html"
        takings = [
            {"kind": kind, "title": each.title, "opens": each.opens, "ready": place_of(folder, run, kind) is not None}
            for kind, each in TAKINGS.items()
            if run is not None and (each.options is not None or place_of(folder, run, kind) is not None)
        ]
        return {
            **self._short(name), "takings": takings, "settings": noted.get("settings", asdict(Settings())),
            "films": [{**asdict(film), "facts": dict(film.facts)} for film in self.people.films(name)],
            "growing": growing.stat().st_mtime_ns if growing.is_file() else None,
            "fit": fit.stat().st_mtime_ns if fit.is_file() else None,
            "advice": advice_for(folder / "me.mien") if run is not None else [],
            "phone": None if self.phones is None else self.phones.state(name),
        }  # fmt: skip

    def _taken(self, request: Request) -> tuple[Path, str, str]:
        name, kind = request.path_params["name"], request.path_params["kind"]
        folder, run = self.people.folder(name), self.maker.run_of(name)
        if kind not in TAKINGS or run is None:
            raise NotThereError(f"{kind:.40}: {name} has nothing of this kind yet")
        return folder, run, kind

    def _file(self, path: Path, saved: str | None = None) -> Response:
        check_unlinked(path)
        if not path.is_file():
            raise NotThereError(f"{path.name}: is not there yet")
        return FileResponse(path, filename=saved, headers={"Content-Security-Policy": _FRAMED})


@cache
def _landmarker() -> Mapping[str, bytes]:
    return webcam_files()


async def _failed(request: Request, error: Exception) -> Response:
    with contextlib.suppress(OSError):
        tell(f"mien: a browser's request failed, and the studio goes on ({type(error).__name__}: {error!s:.300})")
    return JSONResponse({"error": "this is a bug in mien; the terminal says more"}, HTTPStatus.INTERNAL_SERVER_ERROR)
