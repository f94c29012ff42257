"""Make faults in places: files that are missing, folders, links, pipes, devices, swapped, huge; and odd names."""

import os
import shutil
import socket
from pathlib import Path
from random import Random

from fuzzing.edges import DEEP, PORT

SPARSE = 3 << 30
"""Size in bytes of a file that takes no room on the disk."""
NAMES = (
    "take:1", "http:x", f"http:127.0.0.1:{PORT}", "file:x", "concat:a|b", "pipe:1", "data:,x", "-", "--help", "-i",
    "a b", " ", "...", "%d", "%06d", "%s%n",
    "a\nb", "a\x1b]0;own\x07\x1b[31m", "\x9b31m", "a\rb", "\x7f", "\u202eabc", "größer", "x" * 240, "con", "*", "?",
    "[a]", "{a,b}", "~", "$HOME", "`id`",
    "a'b", 'a"b', "\\", "@x", "#x", "<script>mien_fuzz(1)</script>".replace("/", "∕"), "\udcff", "\u2028", "é",
    ".hidden", "capture.json",
)  # fmt: skip
"""Names of files without their ending. None has a slash."""


def faulty_place(path: Path, canary: Path, dice: Random) -> str:
    """Put something else where a file or folder is, and return the kind of fault."""
    kind = dice.choice(_KINDS)
    beside = [other for other in path.parent.iterdir() if other != path and other.is_dir() == path.is_dir()]
    if kind == "swapped" and beside:
        _swap(path, dice.choice(beside))
        return kind
    if kind == "copied" and beside:
        other = dice.choice(beside)
        _remove(path)
        (shutil.copytree if other.is_dir() else shutil.copy)(other, path)
        return kind
    if kind == "twice":
        copy = path.with_name(path.name.replace("0", "1", 1) if "0" in path.name else f"{path.name}2")
        if not copy.exists():
            (shutil.copytree if path.is_dir() else shutil.copy)(path, copy)
        return kind
    if kind == "moved out":
        # The original is outside now, with a link to it. Nothing may be changed there.
        outside = canary / f"moved{path.suffix}"
        _remove(outside)
        path.rename(outside)
        path.symlink_to(outside)
        return kind
    was_folder = path.is_dir()
    _remove(path)
    _MAKE[kind if kind in _MAKE else "missing"](path, canary, was_folder)
    return kind if kind in _MAKE else "missing"


def outside_of(canary: Path) -> None:
    """Fill the folder that links lead to and that nothing may be written into."""
    (canary / "folder").mkdir(parents=True)
    for name in (
        "victim.json",
        "victim.safetensors",
        "victim.png",
        "victim.u8",
        "victim",
        "folder/victim.txt",
        "folder/000000.png",
    ):
        (canary / name).write_bytes(b"precious " * 20)


def rename_oddly(path: Path, dice: Random, port: int) -> Path:
    """Give a file an odd name with its own ending."""
    name = f"{dice.choice(NAMES)}{path.suffix}".replace(PORT, str(port))
    renamed = path.with_name(name)
    path.rename(renamed)
    return renamed


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _swap(one: Path, other: Path) -> None:
    aside = one.with_name(".aside")
    one.rename(aside)
    other.rename(one)
    aside.rename(other)


def _socket(path: Path, canary: Path, was_folder: bool) -> None:
    # The path of a socket may have only a hundred characters, so it is made from within its folder.
    here = Path.cwd()
    os.chdir(path.parent)
    try:
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(path.name[:90])
    finally:
        os.chdir(here)


def _sparse(path: Path, canary: Path, was_folder: bool) -> None:
    with path.open("wb") as file:
        file.truncate(SPARSE)


def _victim(path: Path, canary: Path, was_folder: bool) -> None:
    path.symlink_to(canary / "folder" if was_folder else _like(canary, path))


def _beyond(path: Path, canary: Path, was_folder: bool) -> None:
    """Make a dangling link. A program that writes through it makes a new file outside."""
    path.symlink_to(canary / f"new{path.suffix}")


def _upwards(path: Path, canary: Path, was_folder: bool) -> None:
    path.symlink_to(os.path.relpath(_like(canary, path), path.parent))


def _like(canary: Path, path: Path) -> Path:
    alike = canary / f"victim{path.suffix}"
    return alike if alike.exists() else canary / "victim"


_MAKE = {
    "missing": lambda path, canary, was_folder: None,
    "empty": lambda path, canary, was_folder: path.mkdir() if was_folder else path.write_bytes(b""),
    "folder": lambda path, canary, was_folder: path.write_bytes(b"text") if was_folder else path.mkdir(),
    "full folder": lambda path, canary, was_folder: (path / "a" / "b").mkdir(parents=True),
    "pipe": lambda path, canary, was_folder: os.mkfifo(path),
    "socket": _socket,
    "link outside": _victim,
    "link upwards": _upwards,
    "link beyond": _beyond,
    "link to itself": lambda path, canary, was_folder: path.symlink_to(path.name),
    "endless": lambda path, canary, was_folder: path.symlink_to("/dev/zero"),
    "null": lambda path, canary, was_folder: path.symlink_to("/dev/null"),
    "sparse": _sparse,
    "text": lambda path, canary, was_folder: path.write_text(f"{{}} {DEEP}"),
}
_KINDS = (*_MAKE, "link outside", "link outside", "link beyond", "moved out", "moved out", "swapped", "copied", "twice")
