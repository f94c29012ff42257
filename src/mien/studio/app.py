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
from typing import TYPE_CHECKING, Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route

from mien.avatar.methods import method_names
from mien.disk.reading import check_unlinked, parse_json
from mien.errors import CannotWriteError, UserError
from mien.formats.shared.webcam import webcam_files
from mien.machine.terminal import tell
from mien.machine.threads import thread_count
from mien.studio.advice import advice_for
from mien.studio.making import QUALITIES, Maker, Settings
from mien.studio.people import MOST_CHUNK, MOST_FACE, FullError, NotThereError, OtherPlaceError, People
from mien.studio.taking import TAKINGS, place_of, take

if TYPE_CHECKING:
    import mien.studio.phone

_MOST_JSON = 16 << 10
_FRAMED = "sandbox allow-scripts allow-downloads; frame-ancestors 'self'"
"""Policy of files: a page from a workspace has no origin, so it can ask the studio for nothing."""
_STATUS = {
    NotThereError: HTTPStatus.NOT_FOUND, OtherPlaceError: HTTPStatus.CONFLICT,
    FullError: HTTPStatus.INSUFFICIENT_STORAGE, CannotWriteError: HTTPStatus.INSUFFICIENT_STORAGE,
}  # fmt: skip
_landmarker_files = cache(webcam_files)
Answering = Callable[[Request], Awaitable[Response]]


@cache
def page(name: str) -> tuple[bytes, str]:
    """A page of the studio, built from web/, and its policy: it loads nothing, and runs its own script alone."""
    text = (Path(__file__).parent / name).read_text(encoding="utf-8")

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


def does(act: Callable[..., Any], reads: bool = False) -> Answering:
    """An answer that calls a function with what the path names. A POST brings json, which is `content` with `reads`."""

    async def doing(request: Request) -> Response:
        content = await json_of(request) if request.method == "POST" else {}
        given = {**request.path_params, **({"content": content} if reads else {})}
        return JSONResponse(await run_in_threadpool(act, **given) or {})

    return doing


def sends(place: Callable[..., Path]) -> Answering:
    """An answer that sends the file which a function names, or the part of it that the browser asks for."""

    async def sending(request: Request) -> Response:
        path = await run_in_threadpool(place, **request.path_params)
        check_unlinked(path)
        if not path.is_file():
            raise NotThereError(f"{path.name}: is not there yet")
        saved = f"{request.path_params['name']} {path.name}" if "save" in request.query_params else None
        return FileResponse(path, filename=saved, headers={"Content-Security-Policy": _FRAMED})

    return sending


class Studio:
    """The answers to a browser on this machine. The door has let it in."""

    def __init__(self, people: People, maker: Maker, phones: "mien.studio.phone.Phones | None") -> None:
        """Prepare the answers. Without `phones`, none can send a film."""
        self.people, self.maker, self.phones = people, maker, phones
        person, film = "/api/people/{name}", "/api/people/{name}/films/{film}"
        taken = "/api/people/{name}/take/{kind}"
        routes: list[tuple[str, str, Answering]] = [
            ("GET", "/", self._home), ("GET", "/index.html", self._home), ("GET", "/landmarker/{part}", _landmarker),
            ("GET", "/api/people", does(self._list)), ("POST", "/api/people", does(self._add, reads=True)),
            ("GET", person, does(self._whole)), ("DELETE", person, does(self._remove)),
            ("GET", f"{person}/face", sends(lambda name: people.folder(name) / "face.jpg")),
            ("PUT", f"{person}/face", self._set_face),
            ("POST", f"{person}/films", does(self._begin_film, reads=True)),
            ("PUT", film, self._append), ("POST", film, does(self._end_film, reads=True)),
            ("DELETE", film, does(self._end_film)), ("GET", film, sends(people.film)),
            ("POST", f"{person}/making", does(self._make, reads=True)),
            ("DELETE", f"{person}/making", does(maker.drop)), ("GET", f"{person}/growing", sends(maker.growing)),
            ("GET", f"{person}/fit", sends(lambda name: people.folder(name) / "tracking_preview.html")),
            ("POST", taken, does(lambda name, kind: self._taken(name, kind, take) and None)),
            ("GET", taken, sends(self._taken)), ("POST", f"{person}/phone", does(self._invite)),
            ("DELETE", f"{person}/phone", does(lambda name: phones and phones.end(name))),
        ]  # fmt: skip
        found = [Route(path, answered(answer), methods=[method]) for method, path, answer in routes]
        self.app = Starlette(routes=found, exception_handlers={Exception: _failed})
        self.app.router.redirect_slashes = False

    async def _home(self, request: Request) -> Response:
        return page_response("studio.html")

    def _list(self) -> dict[str, Any]:
        """All people, and what the page offers."""
        offered = {"qualities": QUALITIES, "methods": method_names(), "threads": thread_count()}
        offered |= {"lan": self.phones is not None}
        people = [self._short(name) for name in self.people.names()]
        return {"folder": self.people.root.resolve().name, "people": people, "offered": offered}

    def _add(self, content: Mapping[str, Any]) -> dict[str, str]:
        """Add a person, who must have agreed."""
        if content.get("agreed") is not True:
            raise UserError("the person has to agree before the first recording; ask, and confirm it")
        name = given.strip() if isinstance(given := content.get("name"), str) else ""
        self.people.add(name)
        return {"name": name}

    def _remove(self, name: str) -> None:
        """Remove a person with everything."""
        self.people.folder(name)
        self.maker.drop(name)
        self.people.remove(name)
        self.maker.forget(name)

    async def _set_face(self, request: Request) -> Response:
        content = await body_of(request, MOST_FACE)
        await run_in_threadpool(self.people.write_face, request.path_params["name"], content)
        return JSONResponse({})

    def _begin_film(self, name: str, content: Mapping[str, Any]) -> dict[str, str]:
        return {"film": self.people.begin_film(name, str(content.get("ending", "")))}

    async def _append(self, request: Request) -> Response:
        return await append(request, self.people, request.path_params["name"], request.path_params["film"])

    def _end_film(self, name: str, film: str, content: Mapping[str, Any] | None = None) -> dict[str, Any] | None:
        """Finish a film, or remove it without `content`. A phone that was sending it sends no more."""
        remove, finish = self.people.remove_film, self.people.finish_film
        facts = remove(name, film) if content is None else finish(name, film, content.get("cut") is True)
        if self.phones is not None:
            self.phones.end(name, film)
        return facts

    def _make(self, name: str, content: Mapping[str, Any]) -> None:
        self.maker.add(name, Settings.of(content))

    def _taken(self, name: str, kind: str, of: Callable[..., Path | None] = place_of) -> Path:
        """A file that is taken away: for a frame of the page, or to be saved."""
        run = self.maker.run_of(name)
        found = of(self.people.folder(name), run, kind) if run is not None and kind in TAKINGS else None
        if found is None:
            raise NotThereError(f"{kind:.40}: is not there yet; prepare it first")
        return found

    def _invite(self, name: str) -> dict[str, str]:
        """Let a phone send a film of a person, once."""
        if self.phones is None:
            raise UserError("phones cannot reach this studio; start it with `mien studio DIR --lan`")
        self.people.folder(name)
        return self.phones.invite(name)

    def _short(self, name: str) -> dict[str, Any]:
        """What the list shows of a person."""
        folder, progress = self.people.folder(name), self.maker.progress(name)
        newest = max(path.stat().st_mtime for path in (folder, *folder.glob("me.html"), *folder.glob("films")))
        made = self.maker.run_of(name) is not None
        return {
            "name": name, "face": _changed(folder / "face.jpg"), "changed": round(newest), "made": made,
            "progress": asdict(progress),
        }  # fmt: skip

    def _whole(self, name: str) -> dict[str, Any]:
        """Everything about a person."""
        folder, run, noted = self.people.folder(name), self.maker.run_of(name), self.people.read(name)
        ready = {} if run is None else {kind: place_of(folder, run, kind) is not None for kind in TAKINGS}
        takings = [
            {"kind": kind, "title": TAKINGS[kind].title, "opens": TAKINGS[kind].opens, "ready": is_ready}
            for kind, is_ready in ready.items()
            if is_ready or TAKINGS[kind].options is not None
        ]
        return {
            **self._short(name), "takings": takings, "settings": noted.get("settings", asdict(Settings())),
            "films": [{**asdict(film), "facts": dict(film.facts)} for film in self.people.films(name)],
            "growing": _changed(self.maker.growing(name)), "fit": _changed(folder / "tracking_preview.html"),
            "advice": advice_for(folder / "me.mien", run) if run is not None else [],
            "phone": None if self.phones is None else self.phones.state(name),
        }  # fmt: skip


def _changed(path: Path) -> int | None:
    """When a file changed, as a mark for the page; None if it is missing."""
    return path.stat().st_mtime_ns if path.is_file() else None


async def _landmarker(request: Request) -> Response:
    """A part of the face landmarker that the page runs."""
    part = (await run_in_threadpool(_landmarker_files)).get(request.path_params["part"])
    if part is None:
        raise NotThereError("there is no such part of the landmarker")
    return Response(part, media_type="application/octet-stream")


async def _failed(request: Request, error: Exception) -> Response:
    with contextlib.suppress(OSError):
        tell(f"mien: a browser's request failed, and the studio goes on ({type(error).__name__}: {error!s:.300})")
    return JSONResponse({"error": "this is a bug in mien; the terminal says more"}, HTTPStatus.INTERNAL_SERVER_ERROR)
