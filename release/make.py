"""Makes a release in one command: sdist, wheels, npm package, documentation, checksums and the release page.

`make release` calls it. Every file gets the time of the commit, so that the same commit gives the same bytes. Two
checkouts in two folders gave the same sdist, wheels for Python 3.11 and 3.12 (of this machine), npm package, site and
page (7883219a, and d0a88274). A wheel that others can install comes from cibuildwheel, which needs Docker or Podman;
without them, the wheels are those of this machine's Pythons, and the page says so.
"""

import argparse
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MOST_SDIST_BYTES = 5_000_000
"""Largest sdist. MediaPipe's networks of the litert detector take 2.9 MB of it, the landmarks' calibration 0.2 MB, and
text 1.5 MB. The network for blend shapes, 0.8 MB, is left out: only pages with a webcam need it, and they also need
MediaPipe's code, which is not in the sdist either."""
PARTS = ("sdist", "wheels", "npm", "docs")


class ReleaseError(Exception):
    """Something that the person who releases can correct."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the parts that were asked for, then checksums and the page. Returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="an empty or new folder")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--python", nargs="+", default=[sys.executable], help="interpreters of the wheels")
    parser.add_argument("--dirty", action="store_true", help="release changes that are not committed, for a trial")
    options = parser.parse_args(arguments)
    try:
        make(options.out.resolve(), options.parts, options.python, options.dirty)
    except (ReleaseError, subprocess.CalledProcessError) as error:
        print(f"release: {error}", file=sys.stderr)
        return 2
    return 0


def make(out: Path, parts: Sequence[str], pythons: Sequence[str], dirty: bool) -> None:
    """Make the release in a folder that is empty or missing.

    Raises:
        ReleaseError: the checkout has changes, the folder holds files, a part is too large, or CHANGELOG lacks the
            version.
    """
    if out.exists() and any(out.iterdir()):
        raise ReleaseError(f"{out}: is not empty; empty it, or choose another folder with --out")
    if not dirty and told("git", "status", "--porcelain"):
        raise ReleaseError("there are changes that are not committed; commit them, or try with --dirty")
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    notes = section(ROOT / "CHANGELOG.md", version)
    epoch = int(told("git", "log", "-1", "--format=%ct"))
    os.environ |= {"SOURCE_DATE_EPOCH": str(epoch), "PYTHONHASHSEED": "0", "LC_ALL": "C.UTF-8", "TZ": "UTC"}
    out.mkdir(parents=True, exist_ok=True)
    makers: dict[str, Callable[[], None]] = {
        "sdist": lambda: make_sdist(out),
        "wheels": lambda: make_wheels(out, pythons),
        "npm": lambda: make_npm(out),
        "docs": lambda: make_docs(out, version, epoch),
    }
    for part in parts:
        print(f"release: {part} ...", flush=True)
        makers[part]()
    write_page(out, version, notes)


def make_sdist(out: Path) -> None:
    """The source distribution, without tests, history and pictures, and without MediaPipe's code for pages.

    That code, 2.7 MB, lies in the checkout for the wheels (`make landmarker`). So the sdist is built elsewhere.
    """
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "source"
        copy_tracked(source)
        run("uv", "build", "--sdist", "--out-dir", str(out), str(source))
    for path in out.glob("*.tar.gz"):
        if path.stat().st_size > MOST_SDIST_BYTES:
            raise ReleaseError(f"{path.name}: has more than {MOST_SDIST_BYTES:,} bytes; leave data out of it")
    (out / ".gitignore").unlink(missing_ok=True)


def copy_tracked(folder: Path) -> None:
    """Copy the files that git tracks into a new folder, as the checkout has them.

    It only reads, because the index may be locked by another git. Modes are 644 or 755, whatever the umask was.
    """
    for name in filter(None, told("git", "ls-files", "-z").split("\0")):
        source, target = ROOT / name, folder / name
        if not source.is_file():
            continue  # Deleted since the last commit, which `--dirty` allows.
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, target)
        target.chmod(0o755 if source.stat().st_mode & 0o100 else 0o644)


def make_wheels(out: Path, pythons: Sequence[str]) -> None:
    """Wheels for many machines by cibuildwheel, or for this machine alone."""
    if has_containers():
        run("uv", "tool", "run", "cibuildwheel", "--output-dir", str(out), str(ROOT))
        return
    for python in pythons:
        run("uv", "build", "--wheel", "--python", python, "--out-dir", str(out), str(ROOT))
    (out / ".gitignore").unlink(missing_ok=True)


def has_containers() -> bool:
    """Say whether Docker or Podman answers. Docker's command is often installed where its service does not run."""
    engines = filter(shutil.which, ("docker", "podman"))
    return any(subprocess.run([engine, "info"], capture_output=True, check=False).returncode == 0 for engine in engines)


def make_npm(out: Path) -> None:
    """The package of the web runtime."""
    run("npm", "ci", "--prefix", "web", "--ignore-scripts", "--no-audit", "--no-fund")
    run("npm", "run", "build", "--prefix", "web")
    run("npm", "pack", "./web", "--pack-destination", str(out))


def make_docs(out: Path, version: str, epoch: int) -> None:
    """The site of the documentation, as an archive."""
    site = ROOT / "build" / "release-docs"
    shutil.rmtree(site, ignore_errors=True)
    run(sys.executable, "docs/site/build.py", "--out", str(site))
    shutil.rmtree(site / ".doctrees", ignore_errors=True)
    pack(site, out / f"mien-{version}-docs.tar.xz", epoch)


def pack(folder: Path, archive: Path, epoch: int) -> None:
    """An archive of a folder whose bytes depend on names and contents alone."""

    def plain(member: tarfile.TarInfo) -> tarfile.TarInfo:
        member.mtime, member.uid, member.gid, member.uname, member.gname = epoch, 0, 0, "", ""
        member.mode = 0o755 if member.isdir() else 0o644
        return member

    with tarfile.open(archive, "w:xz") as tar:
        for path in sorted(folder.rglob("*")):
            tar.add(path, path.relative_to(folder).as_posix(), recursive=False, filter=plain)


def section(changelog: Path, version: str) -> str:
    """Return the section of CHANGELOG about a version.

    Raises:
        ReleaseError: it says nothing.
    """
    text = changelog.read_text(encoding="utf-8")
    found = re.search(rf"^## {re.escape(version)}\b.*?\n(.*?)(?=^## |\Z)", text, re.MULTILINE | re.DOTALL)
    if found is None or not found.group(1).strip():
        raise ReleaseError(f"{changelog.name}: has no section '## {version}'; write it")
    return found.group(1).strip()


def write_page(out: Path, version: str, notes: str) -> None:
    """SHA256SUMS, and the release page: the notes, then every file with its size and sum."""
    files = sorted(path for path in out.iterdir() if path.is_file())
    sums = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
    (out / "SHA256SUMS").write_text("".join(f"{digest}  {name}\n" for name, digest in sums.items()), encoding="utf-8")
    rows = "".join(f"| {path.name} | {path.stat().st_size / 1e6:.2f} MB | `{sums[path.name]}` |\n" for path in files)
    local = [name for name in sums if re.search(r"-(linux_\w+)\.whl$", name)]
    note = f"\nOnly for machines like the one that built them: {', '.join(local)}.\n" if local else ""
    page = f"# mien {version}\n\n{notes}\n\n## Files\n\n| file | size | SHA-256 |\n|---|---|---|\n{rows}{note}"
    (out / "RELEASE.md").write_text(page, encoding="utf-8")
    print(f"release: {out}: {len(files)} files")


def run(*words: str) -> None:
    """Run a command in the root of the checkout. It fails with the command."""
    if shutil.which(words[0]) is None:
        raise ReleaseError(f"{words[0]}: is not on the PATH; install it")
    subprocess.run(words, cwd=ROOT, check=True)


def told(*words: str) -> str:
    """Return the output of a command."""
    return subprocess.run(words, cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()


if __name__ == "__main__":
    sys.exit(main())
