"""A smaller page has the Gaussians that add most to its pictures, and nothing else of the avatar changes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mien import runtime
from mien.avatar import METHODS, make_portable
from mien.cli import main
from mien.errors import UserError
from mien.export import unpacked, write_packed, write_page
from mien.export.rows import with_rows
from mien.export.thinning import contributions
from test_runtime import SIZE, new_avatar
from toy_scene import toy_camera
from web_case import drawn_head, faces_of


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
    buried = replace(portable, baked=replace(portable.baked, attributes=_faint(portable, 7)))
    assert contributions(buried)[7] == 0


def _faint(portable: runtime.PortableAvatar, index: int) -> runtime.Attributes:
    assert isinstance(portable.baked, runtime.MeshBound)
    logits = portable.baked.attributes.opacity_logits.copy()
    logits[index] = -30
    return replace(portable.baked.attributes, opacity_logits=logits)


@pytest.mark.unchecked
def test_a_page_fits_with_those_that_add_most(tmp_path: Path) -> None:
    portable = drawn_head(4000)
    whole = write_page(tmp_path / "whole.html", portable)
    for largest in (whole.size, whole.size // 10 * 9):
        page = write_page(tmp_path / "a.html", portable, largest=largest)
        assert page.size == (tmp_path / "a.html").stat().st_size <= largest
        assert page.size > 0.97 * largest
    assert page.count < whole.count == 4000
    assert page.psnr < whole.psnr


@pytest.mark.unchecked
def test_what_adds_least_goes_first(tmp_path: Path) -> None:
    """Half of the Gaussians are too faint to be seen: without them, the picture is the same."""
    portable = drawn_head(4000)
    assert isinstance(portable.baked, runtime.MeshBound)
    attributes = portable.baked.attributes
    faint = np.random.default_rng(3).permutation(4000)[:2000]
    logits = attributes.opacity_logits.copy()
    logits[faint] = -30
    portable = replace(portable, baked=replace(portable.baked, attributes=replace(attributes, opacity_logits=logits)))
    whole = write_packed(tmp_path / "whole.packed", portable)
    packed = write_packed(tmp_path / "a.packed", portable, largest=round(0.9 * whole.size))
    assert 2000 <= packed.count < 4000
    assert packed.psnr == pytest.approx(whole.psnr, abs=1)
    shown = np.setdiff1d(np.arange(4000), faint)
    same = runtime.Avatar(unpacked(replace(portable, baked=with_rows(portable.baked, shown)))).render()[0]
    assert np.abs(same - runtime.Avatar(unpacked(portable)).render()[0]).max() < 0.05


def test_a_page_that_cannot_be_so_small_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"a\.html: would have 0\.\d+ MB with the fewest Gaussians.*0\.01 MB at most"):
        write_page(tmp_path / "a.html", drawn_head(500), largest=10_000)
    assert not (tmp_path / "a.html").exists()


@pytest.mark.unchecked
def test_the_command_says_what_is_left(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, out = tmp_path / "me.mien", tmp_path / "me.html"
    runtime.write_portable(source, drawn_head(4000))
    assert main(["export", str(source), "--out", str(out)]) == 0
    most = round(out.stat().st_size / 1e6 * 0.97, 3)
    capsys.readouterr()
    assert main(["export", str(source), "--out", str(out), "--largest", str(most)]) == 0
    told = " ".join(capsys.readouterr().err.split())
    assert "of 4,000 Gaussians that add most to its pictures" in told
    assert "dB against the picture with all of them" in told
    assert out.stat().st_size <= most * 1e6
    assert "gaps show" not in told
    assert main(["export", str(source), "--out", str(out), "--largest", str(round(most * 0.86, 3))]) == 0
    assert "gaps show, in the eyes first" in " ".join(capsys.readouterr().err.split())
    for words, message in (
        (["--out", str(tmp_path / "me.ply"), "--largest", "1"], "only .html and .packed files are made smaller"),
        (["--out", str(out), "--largest", "0"], "--largest 0: give a number of MB above 0"),
        (["--out", str(out), "--largest", "nan"], "--largest nan: give a number of MB above 0"),
    ):
        assert main(["export", str(source), *words]) == 2
        assert message in " ".join(capsys.readouterr().err.split())
