"""A stranger adds a format from a package: the steps of CONTRIBUTING.md, "Add a format", to the letter."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from mien.formats import Format, formats
from mien.plugins import plugins
from toy_workspace import write_toy_workspace

PAGE = Path(__file__).parents[1] / "CONTRIBUTING.md"


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("place") / "W"
    write_toy_workspace(folder)
    return folder


def install(folder: Path, code: str, entry_points: str) -> None:
    """Put a package into a folder as pip does: its code, and the metadata that names its entry points."""
    (folder / "mien_xyz.py").write_text(code)
    about = folder / "mien_xyz-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: mien-xyz\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(entry_points)


def follow(folder: Path) -> None:
    section = PAGE.read_text(encoding="utf-8").split("\n## Add a format\n")[1].split("\n## ")[0]
    (code,) = re.findall(r"^```python\n(.*?)^```", section, flags=re.MULTILINE | re.DOTALL)
    (lines,) = re.findall(r"^```toml\n(.*?)^```", section, flags=re.MULTILINE | re.DOTALL)
    group = re.sub(r'project\.entry-points\."([^"]*)"', r"\1", lines).replace('"', "")
    install(folder, code, group)


def mien(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    return subprocess.run([sys.executable, "-m", "mien.cli", *words], env=environment, capture_output=True, text=True)


def test_its_files_are_written_from_runs_motions_and_files(workspace: Path, tmp_path: Path) -> None:
    follow(tmp_path)
    for words in (
        (str(workspace), "--out", str(tmp_path / "me.xyz")),
        (str(workspace), "--out", str(tmp_path / "me.mien")),
        (str(workspace), "--out", str(tmp_path / "talk.xyz"), "--series", "clip"),
    ):
        done = mien(tmp_path, "export", *words)
        assert done.returncode == 0, done.stderr
    assert mien(tmp_path, "export", str(tmp_path / "me.mien"), "--out", str(tmp_path / "again.xyz")).returncode == 0
    lines = (tmp_path / "me.xyz").read_text().splitlines()
    assert len(lines) == 400
    assert (tmp_path / "again.xyz").read_text().splitlines() == lines
    assert len(list(tmp_path.glob("talk_*.xyz"))) == 5
    refused = mien(tmp_path, "export", str(workspace), "--out", str(tmp_path / "a.xyz"), "--sh", "3")
    assert (refused.returncode, "only a .ply has a degree" in refused.stderr) == (2, True)
    unknown = mien(tmp_path, "export", str(workspace), "--out", str(tmp_path / "a.abc"))
    assert ".usdz or .xyz" in unknown.stderr


@pytest.mark.parametrize(
    ("code", "line", "told"),
    [
        ("XYZ = 1 / 0", "xyz = mien_xyz:XYZ", "mien-xyz adds it to mien.formats; it fails (ZeroDivisionError"),
        ("XYZ = 1", "xyz = mien_xyz:XYZ", "and it is no Format; update or uninstall mien-xyz"),
        (
            "from mien.formats import PLY_LIKE as XYZ",
            "xyz = mien_xyz:XYZ",
            "mien-xyz adds it to mien.formats; it fails (ImportError",
        ),
        (
            "from mien.formats.format import Format\nXYZ = Format('xyz', 'pose', print, ('.ply',))",
            "xyz = mien_xyz:XYZ",
            "the format 'xyz': .ply is taken by another format",
        ),
    ],
)
def test_a_package_that_is_wrong_is_named(workspace: Path, tmp_path: Path, code: str, line: str, told: str) -> None:
    install(tmp_path, code, f"[mien.formats]\n{line}\n")
    done = mien(tmp_path, "export", str(workspace), "--out", str(tmp_path / "me.xyz"))
    assert done.returncode == 2
    assert told in done.stderr


def test_every_format_says_what_it_holds() -> None:
    """Names and endings are told apart, and only folders have no ending."""
    words = [word for each in formats() for word in (*each.endings, each.name)]
    assert len(words) == len(set(words))
    assert all(bool(each.endings) != (each.holds == "folder") for each in formats())
    assert [each.name for each in formats() if each.reads_avatars] == ["mien", "glb"]
    assert plugins("mien.formats", Format) == {}
