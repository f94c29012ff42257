"""Paths inside a folder that a stranger may have filled: names that stay in it, and nothing in it that leads out.

A workspace, a run, a capture or an avatar can come from somebody else, who chose every name in it. The folder that the
user names may be reached through links. Below it there are only files and folders: `check_tree` refuses links, pipes
and devices before anything is read or written there. What is written in place is opened here as well, so that a link
or a second name of a file outside is never written through.
"""

import os
import shutil
import stat
import unicodedata
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from mien.errors import UserError

_MOST_BYTES_OF_NAME = 255
_NOT_IN_NAMES = frozenset({"Cc", "Cs", "Zl", "Zp"})
"""Categories of characters: control characters, halves of surrogates, ends of lines and paragraphs."""
_NO_FOLLOW = getattr(os, "O_NOFOLLOW", 0)
_NO_WAIT = getattr(os, "O_NONBLOCK", 0)
"""Without it, opening a pipe waits for who writes into it."""


def is_one_line(text: object) -> bool:
    """Whether it is a text without control characters and ends of lines, safe to show."""
    return isinstance(text, str) and not any(unicodedata.category(letter) in _NOT_IN_NAMES for letter in text)


def is_plain_name(name: object) -> bool:
    """Whether it can be the name of one file or folder and leads nowhere else."""
    if not (isinstance(name, str) and is_one_line(name)):
        return False
    return name not in ("", ".", "..") and not set(name) & {"/", "\\"} and len(name.encode()) <= _MOST_BYTES_OF_NAME


def inside(folder: Path, name: object) -> Path:
    """The path of `name` in a folder.

    Raises:
        UserError: `name` is no plain name, so it may lead out of the folder.
    """
    if not is_plain_name(name):
        raise UserError(f"{folder}: {name!r:.100} cannot be the name of a file or folder in it; give a plain name")
    return folder / str(name)


def check_tree(folder: Path) -> None:
    """Find that below a folder there are only files and folders. The folder itself may be a link, or missing.

    Raises:
        UserError: something below is a link, a pipe, a device or a socket, or cannot be looked at.
    """
    for entry in _entries(folder):
        if not entry.is_file(follow_symlinks=False):
            raise UserError(_refusal(Path(entry.path), entry.is_symlink()))


def check_subtrees(folder: Path, *names: str) -> None:
    """`check_tree` of some entries of a folder, which must not be links themselves; they may be missing.

    Raises:
        UserError: one of them, or something below, is no file or folder.
    """
    for name in names:
        path = folder / name
        if path.is_symlink() or (path.exists() and not path.is_dir()):
            raise UserError(_refusal(path, path.is_symlink()))
        check_tree(path)


def open_to_read(path: Path) -> IO[bytes]:
    """A file inside, open for reading.

    Raises:
        UserError: it is a link, a folder, a pipe or a device.
        OSError: it is missing or cannot be read.
    """
    return os.fdopen(_opened(path, os.O_RDONLY, alone=False), "rb")


def open_to_change(path: Path) -> int:
    """The descriptor of a file inside whose content is kept and changed; it is made where it is missing.

    Raises:
        UserError: it is a link, no file, or has a second name, which may lie outside.
        OSError: it cannot be written.
    """
    return _opened(path, os.O_RDWR | os.O_CREAT, alone=True)


def open_to_append(path: Path) -> IO[str]:
    """A text file inside, open at its end.

    Raises:
        UserError: as `open_to_change`.
        OSError: it cannot be written.
    """
    return os.fdopen(_opened(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, alone=True), "a", encoding="utf-8")


def open_new(path: Path) -> IO[bytes]:
    """A new, empty file in the place of whatever file or link is there; what a link leads to stays as it is.

    Raises:
        OSError: it cannot be written.
    """
    path.unlink(missing_ok=True)
    return os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | _NO_FOLLOW, 0o644), "w+b")


def remove_tree(path: Path) -> None:
    """Remove a folder with all that is in it, or a file or link; never what a link leads to. Missing is fine."""
    if path.is_symlink() or not path.is_dir():
        path.unlink(missing_ok=True)
    else:
        shutil.rmtree(path, ignore_errors=True)


def drop_if_shared(path: Path) -> None:
    """Make room where a link lies, or a file that also lies elsewhere: what else is there may be written in place.

    Raises:
        OSError: it cannot be removed.
    """
    if path.is_symlink() or (path.exists() and not path.is_dir() and path.stat().st_nlink != 1):
        path.unlink()


def has_other_names(folder: Path) -> bool:
    """Whether a file below has a second name, through which writing in place would reach another folder."""
    return any(entry.stat(follow_symlinks=False).st_nlink != 1 for entry in _entries(folder))


def _entries(folder: Path) -> Iterator[os.DirEntry[str]]:
    """All below a folder that are no folders themselves; no link is followed."""
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
            raise UserError(f"{folder}: cannot be looked through ({error.strerror}); check what is in it") from None


def _opened(path: Path, flags: int, *, alone: bool) -> int:
    if path.is_symlink():
        raise UserError(_refusal(path, link=True))
    file = os.open(path, flags | _NO_FOLLOW | _NO_WAIT, 0o644)
    status = os.fstat(file)
    if stat.S_ISREG(status.st_mode) and (status.st_nlink == 1 or not alone):
        return file
    os.close(file)
    if stat.S_ISREG(status.st_mode):
        raise UserError(f"{path}: the same file also lies elsewhere; delete it here, or copy its folder")
    raise UserError(_refusal(path, link=False))


def _refusal(path: Path, link: bool) -> str:
    if link:
        return (
            f"{path}: a link, which is not followed inside a workspace: it may lead anywhere; put what it leads to in "
            "its place, or move the whole workspace and link to that"
        )
    return f"{path}: no ordinary file or folder, as everything inside a workspace has to be; delete it"
