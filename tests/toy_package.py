"""Follow a recipe of CONTRIBUTING.md, and install what it makes as a package that other people wrote."""

import re
import subprocess
from pathlib import Path

from forked import ForkServer, run_forked

_PAGE = Path(__file__).parents[1] / "CONTRIBUTING.md"


def blocks(recipe: str, language: str) -> list[str]:
    section = _PAGE.read_text(encoding="utf-8").split(f"\n## {recipe}\n")[1].split("\n## ")[0]
    return re.findall(rf"^```{language}\n(.*?)^```", section, flags=re.MULTILINE | re.DOTALL)


def entry_points(recipe: str) -> str:
    """Return a recipe's lines of pyproject.toml, as pip puts them into entry_points.txt."""
    (lines,) = blocks(recipe, "toml")
    return re.sub(r'project\.entry-points\."([^"]*)"', r"\1", lines).replace('"', "")


def install(folder: Path, module: str, code: str, points: str) -> None:
    """Put a package into a folder as pip does: its code, and the metadata that names its entry points."""
    (folder / f"{module}.py").write_text(code)
    about = folder / f"{module}-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module.replace('_', '-')}\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(points)


def mien(server: ForkServer, folder: Path, *words: str, **environment: str) -> "subprocess.CompletedProcess[str]":
    """Run a command where the packages of a folder are installed."""
    return run_forked(server, *words, path=[folder], env=environment)


def help_of(server: ForkServer, folder: Path, command: str) -> str:
    """Return a command's help, with single spaces and without frames, where the packages of a folder are installed."""
    return " ".join(mien(server, folder, command, "--help").stdout.replace("\u2502", " ").split())
