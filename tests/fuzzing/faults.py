"""Put faults into a file, or something else into its place; formats have faults of their own (`formats.py`)."""

import contextlib
import os
import shutil
import socket
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random

from damage import flip_or_cut
from fuzzing.formats import FORMATS
from fuzzing.kinds import CANARY, DEEP, PORT, faulty_bytes
from fuzzing.repairs import repair_around

DAMAGE = "damage"
"""Name of the faults that a checksum must notice."""
SPARSE = 3 << 30
"""Size in bytes of a file that takes no room on the disk."""


@dataclass
class Place:
    """Folder and file of a case. `file` changes if the file is renamed."""

    root: Path
    """Folder with the copies."""
    file: Path
    canary: Path
    """Folder outside of the copies, into which nothing may be written."""
    port: int
    """Port of this machine to which nothing may connect."""

    def write(self, data: bytes) -> None:
        """Write the file with the placeholders of folder and port replaced, and correct what is said around it."""
        data = data.replace(CANARY.encode(), os.fsencode(self.canary)).replace(PORT.encode(), str(self.port).encode())
        self.file.write_bytes(data)
        repair_around(self.file)


def faulty_file(place: Place, dice: Random) -> str:
    """Damage a file, put something else in its place, or make a fault of its format with correct checksums."""
    if dice.random() > 0.12:
        return any_fault(place, dice, 0.12)
    place.file.write_bytes(flip_or_cut(place.file.read_bytes(), dice))
    return DAMAGE


def faulty_place(place: Place, dice: Random) -> str:
    return "place: " + put_something_else(place.file, place.canary, dice)


def any_fault(place: Place, dice: Random, elsewhere: float = 0.35) -> str:
    """Make a fault, but no unrepaired damage, for folders and files that may also be read from elsewhere."""
    chosen = faulty_place if place.file.is_dir() or dice.random() < elsewhere else faulty_format
    return chosen(place, dice)


def faulty_format(place: Place, dice: Random) -> str:
    kind, data = FORMATS.get(place.file.suffix, faulty_bytes)(place.file.read_bytes(), dice)
    place.write(data)
    return kind


def put_something_else(path: Path, canary: Path, dice: Random, kind: str = "") -> str:
    """Put something else where a file or folder is, and return the kind of fault."""
    kind = kind or dice.choice(_KINDS)
    beside = [other for other in path.parent.iterdir() if other != path and other.is_dir() == path.is_dir()]
    copy = shutil.copytree if path.is_dir() else shutil.copy
    if kind == "twice":
        second = path.with_name(path.name.replace("0", "1", 1) if "0" in path.name else f"{path.name}2")
        if not second.exists():
            copy(path, second)
    elif kind == "swapped" and beside:
        other, aside = dice.choice(beside), path.with_name(".aside")
        path.rename(aside)
        other.rename(path)
        aside.rename(other)
    elif kind == "copied" and beside:
        _remove(path)
        copy(dice.choice(beside), path)
    elif kind == "moved out":  # the original is outside now, with a link to it, and nothing may be changed there
        outside = canary / f"moved{path.suffix}"
        _remove(outside)
        path.rename(outside)
        path.symlink_to(outside)
    else:
        was_folder = path.is_dir()
        _remove(path)
        PLACES.get(kind, lambda *_: None)(path, canary, was_folder)
    return kind


def outside_of(canary: Path) -> None:
    """Fill the folder that links lead to and that nothing may be written into."""
    (canary / "folder").mkdir(parents=True)
    names = ("victim.json", "victim.safetensors", "victim.png", "victim.u8", "victim")
    for name in (*names, "folder/victim.txt", "folder/000000.png"):
        (canary / name).write_bytes(b"precious " * 20)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _socket(path: Path) -> None:
    # The path of a socket may have only a hundred characters, so it is made from within its folder.
    with contextlib.chdir(path.parent), socket.socket(socket.AF_UNIX) as made:
        made.bind(path.name[:90])


def _sparse(path: Path) -> None:
    path.touch()
    os.truncate(path, SPARSE)


def _victim(path: Path, canary: Path, was_folder: bool = False) -> Path:
    alike = canary / f"victim{path.suffix}"
    return canary / "folder" if was_folder else alike if alike.exists() else canary / "victim"


PLACES: dict[str, Callable[[Path, Path, bool], object]] = {
    "missing": lambda path, canary, was_folder: None,
    "empty": lambda path, canary, was_folder: path.mkdir() if was_folder else path.write_bytes(b""),
    "folder": lambda path, canary, was_folder: path.write_bytes(b"text") if was_folder else path.mkdir(),
    "full folder": lambda path, canary, was_folder: (path / "a" / "b").mkdir(parents=True),
    "pipe": lambda path, canary, was_folder: os.mkfifo(path),
    "socket": lambda path, canary, was_folder: _socket(path),
    "link outside": lambda path, canary, was_folder: path.symlink_to(_victim(path, canary, was_folder)),
    "link upwards": lambda path, canary, was_folder: path.symlink_to(
        os.path.relpath(_victim(path, canary), path.parent)),
    "link beyond": lambda path, canary, was_folder: path.symlink_to(canary / f"new{path.suffix}"),
    "link to itself": lambda path, canary, was_folder: path.symlink_to(path.name),
    "endless": lambda path, canary, was_folder: path.symlink_to("/dev/zero"),
    "null": lambda path, canary, was_folder: path.symlink_to("/dev/null"),
    "sparse": lambda path, canary, was_folder: _sparse(path),
    "text": lambda path, canary, was_folder: path.write_text(f"{{}} {DEEP}"),
}  # fmt: skip
"""Things that may lie in the place of a file or folder."""


def _damaged(change: Callable[[bytes], bytes]) -> Callable[[Place], str]:
    def fault(place: Place) -> str:
        place.file.write_bytes(change(place.file.read_bytes()))
        return DAMAGE

    return fault


def _placed(kind: str) -> Callable[[Place], str]:
    return lambda place: put_something_else(place.file, place.canary, Random(0), kind)


def _flipped(data: bytes, at: int, bit: int) -> bytes:
    changed = bytearray(data)
    changed[at] ^= bit
    return bytes(changed)


FIXED: dict[str, Callable[[Place], str]] = {
    **{kind: _placed(kind) for kind in (
        "missing", "empty", "folder", "pipe", "link outside", "link beyond", "endless", "sparse", "text")},
    "cut": _damaged(lambda data: data[: len(data) // 2]),
    "a bit": _damaged(lambda data: _flipped(data, len(data) // 3, 4)),
    "the first byte": _damaged(lambda data: _flipped(data, 0, 1)),
    "the last byte": _damaged(lambda data: _flipped(data, -1, 1)),
    "zeros": _damaged(lambda data: bytes(len(data))),
}  # fmt: skip
"""Damage that every reader gets."""
_KINDS = (*PLACES, *("link outside", "link beyond") * 2, *("moved out",) * 2, "swapped", "copied", "twice")
