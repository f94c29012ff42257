"""The people of a studio, on disk: each is a workspace in its folder, with the films that were made of the person."""

import json
import re
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mien.disk.files import cannot_write, read_json, write_atomically, write_json
from mien.disk.reading import check_unlinked, inside, open_new, remove_tree
from mien.disk.workspace import is_workspace
from mien.errors import UserError

RECORD = ("mien.studio-person", 1)
_RECORD_FILE = "studio.json"
ENDINGS = ("webm", "mp4", "mov", "m4v", "mkv", "avi")
MOST_CHUNK = 8 << 20
"""Largest piece of a film in one request, in bytes."""
MOST_FILM = 4 << 30
"""Largest film, in bytes: two hours of a telephone."""
_MOST_FILMS, _MOST_PEOPLE = 20, 1000
MOST_FACE = 512 << 10
_ROOM_LEFT = 1 << 30
"""Bytes that films leave free on the disk, so that an avatar can still be made."""
_PROBE_SECONDS = 120
_COMES_SECONDS = 6.0
"""How long no piece of a film may come, which recorders send every second, until it counts as left behind."""
_NAME = re.compile(r"[^\W_](?:[\w .'-]{0,58}[\w'-])?")
_FILM = re.compile(rf"film_(\d{{1,4}})\.(?:{'|'.join(ENDINGS)})")
_PART = ".part"
_changing = threading.Lock()
"""Held while a record or a film is changed, since requests are answered by several threads."""


class NotThereError(UserError):
    """There is no such person or film."""


class OtherPlaceError(UserError):
    """A piece of a film does not begin where the film ends: another tab has sent it, or it was sent twice."""


class FullError(UserError):
    """There is no room for more."""


@dataclass(frozen=True)
class Film:
    """A film of a person."""

    name: str
    size: int
    whole: bool
    """Whether it was finished."""
    coming: bool
    """Whether it is not, and was added to in the last seconds. Otherwise the tab that sent it was closed."""
    facts: Mapping[str, Any]
    """Width and height in pixels, and seconds."""

    @property
    def number(self) -> int:
        """The number in its name."""
        return int(self.name[5:].partition(".")[0])


@dataclass(frozen=True)
class People:
    """The folder of a studio."""

    root: Path

    def names(self) -> list[str]:
        """The names of all people, sorted."""
        found = (each for each in self.root.iterdir() if _NAME.fullmatch(each.name) and not each.is_symlink())
        return sorted(each.name for each in found if (each / _RECORD_FILE).is_file() or is_workspace(each))

    def folder(self, name: str) -> Path:
        """The folder of a person."""
        if not _NAME.fullmatch(name) or name not in self.names():
            raise NotThereError(f"{name!r:.80}: there is nobody of this name; go back to the list")
        return self.root / name

    def add(self, name: str) -> None:
        """Add a person who has agreed to be filmed."""
        if not _NAME.fullmatch(name):
            raise UserError(f"{name!r:.80} cannot name a folder; give up to 60 letters, digits, spaces and - ' .")
        if name.casefold() in {each.name.casefold() for each in self.root.iterdir()}:
            raise UserError(f"{name}: there is such a person or folder already; give another name, or open that one")
        if len(self.names()) >= _MOST_PEOPLE:
            raise FullError(f"{self.root}: holds {_MOST_PEOPLE} people; start a studio in another folder")
        self.write(name, agreed=round(time.time()))

    def read(self, name: str) -> dict[str, Any]:
        """What the studio has noted of a person; empty for a workspace that it did not make, or a damaged note."""
        path = self.folder(name) / _RECORD_FILE
        try:
            return read_json(path, *RECORD, remedy="delete it")
        except UserError:
            return {}

    def write(self, name: str, **changes: Any) -> None:
        """Note something of a person."""
        path = self.root / name / _RECORD_FILE
        with _changing:
            known = self.read(name) if path.exists() else {}
            write_json(path, *RECORD, {**known, **changes})

    def films(self, name: str) -> list[Film]:
        """The films of a person, in the order in which they were begun."""
        folder, facts, found = self.folder(name) / "films", self.read(name).get("films", {}), []
        for path in folder.iterdir() if folder.is_dir() and not folder.is_symlink() else ():
            plain = path.name.removeprefix(".").removesuffix(_PART) if path.name.startswith(".") else path.name
            if _FILM.fullmatch(plain) and path.is_file() and not path.is_symlink():
                stat, whole = path.stat(), plain == path.name
                coming = not whole and time.time() - stat.st_mtime < _COMES_SECONDS
                found.append(Film(plain, stat.st_size, whole, coming, facts.get(plain, {})))
        return sorted(found, key=lambda film: film.number)

    def film(self, name: str, film: str) -> Path:
        """The file of a finished film."""
        if not any(each.name == film and each.whole for each in self.films(name)):
            raise NotThereError(f"{film!r:.80}: {name} has no such film")
        return self.folder(name) / "films" / film

    def begin_film(self, name: str, ending: str) -> str:
        """Begin a film, and return its name."""
        if ending not in ENDINGS:
            raise UserError(f".{ending!s:.20}: is no film; give a file that ends in .{', .'.join(ENDINGS)}")
        folder = self.folder(name) / "films"
        with _changing:
            films = self.films(name)
            if len(films) >= _MOST_FILMS:
                raise FullError(f"{name}: has {_MOST_FILMS} films; remove one first")
            film = f"film_{max((each.number for each in films), default=0) + 1}.{ending}"
            try:
                folder.mkdir(exist_ok=True)
                check_unlinked(folder)
                open_new(_part(folder, film)).close()
            except OSError as error:
                raise cannot_write(folder, error) from None
        return film

    def append(self, name: str, film: str, at: int, piece: bytes) -> int:
        """Append a piece to a film that was begun, and return its size. The piece has to begin at the film's end."""
        part = self._part_of(name, film)
        if len(piece) > MOST_CHUNK or at + len(piece) > MOST_FILM:
            raise FullError(f"{film}: is larger than {MOST_FILM >> 30} GB; film at a lower resolution, or cut it")
        if shutil.disk_usage(self.root).free < _ROOM_LEFT + len(piece):
            raise FullError(f"{self.root}: the disk is full; free {(_ROOM_LEFT >> 30) + 1} GB and try again")
        try:
            with _changing, part.open("r+b", buffering=0) as file:
                size = file.seek(0, 2)
                if size != at:
                    raise OtherPlaceError(f"{film}: has {size} bytes, and the piece begins at {at}")
                try:
                    rest = memoryview(piece)
                    while rest:
                        rest = rest[file.write(rest) :]
                except OSError:
                    file.truncate(size)  # a part of the piece
                    raise
        except OSError as error:
            raise cannot_write(part, error) from None
        return at + len(piece)

    def finish_film(self, name: str, film: str, cut: bool = False) -> dict[str, Any]:
        """End a film that was begun, and return its facts. What is no film is removed, unless it was cut."""
        part = self._part_of(name, film)
        facts = _probed(part)
        if facts is None and cut:
            raise UserError(f"{film}: its end has not come, so it cannot be read; send it again, or remove it")
        if facts is None:
            part.unlink(missing_ok=True)
            raise UserError("this is no film that can be read; give one of a camera, such as .mp4 or .mov")
        try:
            part.replace(part.with_name(film))
        except OSError as error:
            raise cannot_write(part, error) from None
        self.write(name, films={**self.read(name).get("films", {}), film: facts})
        return facts

    def remove_film(self, name: str, film: str) -> None:
        """Remove a film, finished or not."""
        if film not in {each.name for each in self.films(name)}:
            raise NotThereError(f"{film!r:.80}: {name} has no such film")
        folder = self.folder(name) / "films"
        for path in (folder / film, _part(folder, film)):
            path.unlink(missing_ok=True)

    def write_face(self, name: str, picture: bytes) -> None:
        """Keep the picture that stands for a person, a JPEG."""
        if not picture.startswith(b"\xff\xd8\xff"):
            raise UserError("the picture is no JPEG; send another one")
        write_atomically(self.folder(name) / "face.jpg", lambda aside: aside.write_bytes(picture))

    def remove(self, name: str) -> None:
        """Remove a person with films, workspace and files."""
        remove_tree(self.folder(name))

    def drop_footage(self, name: str) -> None:
        """Remove the films of a person, and the frames that were taken from them."""
        for part in ("films", "sequences", "tracking_preview.html"):
            remove_tree(inside(self.folder(name), part))

    def _part_of(self, name: str, film: str) -> Path:
        if not _FILM.fullmatch(film) or not (part := _part(self.folder(name) / "films", film)).is_file():
            raise NotThereError(f"{film!r:.80}: no such film of {name} has begun; begin it first")
        check_unlinked(part.parent)
        check_unlinked(part)
        return part


def _part(folder: Path, film: str) -> Path:
    return folder / f".{film}{_PART}"


def _probed(path: Path) -> dict[str, Any] | None:
    """Facts about a film; None if it is none. A process reads it, since a hostile file may end what decodes it."""
    command = [sys.executable, "-m", "mien.studio.probe", str(path)]
    with suppress(subprocess.TimeoutExpired):
        done = subprocess.run(command, capture_output=True, text=True, timeout=_PROBE_SECONDS, check=False)
        if done.returncode >= 0:
            return json.loads(done.stdout) if done.returncode == 0 else None
    raise UserError("the film could not be looked at; keep it again, or remove it")
