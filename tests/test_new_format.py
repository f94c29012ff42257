"""A stranger adds a format from a package: the steps of CONTRIBUTING.md, "Add a format", to the letter."""

from pathlib import Path

import pytest

from forked import ForkServer
from mien.formats import Format, formats
from mien.plugins import plugins
from toy_package import blocks, entry_points, install, mien
from toy_workspace import write_toy_workspace


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("place") / "W"
    write_toy_workspace(folder)
    return folder


def follow(folder: Path) -> None:
    """Follow the recipe under another name, so that mien itself may have an .xyz."""
    (code,) = blocks("Add a format", "python")
    install(folder, "mien_xyz9", code.replace("xyz", "xyz9"), entry_points("Add a format").replace("xyz", "xyz9"))


def test_its_files_are_written_from_runs_motions_and_files(
    fork_server: ForkServer, workspace: Path, tmp_path: Path
) -> None:
    follow(tmp_path)
    toy, again = str(workspace), tmp_path / "again.xyz9"
    for words in (
        (toy, "--out", str(tmp_path / "me.xyz9")),
        (toy, "--out", str(tmp_path / "me.mien")),
        (toy, "--out", str(tmp_path / "talk.xyz9"), "--series", "clip"),
        (str(tmp_path / "me.mien"), "--out", str(again)),
    ):
        done = mien(fork_server, tmp_path, "export", *words)
        assert done.returncode == 0, done.stderr
    lines = (tmp_path / "me.xyz9").read_text().splitlines()
    assert len(lines) == 400
    assert again.read_text().splitlines() == lines
    assert len(list(tmp_path.glob("talk_*.xyz9"))) == 5
    refused = mien(fork_server, tmp_path, "export", toy, "--out", str(tmp_path / "a.xyz9"), "--sh", "3")
    assert (refused.returncode, "only a .ply has a degree" in refused.stderr) == (2, True)
    unknown = mien(fork_server, tmp_path, "export", toy, "--out", str(tmp_path / "a.abc"))
    assert " or .xyz9, or --format" in unknown.stderr


CLASH = "from mien.formats.format import Format\nXYZ = Format('xyz9', 'pose', print, ('.ply',))"


@pytest.mark.parametrize(
    ("code", "told"),
    [
        ("XYZ = 1", "and it is no Format; update or uninstall mien-xyz9"),
        (CLASH, "the format 'xyz9': .ply is taken by another format"),
    ],
)
def test_a_package_that_is_wrong_is_named(
    fork_server: ForkServer, workspace: Path, tmp_path: Path, code: str, told: str
) -> None:
    install(tmp_path, "mien_xyz9", code, "[mien.formats]\nxyz9 = mien_xyz9:XYZ\n")
    done = mien(fork_server, tmp_path, "export", str(workspace), "--out", str(tmp_path / "me.xyz9"))
    assert done.returncode == 2
    assert told in done.stderr


def test_every_format_says_what_it_holds() -> None:
    """Names and endings are told apart, and only folders have no ending."""
    words = [word for each in formats() for word in (*each.endings, each.name)]
    assert len(words) == len(set(words))
    assert all(bool(each.endings) != (each.holds == "folder") for each in formats())
    assert [each.name for each in formats() if each.reads_avatars] == ["mien", "glb"]
    assert plugins("mien.formats", Format) == {}
