"""The web runtime poses and draws as `mien.runtime` does, and the page of an avatar works alone."""

import gzip
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mien import runtime
from mien.avatar import make_portable
from mien.cli import main
from mien.errors import UserError
from mien.export import Motion, pack, unpacked, web_page, webcam, write_page
from mien.export.bound_features import bound_features
from mien.runtime.posing import rig_points
from shared_things import MadeOnce, toy_workspace
from test_runtime import new_avatar
from toy_scene import toy_camera
from web_case import as_json, browse, drawn_head, faces_of, painted_head, picture, pose_by_node, posed_by_python, psnr

SIDE = 512
EQUAL = 1e-5


@pytest.mark.parametrize(
    ("name", "committed"),
    [("page.html", web_page.TEMPLATE), ("webgpu_page.js", web_page.WEBGPU), ("webcam.html", webcam.TEMPLATE),
     ("microphone.html", web_page.MICROPHONE)],
)  # fmt: skip
def test_what_is_committed_is_that_of_a_fresh_build(built: Path, name: str, committed: Path) -> None:
    assert (built / name).read_text() == committed.read_text(), f"{name} is older than web/: run `make web`, commit it"


def test_the_page_and_the_package_are_small(built: Path) -> None:
    assert len(gzip.compress(web_page.TEMPLATE.read_bytes(), 9)) <= 22_000
    assert len(gzip.compress((built / "mien.js").read_bytes())) <= 13_600


def posed_by_node(
    built: Path, path: Path, portable: runtime.PortableAvatar, faces: list[runtime.Face], form: str
) -> tuple[runtime.MeshBound, list[Any]]:
    """Write an avatar, and return what its file holds, with each face's points, centres, raw opacities and colours."""
    if form == "mien":
        runtime.write_portable(path, portable)
    else:
        path.write_bytes(pack(portable))
    baked = (portable if form == "mien" else unpacked(portable)).baked
    assert isinstance(baked, runtime.MeshBound)
    n = len(baked.face_index)
    return baked, pose_by_node(built, path, faces, (baked.rig.template.size, 3 * n, n, 3 * n))


HEADS = {
    "plain": lambda: drawn_head(500),
    "changes": lambda: drawn_head(500, 3),
    "some columns": lambda: drawn_head(500, 5, columns=2),
    "features": lambda: drawn_head(500, 5, columns=2, features=16),
    "headgas": lambda: painted_head(300),
}


@pytest.mark.parametrize(
    ("form", "head"),
    [("mien", "plain"), ("packed", "changes"), ("mien", "some columns"), ("mien", "features"), ("packed", "features"),
     ("mien", "headgas"), ("packed", "headgas")],
)  # fmt: skip
def test_faces_are_posed_as_in_python(built: Path, tmp_path: Path, form: str, head: str) -> None:
    """Centres to 1e-5 m. Outputs of the network of headgas, whose Gaussians are bound in a .mien file, to 1e-3."""
    portable, equal = HEADS[head](), 1e-3 if head == "headgas" else EQUAL
    if isinstance(portable.baked, runtime.Static) and form == "mien":
        portable = replace(portable, baked=bound(portable))
    faces = faces_of(portable, 3)
    baked, posed = posed_by_node(built, tmp_path / f"head.{form}", portable, faces, form)
    for face, found in zip(faces, posed, strict=True):
        expected = posed_by_python(baked, face)
        for ours, theirs, most in zip(found, expected, (EQUAL, EQUAL, equal, equal), strict=True):
            np.testing.assert_allclose(ours, theirs.reshape(-1), rtol=0, atol=most)


def bound(portable: runtime.PortableAvatar) -> runtime.MeshBound:
    """Return static Gaussians of features as bound ones."""
    assert isinstance(portable.baked, runtime.Static)
    baked = bound_features(portable, portable.baked)
    assert baked is not None
    return baked


def test_static_features_are_the_same_on_a_triangle() -> None:
    """Bound to a triangle that never moves, with features along few directions, they look as before."""
    portable = painted_head(500)
    baked = bound(portable)
    assert baked.changes is not None
    assert baked.changes.features is not None
    assert baked.changes.features.basis.shape[1] <= 20
    network = portable.baked.network  # type: ignore[union-attr]
    assert network is not None
    drawn = []
    for face in faces_of(portable, 3):
        first, second = runtime.pose(portable.baked, face), runtime.pose(baked, face)
        np.testing.assert_allclose(second.means, first.means, rtol=0, atol=1e-6)
        np.testing.assert_allclose(second.scales, first.scales, rtol=1e-5)
        np.testing.assert_allclose(second.opacities, first.opacities, rtol=0, atol=1e-4)
        np.testing.assert_allclose(second.sh, first.sh, rtol=0, atol=1e-3)
        np.testing.assert_array_equal(second.T_world_local, first.T_world_local)
        drawn.append(first.sh)
    assert np.abs(drawn[0] - drawn[1]).max() > 0.1


POSE = """(async () => {
  const viewer = await mien, canvas = viewer.canvas, face = %s;
  canvas.width = canvas.height = 512;
  viewer.background = [1, 1, 1, 1];
  viewer.take(Object.fromEntries(Object.entries(face).map(([name, values]) => [name, Float32Array.from(values)])));
  viewer.draw();
  return canvas.toDataURL("image/png");
})()"""
"""Poses the avatar and returns a picture over white."""

SLIDE = """(async () => {
  const viewer = await mien, slider = document.getElementById("jawOpen");
  slider.value = slider.max;
  slider.dispatchEvent(new Event("input", { bubbles: true }));
  viewer.draw();
  return viewer.canvas.toDataURL("image/png");
})()"""

REST = """(async () => {
  const viewer = await mien;
  document.getElementById("reset").click();
  viewer.background = [1, 1, 1, 1];
  viewer.draw();
  return viewer.canvas.toDataURL("image/png");
})()"""

CLEAR = """(async () => {
  const viewer = await mien, background = document.getElementById("background");
  background.click();  // from white to black
  background.click();
  viewer.draw();
  return viewer.canvas.toDataURL("image/png");
})()"""

TURN = """(async () => {
  const viewer = await mien;
  viewer.background = [1, 1, 1, 1];
  const key = { key: "ArrowLeft", bubbles: true };
  for (let i = 0; i < 4; ++i) viewer.canvas.dispatchEvent(new KeyboardEvent("keydown", key));
  viewer.draw();
  return [viewer.yaw, viewer.canvas.toDataURL("image/png")];
})()"""

PLAY = """(async () => {
  const viewer = await mien;
  document.getElementById("reset").click();
  document.getElementById("play").click();
  const began = performance.now();
  while (viewer.timestep < 1 && performance.now() - began < 20000) await new Promise((done) => setTimeout(done, 50));
  viewer.play(false);
  return [viewer.timestep, Array.from(viewer.face.expression), document.getElementById("time").value];
})()"""


def test_a_page_works_alone(tmp_path: Path) -> None:
    portable = without_changes_of_jaw(drawn_head(4000, rank=2, sh=4, sh_frame="world"))
    faces = [runtime.Face(**{k: v for k, v in vars(portable.neutral).items()}), *faces_of(portable, 2)]
    motion = Motion(*(np.stack([getattr(face, name) for face in faces]) for name in vars(faces[0])), fps=1.0)
    page = tmp_path / "drawn.html"
    written = write_page(page, portable, motion)
    assert written.size == page.stat().st_size
    scripts = [*(POSE % json.dumps(face) for face in as_json(faces)), REST, SLIDE, REST, CLEAR, TURN, PLAY]
    told = browse(page, scripts)
    assert told["requests"] == []
    assert told["messages"] == []
    *posed, rest, open_, again, clear, turned, played = told["results"]

    exact = runtime.Avatar(portable)
    camera = exact.camera.resized(SIDE, SIDE)
    for face, address in zip(faces, posed, strict=True):
        expected, _ = exact.render(runtime.pose(portable.baked, face), camera)
        assert psnr(picture(address)[..., :3], expected) >= 45

    np.testing.assert_array_equal(picture(rest), picture(again))
    changed = np.abs(picture(open_) - picture(rest)).max(-1) > 4 / 255
    mouth, (_, alpha) = mouth_region(portable, camera), exact.render(camera=camera)
    assert mouth[alpha > 0.5].mean() < 0.7
    assert changed[mouth].mean() > 0.2
    assert not changed[~mouth].any()
    assert np.abs(picture(clear)[..., 3] - alpha).max() < 0.02
    assert turned[0] == pytest.approx(0.4)
    assert np.abs(picture(turned[1]) - picture(rest)).max(-1).mean() > 0.02
    timestep, expression, time = played
    assert (timestep, time) == (1, "1")
    np.testing.assert_allclose(expression, faces[1].expression, atol=1e-4)


def without_changes_of_jaw(portable: runtime.PortableAvatar) -> runtime.PortableAvatar:
    """Return the avatar with changes that do not depend on jawOpen, so that jawOpen moves nothing beside the mesh."""
    baked = portable.baked
    assert isinstance(baked, runtime.MeshBound)
    assert baked.changes is not None
    directions = baked.changes.directions.copy()
    directions[portable.expression_names.index("jawOpen")] = 0
    return replace(portable, baked=replace(baked, changes=replace(baked.changes, directions=directions)))


def mouth_region(portable: runtime.PortableAvatar, camera: runtime.Camera) -> np.ndarray:
    """Return the pixels of the Gaussians whose triangles jawOpen moves, at rest or with an open mouth."""
    baked, index = portable.baked, portable.expression_names.index("jawOpen")
    assert isinstance(baked, runtime.MeshBound)
    open_ = {"jawOpen": float(portable.expression_bounds[index, 1])}
    avatar = runtime.Avatar(portable)
    rest, moved = (rig_points(baked.rig, face) for face in (avatar.face(), avatar.face(open_)))
    triangles = (np.abs(moved - rest).max(1) > 1e-6)[baked.faces].any(1)
    keep = triangles[baked.face_index]
    attributes = runtime.Attributes(**{name: values[keep] for name, values in vars(baked.attributes).items()})
    # Opaque, so that every pixel that they can reach counts.
    attributes = replace(attributes, opacity_logits=np.full(keep.sum(), 9, np.float32))
    part = replace(
        baked, face_index=baked.face_index[keep], means=baked.means[keep], attributes=attributes, changes=None
    )
    only = runtime.Avatar(replace(portable, baked=part))
    return np.maximum(*(only.render(only.pose(given), camera)[1] for given in ({}, open_))) > 0


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
    write_page(tmp_path / "a.html", named)
    text = (tmp_path / "a.html").read_text()
    assert "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:" in text
    assert "<title>&lt;b&gt;&quot;&amp;</title>" in text
    assert "<b>" not in text
    assert "http://" not in text
    assert "https://" not in text
    write_page(tmp_path / "b.html", named)
    assert (tmp_path / "b.html").read_bytes() == (tmp_path / "a.html").read_bytes()


def test_what_a_page_cannot_draw_is_refused_in_one_line(tmp_path: Path) -> None:
    portable = make_portable(new_avatar("headgas", sh_degree=1), toy_camera(64), "toy")
    with pytest.raises(
        UserError, match=r"^toy: its colours depend on the face and on the view \(4 coefficients each\)"
    ):
        write_page(tmp_path / "a.html", portable)


def test_export_writes_a_page(tmp_path: Path, made_once: MadeOnce, capsys: pytest.CaptureFixture[str]) -> None:
    workspace, page = str(toy_workspace(made_once)), str(tmp_path / "a.html")
    assert main(["export", workspace, "--out", page, "--series", "clip", "--every", "2"]) == 0
    assert "a motion of 3 frames" in capsys.readouterr().err
    assert main(["export", workspace, "--out", page, "--set", "drop=1"]) == 2
    assert "a page sets every expression itself" in capsys.readouterr().err
