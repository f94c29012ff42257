"""Odd places give the same bytes: other numbers of threads, one core, the C locale, no home, umlauts in every name."""

import hashlib
import os
import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path

import pytest

import mien
import work_anywhere
from capture_helpers import write_face_clip
from needs import find_test_data

OF_PLACES = ("LANG", "LC_ALL", "LC_CTYPE", "PYTHONUTF8", "PYTHONIOENCODING", "HOME", "XDG_CACHE_HOME", "MIEN_THREADS")
ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
ODD = {"MIEN_THREADS": "64", "ONE_CORE": "1", "HOME": "/proc/nowhere", **ASCII}
"""More threads than cores, one core, no home, and a locale without umlauts."""


def run_python(arguments: list[str], environment: dict[str, str], folder: Path | None = None) -> str:
    """Run Python without this process's locale, home and threads, and return its output."""
    kept = {name: value for name, value in os.environ.items() if name not in OF_PLACES}
    done = subprocess.run(
        [sys.executable, *arguments], cwd=folder, env={**kept, **environment}, capture_output=True, check=False
    )
    assert done.returncode == 0, done.stderr.decode()
    return done.stdout.decode()


def hashes(place: Path) -> dict[str, str]:
    """Return digests of the files that are the same everywhere. Curves hold times, so they are left out."""
    files = [path for kind in ("*.png", "*.safetensors") for path in place.rglob(kind)]
    return {
        str(path.relative_to(place)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(files)
        if path.parent.name != "checkpoints" and path.stem != "curves"
    }


@pytest.fixture(scope="module")
def face_clip(tmp_path_factory: pytest.TempPathFactory) -> Path | None:
    test_data = find_test_data()
    if test_data is None:
        return None
    path = tmp_path_factory.mktemp("clip") / "Frau Müller.mp4"
    write_face_clip(path, test_data, frames=3)
    return path


@pytest.fixture(scope="module")
def plain(face_clip: Path | None, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("plain")
    work_anywhere.work(folder, face_clip)
    found = hashes(folder)
    assert "toy/runs/toy/avatar/avatar.safetensors" in found
    return found


@pytest.mark.unchecked
def test_the_same_bytes_in_odd_places(plain: dict[str, str], face_clip: Path | None, tmp_path: Path) -> None:
    place = tmp_path / "Köpfe & Gemälde" / "a place"
    place.mkdir(parents=True)
    arguments = [work_anywhere.__file__, str(place), *([] if face_clip is None else [str(face_clip)])]
    assert "working in" in run_python(arguments, ODD, place)
    # If names are not UTF-8, a sequence's name gets "_" for what the locale lacks. Its content is the same.
    found = {name.replace("Frau M__ller", "Frau Müller"): digest for name, digest in hashes(place).items()}
    assert found == plain


def test_the_environment_starts_in_any_locale() -> None:
    # An absolute path with an umlaut in a .pth file would stop it under LC_ALL=C.
    for path in Path(str(distribution("mien").locate_file(""))).glob("*mien*.pth"):
        assert path.read_bytes().isascii(), f"{path}: run `make setup`"
    assert run_python(["-c", "import mien; print(mien.__version__)"], {"LC_ALL": "C"}).strip() == mien.__version__


def test_help_and_names_are_printed_in_any_locale(tmp_path: Path) -> None:
    """Help and names are printed in any locale. Help has characters that ASCII lacks, and names need not be UTF-8."""
    help_of_all = "from mien.cli import main; main(['bench', '--help-all'])"
    assert "mien bench" in run_python(["-c", help_of_all], ASCII)
    odd = "from mien import cli; cli.GROUPS['\\udcff \\u2022'] = (); cli.main([])"
    assert "\\xff \u2022:" in run_python(["-c", odd], {"LC_ALL": "C.UTF-8"})
