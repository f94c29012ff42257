"""The mutations of cases.toml, and copies of the project in which they are tried. The checkout is never changed."""

import os
import shutil
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

from mien import _native

ROOT = Path(__file__).parents[2]
_SITE = '''"""Imports mien from this copy: without the finder of the editable install."""
import sys
sys.meta_path[:] = [finder for finder in sys.meta_path if "ScikitBuild" not in type(finder).__name__]
'''
_LIMIT_SECONDS = 900
"""Time for the tests of one mutation. A mutation that makes them run longer is caught."""
_LEFT_OUT = "not committed and not fresh"
"""Tests that compare committed builds with the sources: they would catch every mutation of web/, whatever it does."""
_NO_TESTS, _USAGE, _INTERRUPTED = 5, 4, 2
"""Exit codes of pytest if no test was found, the call is wrong, or a file of tests cannot be imported."""


class MutationError(Exception):
    """A mutation that cannot be tried: its text is not in the file once, or its tests fail without it."""


@dataclass(frozen=True)
class Case:
    """One mutation."""

    file: str
    """Path in the project."""
    old: str
    """The text, which is in the file exactly once."""
    new: str
    """The text that takes its place."""
    tests: list[str]
    """Files of tests that should catch it, without folder and ending."""


def read_cases() -> list[Case]:
    content = tomllib.loads(Path(__file__).with_name("cases.toml").read_text(encoding="utf-8"))
    return [Case(**entry) for entry in content["case"]]


@dataclass(frozen=True)
class Verdict:
    """What became of a mutation."""

    case: Case
    caught: bool
    by: str
    """The first test that failed, or why the code did not run; empty if the mutation survives."""


class Workshop:
    """A copy of the project that takes one mutation at a time."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.built = False
        folder.mkdir(parents=True)
        listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
        for name in listed.decode().split("\0"):
            if name and (ROOT / name).is_file():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, folder / name)
        (folder / "site").mkdir()
        (folder / "site" / "sitecustomize.py").write_text(_SITE)
        if (ROOT / "web" / "node_modules").is_dir():
            (folder / "web" / "node_modules").symlink_to(ROOT / "web" / "node_modules")
        self.native = folder / "src" / "mien" / Path(_native.__file__).name
        shutil.copy2(_native.__file__, self.native)

    def attempt(self, case: Case) -> Verdict:
        """Mutate one file, run the tests of the case, and put the file back.

        Raises:
            MutationError: the text is not in the file exactly once, or a test fails without the mutation."""
        path = self.folder / case.file
        sound = path.read_text(encoding="utf-8")
        if sound.count(case.old) != 1:
            raise MutationError(f"{case.file}: has {case.old!r} {sound.count(case.old)} times, not once")
        is_native = case.file.startswith("native/")
        path.write_text(sound.replace(case.old, case.new), encoding="utf-8")
        try:
            if is_native:
                self._build()
            code, by = self._test(case)
        finally:
            path.write_text(sound, encoding="utf-8")
            if is_native:
                self._build()
        if code in (_NO_TESTS, _USAGE, _INTERRUPTED):
            raise MutationError(f"{case.file}: its tests {' '.join(case.tests)} cannot be run: {by}")
        return Verdict(case, code != 0, by)

    def _test(self, case: Case) -> tuple[int, str]:
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "--no-header", "-k", _LEFT_OUT]
        paths = (str(self.folder / "site"), str(self.folder / "src"))
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "MIEN_THREADS": "1"}
        environment.setdefault("MIEN_TEST_DATA", str(ROOT.parent / "shared" / "data"))
        tests = [f"tests/{name}.py" for name in case.tests]
        run = {"cwd": self.folder, "env": environment, "timeout": _LIMIT_SECONDS}
        try:
            done = subprocess.run([*command, *tests], capture_output=True, text=True, check=False, **run)
        except subprocess.TimeoutExpired:
            return 1, "takes too long"
        failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
        return done.returncode, failed[0] if failed else done.stdout[-200:] if done.returncode else ""

    def _build(self) -> None:
        """Build the native core of the copy."""
        build, tools = self.folder / "build", Path(sys.executable).parent
        if not self.built:
            found = [sys.executable, "-m", "nanobind", "--cmake_dir"]
            nanobind = subprocess.run(found, capture_output=True, text=True, check=True).stdout.strip()
            configure = [str(tools / "cmake"), "-S", str(self.folder), "-B", str(build), "-G", "Ninja"]
            configure += [f"-DCMAKE_MAKE_PROGRAM={tools / 'ninja'}", f"-DPython_EXECUTABLE={sys.executable}"]
            configure += ["-DCMAKE_BUILD_TYPE=Release", f"-Dnanobind_DIR={nanobind}"]
            subprocess.run(configure, capture_output=True, check=True)
            self.built = True
        done = subprocess.run([str(tools / "ninja"), "-C", str(build)], capture_output=True, text=True, check=False)
        if done.returncode:
            raise MutationError(f"the native core does not build: {done.stdout[-500:]}")
        shutil.copy2(build / "native" / self.native.name, self.native)
