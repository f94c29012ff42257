"""Safe paths inside a folder that a stranger may have filled: names stay in the folder, and nothing leads out of it.

A workspace, a run, a capture or an avatar can come from somebody else, who chose every name in it. The path to the
folder that the user names may contain links. Below that folder, only ordinary files and folders are allowed.
"""

import os
import shutil
import unicodedata
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from mien.disk.reading import NotOrdinaryError, open_handle
from mien.errors import UserError
from mien.machine.system import BINARY, NO_LINK

_OF_SYSTEMS = frozenset({"thumbs.db", "desktop.ini", "__macosx"})
_NOT_IN_NAMES = frozenset({"Cc", "Cs", "Zl", "Zp"})
"""Unicode categories: control characters, halves of surrogate pairs, line and paragraph separators."""


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
