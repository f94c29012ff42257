"""The one door for files: bounds on what is read, and paths that stay inside a folder that a stranger may have filled.

A workspace, a run, a capture or an avatar can come from somebody else, who chose every name in it. The path to the
folder that the user names may contain links. Below that folder, only ordinary files and folders are allowed. After
these checks, and after format, version and checksum (`mien.disk.files`), a reader of mien's own files trusts what mien
wrote, inside `expect_whole`.

Everything here is plain Python, because options and paths are checked before any heavy library is imported.
"""

import errno
import json
import math
import os
import shutil
import stat
import struct
import unicodedata
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, cast

from mien.errors import UserError
from mien.machine.system import BINARY, NO_LINK, NO_WAIT

MAX_SIDE = 8192
"""Largest width or height of a picture in pixels, of those that are read and of those that are rendered."""
_MAX_SHOWN = 40
"""Most characters of a name or number that a message shows."""
_COSTS = {"[": 64, "{": 232, ",": 40}
"""Bytes that Python takes for a list, an object, and a further entry with its number or text, about."""
_ARCHIVE_END_SIZE, _MAX_COMMENT_BYTES = 22, 65535
_OF_SYSTEMS = frozenset({"thumbs.db", "desktop.ini", "__macosx"})
_NOT_IN_NAMES = frozenset({"Cc", "Cs", "Zl", "Zp"})
"""Unicode categories: control characters, halves of surrogate pairs, line and paragraph separators."""
_STUMBLES = (
    LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RuntimeError, MemoryError, EOFError,
    struct.error,
)  # fmt: skip
"""What a reader that trusts a file raises if it is not as mien wrote it."""


class NotOrdinaryError(ValueError):
    """A path is not an ordinary file, but a folder, a pipe, a device or a socket, or a link that is not followed."""


@contextmanager
def expect_whole(path: Path, remedy: str) -> Iterator[None]:
    """Report whatever a reader stumbles over in the content of `path` as one sentence, with what the user can do."""
    try:
        yield
    except _STUMBLES as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise UserError(f"{path}: incomplete or damaged ({reason}); {remedy}") from None


def parse_json(text: str, *, unique_names: bool = False, any_size: bool = False, constants: bool = False) -> Any:
    """The content of a json text; a ValueError says what is wrong with it.

    With `unique_names`, an object that holds a name twice is refused, for texts that people write. Callers that check
    numbers themselves, and can name their place, allow `any_size`, or the `constants` NaN and infinity.
    """
    if sum(cost * text.count(sign) for sign, cost in _COSTS.items()) > 1 << 30:  # empty lists take 20 times their text
        raise ValueError("it holds too many lists, objects or numbers")
    hooks: dict[str, Any] = {} if any_size else {"parse_int": _whole_number, "parse_float": _finite_number}
    if not constants:
        hooks["parse_constant"] = _refuse_constant
    if unique_names:
        hooks["object_pairs_hook"] = _object_of_unique_names
    try:
        content = json.loads(text, **hooks)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    level: list[Any] = [[content]]
    for _ in range(51):  # Python's own limit is reached only later, when the content is shown or compared
        inner = [child for node in level for child in (node.values() if isinstance(node, dict) else node)]
        level = [child for child in inner if isinstance(child, (dict, list))]
        if not level:
            return content
    raise ValueError(_TOO_DEEP)


_TOO_DEEP = "its lists or objects are nested too deep"


def _refuse_constant(name: str) -> float:
    raise ValueError(f"it holds the number {name}")


def _object_of_unique_names(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        seen: set[str] = set()
        twice = next(name for name, _ in pairs if name in seen or seen.add(name))
        raise ValueError(f"it holds {twice[:_MAX_SHOWN]!r} twice")
    return content


def _whole_number(digits: str) -> int:
    # Python takes long to parse very many digits, and float() and numpy refuse numbers that do not fit.
    if len(digits) > 20 or not -(1 << 63) <= (number := int(digits)) < 1 << 64:
        raise ValueError(f"it holds a number of {len(digits.lstrip('-'))} digits")
    return number


def _finite_number(digits: str) -> float:
    number = float(digits)
    if not math.isfinite(number):
        raise ValueError(f"it holds the number {digits[:_MAX_SHOWN]}")
    return number


def read_bytes(path: Path | str, most: int) -> bytes:
    """The bytes of an ordinary file, which may be reached through a link. A ValueError says that it has too many."""
    with open_ordinary(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise ValueError(f"it has {size:,} bytes, and at most {most:,} are read")
        return file.read(size)  # not to its end, because the file may grow meanwhile


def open_ordinary(path: Path | str) -> IO[bytes]:
    """Open an ordinary file for reading. The path may be a link, since it is the user who names it."""
    return os.fdopen(open_handle(path, os.O_RDONLY, follow_link=True), "rb")


def open_archive(file: IO[bytes]) -> zipfile.ZipFile:
    """Open a zip archive whose list of members is of moderate size. Its members are checked by `open_member`."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - _MAX_COMMENT_BYTES - _ARCHIVE_END_SIZE))
    tail = file.read()
    place = tail.rfind(b"PK\x05\x06")
    if place < 0 or len(tail) < place + _ARCHIVE_END_SIZE:
        raise ValueError("its end is missing: copy it again")
    directory = int.from_bytes(tail[place + 12 : place + 16], "little")
    # Each member takes about 50 bytes. The mark is that of archives of 4 GB, or with more than 65,534 members.
    if directory > 1 << 20 or tail[max(0, place - 20) : place].startswith(b"PK\x06\x07"):
        raise ValueError("it has far more members than such a file")
    return zipfile.ZipFile(file)


def open_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> zipfile.ZipExtFile:
    """Open a member of an archive for reading, if it is neither encrypted nor compressed as Python may not know."""
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError("is compressed in an unusual way")
    try:
        return cast(zipfile.ZipExtFile, archive.open(member))
    except (RuntimeError, NotImplementedError) as error:
        raise ValueError(f"cannot be unpacked ({str(error)[:_MAX_SHOWN]})") from None


def open_handle(path: Path | str, flags: int, *, follow_link: bool) -> int:
    """The descriptor of an ordinary file, opened with flags of open(2). `follow_link`: whether the path may be a link.

    Opening never waits, not even for a process that writes into a pipe.
    """
    try:
        handle = os.open(path, flags | NO_WAIT | BINARY | (0 if follow_link else NO_LINK), 0o666)
    except OSError as error:
        # EISDIR: a folder that is opened to be written; ENXIO: a socket, or a pipe that nobody reads.
        if error.errno in (errno.EISDIR, errno.ENXIO) or (error.errno == errno.ELOOP and not follow_link):
            raise NotOrdinaryError("it is not an ordinary file") from None
        raise
    linked = not follow_link and not NO_LINK and Path(path).is_symlink()
    if linked or not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise NotOrdinaryError("it is not an ordinary file")
    return handle


def is_one_line(text: object) -> bool:
    """Whether it is a text without control characters and line breaks, which is safe to show."""
    if not isinstance(text, str):
        return False
    plain = text.isascii() and text.isprintable()  # says the same much faster
    return plain or not any(unicodedata.category(letter) in _NOT_IN_NAMES for letter in text)


def is_plain_name(name: object) -> bool:
    """Whether it is a name that a file or folder can have, and that does not lead to another folder."""
    if not (isinstance(name, str) and is_one_line(name)):
        return False
    return name not in ("", ".", "..") and not set(name) & {"/", "\\"} and len(name.encode()) <= 255


def inside(folder: Path, name: object) -> Path:
    """The path of `name` in a folder."""
    if not is_plain_name(name):
        raise UserError(f"{folder}: {name!r:.100} cannot be the name of a file or folder in it; give a plain name")
    return folder / str(name)


def check_unlinked(path: Path) -> None:
    """Check that a path, which may be missing, is not a link."""
    if path.is_symlink():
        raise UserError(_refusal(path, True))


def check_tree(folder: Path) -> None:
    """Check that only files and folders are below a folder. The folder itself may be a link, or missing."""
    for entry in _entries(folder):
        if not entry.is_file(follow_symlinks=False):
            raise UserError(_refusal(Path(entry.path), entry.is_symlink()))


def check_subtrees(folder: Path, *names: str) -> None:
    """Run `check_tree` on some entries of a folder. The entries may be missing, but must not be links themselves."""
    for name in names:
        path = folder / name
        if path.is_symlink() or (path.exists() and not path.is_dir()):
            raise UserError(_refusal(path, path.is_symlink()))
        check_tree(path)


def listed(folder: Path, pattern: str = "*") -> list[Path]:
    """Return what matches a pattern in a folder of a user, in the order of names, without what systems leave there.

    Names that begin with a dot are left out (macOS has `._clip.mp4` beside `clip.mp4`), and those of `_OF_SYSTEMS`.
    """
    found = ((path, path.relative_to(folder).parts) for path in folder.glob(pattern))
    return sorted(
        path for path, names in found if not any(n.startswith(".") or n.lower() in _OF_SYSTEMS for n in names)
    )


def open_to_read(path: Path) -> IO[bytes]:
    """Open a file inside the folder for reading. An OSError says that it is missing or cannot be read."""
    return os.fdopen(_open(path, os.O_RDONLY, alone=False), "rb")


def open_to_change(path: Path) -> int:
    """The descriptor of a file inside the folder, opened to change its content. A missing file is created.

    Nothing is ever written through a link, or through a second name of a file outside.
    """
    return _open(path, os.O_RDWR | os.O_CREAT, alone=True)


def open_to_append(path: Path) -> IO[str]:
    """Open a text file inside the folder to append to it, with the checks of `open_to_change`."""
    return os.fdopen(_open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, alone=True), "a", encoding="utf-8")


def open_new(path: Path) -> IO[bytes]:
    """Create a new, empty file in place of an existing file or link. The target of a link stays as it is.

    The process's umask decides who may read and write it.
    """
    path.unlink(missing_ok=True)
    return os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | NO_LINK | BINARY, 0o666), "w+b")


def remove_tree(path: Path) -> None:
    """Remove a folder with everything in it, or a file or link, but never the target of a link. It may be missing."""
    if path.is_symlink() or not path.is_dir():
        path.unlink(missing_ok=True)
    else:
        shutil.rmtree(path, ignore_errors=True)


def drop_if_shared(path: Path) -> None:
    """Remove a link, or a file with a second name, so that a write in place cannot change what is elsewhere."""
    if path.is_symlink() or (path.exists() and not path.is_dir() and path.stat().st_nlink != 1):
        path.unlink()


def has_other_names(folder: Path) -> bool:
    """Whether a file below has a second name, so that writing in place would change another folder."""
    return any(entry.stat(follow_symlinks=False).st_nlink != 1 for entry in _entries(folder))


def _entries(folder: Path) -> Iterator[os.DirEntry[str]]:
    """Everything below a folder except folders. Links are not followed."""
    pending = [str(folder)]
    while pending:
        try:
            with os.scandir(pending.pop()) as entries:
                for entry in entries:
                    if entry.is_dir(follow_symlinks=False):
                        pending.append(entry.path)
                    else:
                        yield entry
        except (FileNotFoundError, NotADirectoryError):
            continue
        except OSError as error:
            raise UserError(
                f"{folder}: cannot be searched ({error.strerror}); check its folders and their permissions"
            ) from None


def _open(path: Path, flags: int, *, alone: bool) -> int:
    """The descriptor of a file. With `alone`, the file must have no second name."""
    try:
        handle = open_handle(path, flags, follow_link=False)
    except NotOrdinaryError:
        raise UserError(_refusal(path, path.is_symlink())) from None
    if alone and os.fstat(handle).st_nlink != 1:
        os.close(handle)
        raise UserError(f"{path}: the same file has another name elsewhere; delete it here, or copy its folder")
    return handle


def _refusal(path: Path, link: bool) -> str:
    if link:
        return (
            f"{path}: is a link, and links inside a workspace are not followed, because they may lead anywhere; "
            "replace it by what it leads to, or move the whole workspace and link to that"
        )
    return f"{path}: is not an ordinary file or folder, and a workspace may hold nothing else; delete it"
