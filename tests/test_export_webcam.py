"""`mien export --webcam`: what it writes into a page, and what it refuses."""

import hashlib
import json
import lzma
import shutil
from pathlib import Path

import pytest

from mien import runtime
from mien.cli import main
from mien.errors import UserError
from mien.export import find_webcam_files
from mien.export.webcam import OWN, POLICY, VERSION, own_model
from web_case import WEB, drawn_head, tasks_vision


@pytest.fixture
def avatar_file(tmp_path: Path) -> Path:
    path = tmp_path / "me.mien"
    runtime.write_portable(path, drawn_head(10))
    return path


def exported(avatar_file: Path, *more: str) -> int:
    return main(["export", str(avatar_file), "--out", str(avatar_file.with_name("me.html")), *more])


@pytest.mark.unchecked
def test_the_command_needs_nothing_but_what_comes_with_mien(
    avatar_file: Path, monkeypatch: pytest.MonkeyPatch, test_data: Path
) -> None:
    """A page with a webcam has the same bytes each time, and a page without one has nothing of it."""
    tasks_vision()
    for variable in ("MIEN_FACE_LANDMARKER", "MIEN_TASKS_VISION"):
        monkeypatch.delenv(variable, raising=False)
    pages = []
    model = test_data / "mediapipe" / "face_landmarker.task"
    for options in ((), ("--webcam",), ("--webcam", "--webcam-model", str(model))):
        assert exported(avatar_file, *options) == 0
        pages.append(avatar_file.with_name("me.html").read_text())
    plain, camera, given = pages
    assert not any(word in plain for word in ("webcam", "{{", "blob:"))
    assert 'id="webcam-model"' in camera
    assert "{{" not in camera.replace(camera[camera.index('id="webcam-vision"') :], "")
    assert f"script-src 'unsafe-inline'{POLICY}; style-src" in camera
    assert "connect-src 'none'" in POLICY
    assert "Nothing leaves this page" in camera
    assert 5_000_000 < len(camera) < 10_000_000
    assert given == camera


def test_the_model_comes_with_its_licence() -> None:
    """The file is that which MediaPipe publishes, and NOTICE says so."""
    content = own_model()
    digest = hashlib.sha256(content).hexdigest()
    assert (len(content), digest) == (3_758_596, "64184e229b263107bc2b804c6625db1341ff2bb731874b0bcc2fe6544e0bc9ff")
    notice = (OWN / "NOTICE").read_text()
    assert f"{len(content):,} bytes" in notice
    assert digest in notice
    assert "Apache License" in (OWN / "LICENSE").read_text()


def test_a_model_without_its_second_part_is_explained(
    avatar_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """mien from a source distribution lacks the network for blend shapes. A model that is given serves."""
    monkeypatch.setenv("MIEN_TASKS_VISION", str(tasks_vision()))
    monkeypatch.delenv("MIEN_FACE_LANDMARKER", raising=False)
    model = tmp_path / "any.task"
    model.write_bytes(own_model())
    shutil.copy(OWN / "face_landmarker.task.xz.1", tmp_path)
    monkeypatch.setattr("mien.export.webcam.OWN", tmp_path)
    assert exported(avatar_file, "--webcam") == 2
    told = capsys.readouterr().err
    assert "mien's source distribution leaves out" in told
    assert "--webcam-model" in told
    assert find_webcam_files(model).model == model
    model.write_bytes(b"")
    assert exported(avatar_file, "--webcam", "--webcam-model", str(model)) == 2
    assert "mien has one" not in capsys.readouterr().err


def test_a_wrong_model_is_explained(
    avatar_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    tasks_vision()
    model = tmp_path / "any.task"
    monkeypatch.setenv("MIEN_FACE_LANDMARKER", str(model))
    assert exported(avatar_file, "--webcam") == 2
    assert f"{model}: no such file; give MediaPipe's face landmarker" in capsys.readouterr().err
    for content in (b"", b"PK\x03\x04 no archive"):
        model.write_bytes(content)
        assert exported(avatar_file, "--webcam") == 2
        assert "is no face_landmarker.task with blend shapes" in capsys.readouterr().err
    assert not avatar_file.with_name("me.html").exists()


def test_a_missing_or_other_package_is_explained(
    avatar_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Versions after the pinned one send statistics to their maker, so files are known by their hash."""
    folder = tmp_path / "package"
    shutil.copytree(tasks_vision(), folder)
    monkeypatch.setenv("MIEN_TASKS_VISION", str(folder))
    assert find_webcam_files().package == folder
    with (folder / "vision_bundle.cjs").open("a") as file:
        file.write("// newer")
    assert exported(avatar_file, "--webcam") == 2
    assert f"is not that of version {VERSION} of @mediapipe/tasks-vision" in capsys.readouterr().err
    shutil.rmtree(folder)
    assert exported(avatar_file, "--webcam") == 2
    told = capsys.readouterr().err
    assert "needs vision_bundle.cjs" in told
    assert "make landmarker" in told
    assert f"@mediapipe/tasks-vision@{VERSION}" in told


def test_a_compressed_file_of_the_package_is_that_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """In mien's own folder, the largest file lies compressed."""
    folder = tmp_path / "package"
    shutil.copytree(tasks_vision(), folder)
    monkeypatch.setenv("MIEN_TASKS_VISION", str(folder))
    (wasm,) = folder.rglob("vision_wasm_internal.wasm")
    compressed = folder / "vision_wasm_internal.wasm.xz"
    compressed.write_bytes(lzma.compress(wasm.read_bytes(), preset=0))
    wasm.unlink()
    assert find_webcam_files().package == folder, "its content has the right hash"
    compressed.write_bytes(compressed.read_bytes()[:-100])
    with pytest.raises(UserError, match="is not that of version"):
        find_webcam_files()
    compressed.write_bytes(b"no archive")
    with pytest.raises(UserError, match="--webcam needs vision_wasm_internal.wasm"):
        find_webcam_files()


def test_options_that_do_not_fit_are_refused(avatar_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exported(avatar_file, "--webcam-model", "a.task") == 2
    assert "together with --webcam" in capsys.readouterr().err
    assert main(["export", str(avatar_file), "--out", "me.packed", "--webcam"]) == 2
    assert "only an .html page has a webcam" in capsys.readouterr().err


def test_the_pinned_version_is_the_same_everywhere() -> None:
    package = json.loads((WEB / "package.json").read_text())
    assert package["devDependencies"]["@mediapipe/tasks-vision"] == VERSION
    assert f"@mediapipe/tasks-vision@{VERSION}\n" in (WEB.parent / "Makefile").read_text()
