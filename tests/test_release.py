"""The release command: archives whose bytes depend on content alone, checksums, and the page from CHANGELOG."""

import hashlib
import os
import sys
import tarfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "release"))
import make  # noqa: E402  # pyright: ignore[reportMissingImports]


def folder_of(path: Path, order: list[str]) -> Path:
    for index, name in enumerate(order):
        file = path / "docs" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(f"content of {name}")
        os.utime(file, (1_000_000 + index, 2_000_000 + index))
    return path / "docs"


def test_the_same_files_give_the_same_archive(tmp_path: Path) -> None:
    one, other = folder_of(tmp_path / "a", ["x", "y/z", "b"]), folder_of(tmp_path / "b", ["b", "x", "y/z"])
    (one / "x").chmod(0o600)
    for folder, name in ((one, "one.tar.xz"), (other, "other.tar.xz")):
        make.pack(folder, tmp_path / name, 1_700_000_000)
    assert (tmp_path / "one.tar.xz").read_bytes() == (tmp_path / "other.tar.xz").read_bytes()
    with tarfile.open(tmp_path / "one.tar.xz") as tar:
        assert tar.getnames() == ["b", "x", "y", "y/z"]
        assert {member.mtime for member in tar} == {1_700_000_000}


def test_the_page_has_the_notes_and_sums(tmp_path: Path) -> None:
    (tmp_path / "mien-9.9.9-cp311-cp311-linux_x86_64.whl").write_bytes(b"wheel")
    make.write_page(tmp_path, "9.9.9", "### Notes\n\n- new")
    digest = hashlib.sha256(b"wheel").hexdigest()
    assert (tmp_path / "SHA256SUMS").read_text() == f"{digest}  mien-9.9.9-cp311-cp311-linux_x86_64.whl\n"
    page = (tmp_path / "RELEASE.md").read_text()
    assert page.startswith("# mien 9.9.9\n\n### Notes\n\n- new\n")
    assert digest in page
    assert "Only for machines like the one that built them" in page


def test_the_changelog_has_the_version_of_the_package(tmp_path: Path) -> None:
    version = make.tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert "mien create" in make.section(ROOT / "CHANGELOG.md", version)
    (tmp_path / "CHANGELOG.md").write_text("# Changelog\n\n## 1.0.0\n\n- a\n\n## 0.9.0 (old)\n\n- b\n")
    assert make.section(tmp_path / "CHANGELOG.md", "1.0.0") == "- a"
    assert make.section(tmp_path / "CHANGELOG.md", "0.9.0") == "- b"
    with pytest.raises(make.ReleaseError, match="no section '## 2.0.0'"):
        make.section(tmp_path / "CHANGELOG.md", "2.0.0")


def test_the_source_has_what_git_knows_alone(tmp_path: Path) -> None:
    """Wheels take MediaPipe's code for pages from the checkout. With it, the sdist would be too large."""
    make.copy_tracked(tmp_path / "source")
    copied = {path.relative_to(tmp_path / "source").as_posix() for path in (tmp_path / "source").rglob("*")}
    assert {"pyproject.toml", "src/mien/export/landmarker/face_landmarker.task.xz.1"} <= copied
    assert not [name for name in copied if "/vision_" in name or name.startswith("build/")]
    assert {path.stat().st_mode & 0o777 for path in (tmp_path / "source").rglob("*.py")} == {0o644}


def test_the_source_distribution_is_small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It has what a wheel is built from, without history, tests, pictures and the network that only pages need."""
    from scikit_build_core.build import build_sdist

    make.copy_tracked(tmp_path / "source")
    monkeypatch.chdir(tmp_path / "source")
    archive = tmp_path / build_sdist(str(tmp_path))
    assert archive.stat().st_size < make.MOST_SDIST_BYTES == 5_000_000
    with tarfile.open(archive) as tar:
        names = {name.partition("/")[2] for name in tar.getnames()}
    needed = {
        "pyproject.toml",
        "CMakeLists.txt",
        "native/bindings.cpp",
        "src/mien/export/landmarker/face_landmarker.task.xz.1",
        "src/mien/capture/data/selfie_segmentation.tflite.xz",
    }
    assert needed <= names
    unneeded = ("tests/", "web/", ".ci/", "benchmarks/", "docs/images/", "docs/pictures/", "docs/log.md")
    unneeded += ("src/mien/export/landmarker/face_landmarker.task.xz.2",)
    assert not [name for name in names if name.startswith(unneeded)]


def test_two_checkouts_give_the_same_source_distribution(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither folders nor times of files matter. A release sets the variable to the commit's time."""
    from scikit_build_core.build import build_sdist

    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    sums = []
    for folder, time in ((tmp_path / "here", 1_600_000_000), (tmp_path / "elsewhere" / "deep", 1_650_000_000)):
        make.copy_tracked(folder / "source")
        for path in (folder / "source").rglob("*"):
            os.utime(path, (time, time))
        monkeypatch.chdir(folder / "source")
        sums.append(hashlib.sha256((folder / build_sdist(str(folder))).read_bytes()).hexdigest())
    assert sums[0] == sums[1]


@pytest.mark.parametrize(("code", "answers"), [(0, True), (1, False), (None, False)])
def test_containers_need_a_service(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int | None, answers: bool
) -> None:
    """Without one, wheels are those of this machine."""
    if code is not None:
        (tmp_path / "docker").write_text(f"#!/bin/sh\nexit {code}\n")
        (tmp_path / "docker").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert make.has_containers() is answers


def test_a_folder_with_files_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "old.whl").write_bytes(b"")
    assert make.main(["--out", str(tmp_path), "--parts", "sdist"]) == 2
    assert "is not empty" in capsys.readouterr().err
