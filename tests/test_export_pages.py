"""Pages of `mien export` with fewer Gaussians (`--largest`) or with a webcam (`--webcam`)."""

import hashlib
import json
import lzma
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mien import runtime
from mien.avatar.baking import make_portable
from mien.avatar.methods import METHODS
from mien.cli import main
from mien.errors import UserError
from mien.formats.page import PackedOptions, PageOptions, write_packed, write_page
from mien.formats.shared.packed import unpacked, with_rows
from mien.formats.shared.thinning import contributions
from mien.formats.shared.webcam import OWN, POLICY, VERSION, own_model, webcam_files
from refusals import refuses
from test_runtime import SIZE, new_avatar
from toy_scene import toy_camera
from web_case import WEB, drawn_head, faces_of, tasks_vision


@pytest.mark.parametrize("method", METHODS)
def test_gaussians_that_stay_are_posed_as_before(method: str) -> None:
    portable = make_portable(new_avatar(method), toy_camera(SIZE), "toy")
    faces = faces_of(portable, 2)
    every = [runtime.pose(portable.baked, face) for face in faces]
    rows = np.arange(len(every[0]))[1::3]
    for face, whole in zip(faces, every, strict=True):
        some = runtime.pose(with_rows(portable.baked, rows), face)
        assert len(some) == len(rows)
        for name in ("means", "quats", "scales", "opacities", "sh"):
            # Matrix products of other sizes may round differently.
            np.testing.assert_allclose(getattr(some, name), getattr(whole, name)[rows], rtol=1e-5, atol=1e-6)


def test_contributions_are_the_light_of_each_gaussian_alone() -> None:
    """A picture of a white Gaussian among black ones, over black, sums to its weights."""
    portable = drawn_head(40, features=4, rank=2)
    found = contributions(portable)
    drawn, camera = runtime.Avatar(portable), portable.camera.square(256)
    front = drawn.pose()
    for index in np.argsort(-found)[:5]:
        light = np.full((len(front), 1, 3), -10, np.float32)
        light[index] = 0.5 / 0.28209479177387814
        image, _ = drawn.render(replace(front, sh=light), camera, (0, 0, 0))
        assert image[..., 0].sum() <= found[index] * 1.001
    assert found.max() > 10
    assert contributions(with_faint(portable, [7]))[7] == 0


def with_faint(portable: runtime.PortableAvatar, rows: Any) -> runtime.PortableAvatar:
    assert isinstance(portable.baked, runtime.MeshBound)
    attributes = portable.baked.attributes
    logits = attributes.opacity_logits.copy()
    logits[rows] = -30
    return replace(portable, baked=replace(portable.baked, attributes=replace(attributes, opacity_logits=logits)))


@pytest.mark.unchecked
def test_a_page_fits_with_those_that_add_most(tmp_path: Path) -> None:
    portable = drawn_head(4000)
    whole = write_page(tmp_path / "whole.html", portable)
    for largest in (whole.size, whole.size // 10 * 9):
        page = write_page(tmp_path / "a.html", portable, None, PageOptions(largest=largest / 1e6))
        assert page.size == (tmp_path / "a.html").stat().st_size <= largest
        assert page.size > 0.97 * largest
    assert page.count < whole.count == 4000
    assert page.psnr < whole.psnr
    with pytest.raises(UserError, match=r"b\.html: would have 0\.\d+ MB with the fewest Gaussians.*0\.01 MB at most"):
        write_page(tmp_path / "b.html", drawn_head(500), None, PageOptions(largest=0.01))
    assert not (tmp_path / "b.html").exists()
    # Half of the Gaussians are too faint to be seen: without them, the picture is the same.
    faint = np.random.default_rng(3).permutation(4000)[:2000]
    portable = with_faint(drawn_head(4000), faint)
    whole = write_packed(tmp_path / "whole.packed", portable)
    options = PackedOptions(largest=0.9 * whole.size / 1e6)
    packed = write_packed(tmp_path / "a.packed", portable, None, options)
    assert 2000 <= packed.count < 4000
    assert packed.psnr == pytest.approx(whole.psnr, abs=1)
    shown = np.setdiff1d(np.arange(4000), faint)
    same = runtime.Avatar(unpacked(replace(portable, baked=with_rows(portable.baked, shown)))).render()[0]
    assert np.abs(same - runtime.Avatar(unpacked(portable)).render()[0]).max() < 0.05


@pytest.mark.unchecked
def test_the_command_says_what_is_left(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, out = tmp_path / "me.mien", tmp_path / "me.html"
    runtime.write_portable(source, drawn_head(4000))

    def told(*options: str) -> str:
        capsys.readouterr()
        assert main(["export", str(source), "--out", str(out), *options]) == 0
        return " ".join(capsys.readouterr().err.split())

    told()
    most = round(out.stat().st_size / 1e6 * 0.97, 3)
    said = told("--largest", str(most))
    assert "of 4,000 Gaussians that add most to its pictures" in said
    assert "dB against the picture with all of them" in said
    assert "gaps show" not in said
    assert out.stat().st_size <= most * 1e6
    assert "gaps show, in the eyes first" in told("--largest", str(round(most * 0.86, 3)))


page = pytest.fixture(lambda tmp_path: tmp_path / "me.html")


def exported(page: Path, *more: str) -> int:
    runtime.write_portable(page.with_name("me.mien"), drawn_head(10))
    return main(["export", str(page.with_name("me.mien")), "--out", str(page), *more])


@pytest.mark.unchecked
def test_the_command_needs_nothing_but_what_comes_with_mien(page: Path, monkeypatch, test_data: Path) -> None:
    """A page with a webcam has the same bytes each time, and a page without one has nothing of it."""
    tasks_vision()
    for variable in ("MIEN_FACE_LANDMARKER", "MIEN_TASKS_VISION"):
        monkeypatch.delenv(variable, raising=False)
    model, pages = test_data / "mediapipe" / "face_landmarker.task", []
    for options in ((), ("--webcam",), ("--webcam", "--webcam-model", str(model))):
        assert exported(page, *options) == 0
        pages.append(page.read_text())
    plain, camera, given = pages
    assert given == camera
    assert not any(word in plain for word in ("webcam", "{{", "blob:"))
    for part in (
        'id="webcam-model"', f"script-src 'unsafe-inline'{POLICY}; style-src", "Nothing leaves this page",
    ):  # fmt: skip
        assert part in camera
    assert "{{" not in camera[: camera.index('id="webcam-vision"')]
    assert "connect-src 'none'" in POLICY
    assert 5_000_000 < len(camera) < 10_000_000


def test_the_model_is_the_published_one_and_one_version_is_pinned() -> None:
    digest = hashlib.sha256(own_model()).hexdigest()
    assert digest == "64184e229b263107bc2b804c6625db1341ff2bb731874b0bcc2fe6544e0bc9ff"
    package = json.loads((WEB / "package.json").read_text())
    assert package["devDependencies"]["@mediapipe/tasks-vision"] == VERSION
    assert f"@mediapipe/tasks-vision@{VERSION}\n" in (WEB.parent / "Makefile").read_text()


def test_a_wrong_model_and_one_without_its_second_part_are_explained(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    """mien from a source distribution lacks the network for blend shapes. A model that is given serves."""
    monkeypatch.setenv("MIEN_TASKS_VISION", str(tasks_vision()))
    monkeypatch.delenv("MIEN_FACE_LANDMARKER", raising=False)
    model = tmp_path / "any.task"
    model.write_bytes(own_model())
    shutil.copy(OWN / "face_landmarker.task.xz.1", tmp_path)
    monkeypatch.setattr("mien.formats.shared.webcam.OWN", tmp_path)
    refuses("mien's source distribution leaves out.*--webcam-model", webcam_files)
    assert webcam_files(model)["model"] == model.read_bytes()
    monkeypatch.setenv("MIEN_FACE_LANDMARKER", str(tmp_path / "gone"))
    refuses("gone: no such file; give MediaPipe's face landmarker", webcam_files)
    for content in (b"", b"PK\x03\x04 no archive"):
        model.write_bytes(content)
        told = refuses("is no face_landmarker.task with blend shapes", webcam_files, model)
        assert "mien has one" not in told


def test_a_missing_or_other_package_is_explained(page: Path, monkeypatch: pytest.MonkeyPatch, tmp_path, capsys) -> None:
    """Versions after the pinned one send statistics to their maker, so files are known by their hash. In mien's own
    folder, the largest file lies compressed."""
    package = Path(shutil.copytree(tasks_vision(), tmp_path / "package"))
    monkeypatch.setenv("MIEN_TASKS_VISION", str(package))
    (wasm,) = package.rglob("vision_wasm_internal.wasm")
    compressed = package / "vision_wasm_internal.wasm.xz"
    compressed.write_bytes(lzma.compress(wasm.read_bytes(), preset=0))
    content = webcam_files()["wasm"]
    wasm.unlink()
    assert webcam_files()["wasm"] == content
    for damaged, told in (
        (compressed.read_bytes()[:-100], f"is not that of version {VERSION} of @mediapipe/tasks-vision"),
        (b"no archive", "--webcam needs vision_wasm_internal.wasm.*make landmarker.*@mediapipe/tasks-vision@"),
    ):
        compressed.write_bytes(damaged)
        refuses(told, webcam_files)
    assert exported(page, "--webcam") == 2
    assert "needs vision_wasm_internal.wasm" in capsys.readouterr().err
    assert not page.exists()
