"""Files on other machines by fsspec: inputs, and stores of workspaces, by their URLs."""

import hashlib
from pathlib import Path
from typing import Any

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
