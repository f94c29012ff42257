"""The web runtime poses and draws as `mien.runtime` does, and the page of an avatar works alone."""

import gzip
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import web_case as web
from mien import runtime
from mien.avatar import make_portable
from mien.cli import main
from mien.errors import UserError
from mien.export import pack, web_page, webcam, write_page
from mien.export.bound_features import bound_features
from shared_things import MadeOnce, toy_workspace
from test_runtime import new_avatar
from toy_scene import toy_camera
from web_case import drawn_head, faces_of, likeness, picture, rendered, script, stored

EQUAL = 1e-5


def test_what_is_committed_is_that_of_a_fresh_build_and_small(built: Path) -> None:
    for name, committed in (
        ("page.html", web_page.TEMPLATE), ("webgpu_page.js", web_page.WEBGPU), ("webcam.html", webcam.TEMPLATE),
        ("microphone.html", web_page.MICROPHONE),
    ):  # fmt: skip
        fresh = (built / name).read_text() == committed.read_text()
        assert fresh, f"{name} is older than web/: run `make web`, commit it"
    assert len(gzip.compress(web_page.TEMPLATE.read_bytes(), 9)) <= 22_000
    assert len(gzip.compress((built / "mien.js").read_bytes())) <= 13_600


def bound(portable: runtime.PortableAvatar) -> runtime.MeshBound:
    """Return static Gaussians of features as bound ones."""
    assert isinstance(portable.baked, runtime.Static)
    baked = bound_features(portable, portable.baked)
    assert baked is not None
    return baked


@pytest.mark.parametrize(
    ("head", "name"),
    [(lambda: drawn_head(500), "plain.mien"), (lambda: drawn_head(500, 3), "changes.packed"),
     (lambda: drawn_head(500, 5, columns=2), "columns.mien"),
     *((lambda: drawn_head(500, 5, columns=2, features=16), f"features.{form}") for form in ("mien", "packed")),
     *((lambda: web.painted_head(300), f"headgas.{form}") for form in ("mien", "packed"))],
)  # fmt: skip
def test_faces_are_posed_as_in_python(built: Path, tmp_path: Path, head, name: str) -> None:
    """Centres to 1e-5 m. Outputs of the network of headgas, whose Gaussians are bound in a .mien file, to 1e-3."""
    portable, equal = head(), 1e-3 if "headgas" in name else EQUAL
    if name == "headgas.mien":
        portable = replace(portable, baked=bound(portable))
    baked, faces = stored(tmp_path / name, portable).baked, faces_of(portable, 3)
    assert isinstance(baked, runtime.MeshBound)
    n = len(baked.face_index)
    posed = web.pose_by_node(built, tmp_path / name, faces, (baked.rig.template.size, 3 * n, n, 3 * n))
    for face, found in zip(faces, posed, strict=True):
        expected = web.posed_by_python(baked, face)
        for ours, theirs, most in zip(found, expected, (EQUAL, EQUAL, equal, equal), strict=True):
            np.testing.assert_allclose(ours, theirs.reshape(-1), rtol=0, atol=most)


def test_static_features_are_the_same_on_a_triangle() -> None:
    """Bound to a triangle that never moves, with features along few directions, they look as before."""
    portable = web.painted_head(500)
    baked, drawn = bound(portable), []
    assert baked.changes is not None
    assert baked.changes.features is not None
    assert baked.changes.features.basis.shape[1] <= 20
    for face in faces_of(portable, 3):
        first, second = runtime.pose(portable.baked, face), runtime.pose(baked, face)
        for name, most in (("means", 1e-6), ("scales", 1e-6), ("opacities", 1e-4), ("sh", 1e-3), ("T_world_local", 0)):
            np.testing.assert_allclose(getattr(second, name), getattr(first, name), rtol=1e-5, atol=most, err_msg=name)
        drawn.append(first.sh)
    assert np.abs(drawn[0] - drawn[1]).max() > 0.1


SHOW = "viewer.draw(); return viewer.canvas.toDataURL('image/png');"
WHITE = "const viewer = await mien; viewer.background = [1, 1, 1, 1];"
SLIDE = """
  const slider = document.getElementById("jawOpen");
  slider.value = slider.max;
  slider.dispatchEvent(new Event("input", { bubbles: true }));
"""
REST = script(WHITE, "document.getElementById('reset').click();", SHOW)
CLEAR = "const background = document.getElementById('background'); background.click(); background.click();"
"""From white to black to clear."""
TURN = """
  const key = { key: "ArrowLeft", bubbles: true };
  for (let i = 0; i < 4; ++i) viewer.canvas.dispatchEvent(new KeyboardEvent("keydown", key));
  return viewer.yaw;
"""
PLAY = """
  for (const id of ["reset", "play"]) document.getElementById(id).click();
  const began = performance.now();
  while (viewer.timestep < 1 && performance.now() - began < 20000) await new Promise((done) => setTimeout(done, 50));
  viewer.play(false);
  return [viewer.timestep, Array.from(viewer.face.expression), document.getElementById("time").value];
"""


def posing(face: runtime.Face) -> str:
    """Return a script that poses a page's avatar and returns a picture over white."""
    return script(WHITE, "viewer.canvas.width = viewer.canvas.height = 512;", web.taking(face), SHOW)


def test_a_page_works_alone(tmp_path: Path) -> None:
    """Pictures of faces, and of a face that a slider sets, are those of the native renderer."""
    portable, page = drawn_head(4000, rank=2, sh=4, sh_frame="world"), tmp_path / "drawn.html"
    faces = [runtime.Face(**vars(portable.neutral)), *faces_of(portable, 2)]
    written = write_page(page, portable, web.motion_of(faces))
    assert written.size == page.stat().st_size
    scripts = [*map(posing, faces), REST, script(WHITE, SLIDE, SHOW), REST]
    told = web.browse(page, [*scripts, *(script(WHITE, step) for step in (CLEAR + SHOW, TURN, SHOW, PLAY))])
    assert (told["requests"], told["messages"]) == ([], [])
    *posed, rest, wide, again, clear, yaw, turned, played = told["results"]
    for face, address in zip(faces, posed, strict=True):
        assert likeness(address, rendered(portable, face)[0]) >= 45
    most = float(portable.expression_bounds[portable.expression_names.index("jawOpen"), 1])
    assert likeness(wide, rendered(portable, {"jawOpen": most})[0]) >= 45
    np.testing.assert_array_equal(picture(rest), picture(again))
    assert np.abs(picture(clear)[..., 3] - rendered(portable)[1]).max() < 0.02
    assert yaw == pytest.approx(0.4)
    for other in (wide, turned):
        assert likeness(rest, picture(other)[..., :3]) < 40
    timestep, expression, time = played
    assert (timestep, time) == (1, "1")
    np.testing.assert_allclose(expression, faces[1].expression, atol=1e-4)


def test_rotations_are_packed_with_one_sign_and_of_unit_length() -> None:
    """Quaternions of either sign and of any length are the same rotation, so they have the same bytes."""
    portable = drawn_head(300)
    baked = portable.baked
    assert isinstance(baked, runtime.MeshBound)
    factors = np.where(np.arange(300) % 3 == 0, np.float32(-2), np.float32(0.5))[:, None]
    attributes = replace(baked.attributes, quats=baked.attributes.quats * factors)
    assert pack(replace(portable, baked=replace(baked, attributes=attributes))) == pack(portable)


def test_forty_thousand_fit_into_three_megabytes(tmp_path: Path) -> None:
    """Random numbers compress worst, so an avatar of a person is smaller."""
    page = write_page(tmp_path / "a.html", drawn_head(40_000))
    assert page.size <= 3_000_000
    assert page.psnr >= 50


def test_a_page_opens_other_pages_never(tmp_path: Path) -> None:
    """The page's own policy forbids every request, and names of people are escaped."""
    portable = drawn_head(10)
    named = replace(portable, about=replace(portable.about, name='<b>"&'))
    for name in ("a.html", "b.html"):
        write_page(tmp_path / name, named)
    text, again = ((tmp_path / name).read_text() for name in ("a.html", "b.html"))
    assert text == again
    assert "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:" in text
    assert "<title>&lt;b&gt;&quot;&amp;</title>" in text
    assert not any(part in text for part in ("<b>", "http://", "https://"))


def test_what_a_page_cannot_draw_is_refused_in_one_line(tmp_path: Path) -> None:
    portable = make_portable(new_avatar("headgas", sh_degree=1), toy_camera(64), "toy")
    told = r"^toy: its colours depend on the face and on the view \(4 coefficients each\)"
    with pytest.raises(UserError, match=told):
        write_page(tmp_path / "a.html", portable)


def test_export_writes_a_page(tmp_path: Path, made_once: MadeOnce, capsys: pytest.CaptureFixture[str]) -> None:
    line = ["export", str(toy_workspace(made_once)), "--out", str(tmp_path / "a.html")]
    assert main([*line, "--series", "clip", "--every", "2"]) == 0
    assert "a motion of 3 frames" in capsys.readouterr().err
