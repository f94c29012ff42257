"""Files on other machines by fsspec: inputs by their URLs, and workspaces that are copied in and out of a store."""

import hashlib
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mien.batch.plan import Batch, Row, State
from mien.batch.row import PROGRAM, attempt
from mien.errors import UserError


def is_url(word: str) -> bool:
    """Whether a word is the URL of a file, such as s3://bucket/clip.mp4, and not a path or an option."""
    scheme, mark, _ = word.partition("://")
    return bool(mark) and scheme.isascii() and scheme.isalnum()


def store_of(url: str) -> tuple[Any, str]:
    """The file system of a URL, and the path in it."""
    import fsspec  # pyright: ignore[reportMissingImports]

    try:
        return fsspec.url_to_fs(url)
    except (ImportError, ValueError) as error:
        why = " ".join(str(error).split())[:200]
        raise UserError(f"{url}: cannot be reached ({why}); `make batch-engines` installs s3fs for s3://") from None


def fetched(word: str, folder: Path) -> str:
    """The word, or the path of a copy in `folder` if it is a URL. A copy that is there is not fetched again."""
    if not is_url(word):
        return word
    target = folder / hashlib.sha256(word.encode()).hexdigest()[:16] / word.rstrip("/").rpartition("/")[2]
    if not target.exists():
        target.parent.mkdir(parents=True, exist_ok=True)
        aside = target.with_name(f".{target.name}")
        fs, path = store_of(word)
        fs.get(path, str(aside), recursive=True)
        aside.rename(target)
    return str(target)


def attempt_in_store(
    store: str, program: Sequence[str], threads: int | None, row: Row
) -> tuple[State | None, dict[str, bytes]]:
    """Run a row in a temporary folder of this machine, with its workspace copied in from a store and out to it.

    The store is the URL of the folder of all workspaces, such as s3://bucket/people. Returns the row's state, and its
    thumbnails and log: path in the batch's folder -> content.
    """
    fs, base = store_of(store)
    place = f"{base.rstrip('/')}/{row.name}"
    with tempfile.TemporaryDirectory(prefix="mien-batch-") as scratch:
        batch = Batch(Path(scratch))
        workspace = batch.workspace(row.name)
        if fs.exists(place):
            workspace.parent.mkdir(parents=True)
            fs.get(place, str(workspace), recursive=True)
        state = attempt(batch.root, row, program or PROGRAM, threads)
        if workspace.is_dir():
            fs.makedirs(place, exist_ok=True)
            fs.put(f"{workspace}/", f"{place}/", recursive=True)
            ours = {path.relative_to(workspace).as_posix() for path in workspace.rglob("*")}
            for gone in fs.find(place):
                if gone.removeprefix(f"{place}/") not in ours:
                    fs.rm_file(gone)
        kept = [*batch.root.glob("thumbs/*"), *batch.root.glob("logs/*")]
        return state, {path.relative_to(batch.root).as_posix(): path.read_bytes() for path in kept}
