"""The page as people meet it, and its back end in WebGPU, which draws as the native renderer does."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import web_case as web
from mien import runtime
from mien.cli import main
from mien.formats.page import POSTER, PageOptions, check_page, write_packed, write_page
from needs import NO_WEBGPU
from refusals import refuses
from test_web import REST, SHOW, SLIDE, WHITE, points, posing, skinned_head
from test_web_element import LOADED, SHOT
from web_case import browse, drawn_head, expect_usable, faces_of, likeness, motion_of, picture, psnr, rendered, script

portable = pytest.fixture(scope="module")(lambda: drawn_head(300, rank=2))


@pytest.fixture(scope="module")
def page(portable: runtime.PortableAvatar, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "a.html"
    write_page(path, portable, motion_of(faces_of(portable, 3)))
    return path


# A clock of the test's own: pictures are asked for as if a sixtieth of a second had gone by, however long they take.
CLOCK = """(() => {
  let now = 0, wanted = [];
  performance.now = () => now;
  requestAnimationFrame = (draw) => wanted.push(draw);
  window.passes = async (seconds) => {
    for (const end = now + 1000 * seconds; now < end; await null) {
      now += 1000 / 60;
      const due = wanted;
      wanted = [];
      for (const draw of due) draw(now);
    }
  };
})()"""
ALIVE = """(async () => {
  const viewer = await mien, blink = viewer.avatar.expression_names.indexOf("eyeBlinkLeft");
  const eye = 3 * viewer.avatar.joint_names.indexOf("left_eye"), box = viewer.canvas.getBoundingClientRect();
  const turns = [], timesteps = new Set();
  viewer.renderer.draw = viewer.renderer.upload = viewer.poser.pose = () => {};  // pictures are tested elsewhere
  let closed = 0;
  for (let k = 0; k < 600; ++k) {
    await passes(1 / 60);
    turns.push(viewer.yaw);
    if (viewer.playing) timesteps.add(viewer.timestep);
    else closed = Math.max(closed, viewer.shown.expression[blink]);
  }
  document.getElementById("reset").click();
  dispatchEvent(new PointerEvent("pointermove", { clientX: box.right, clientY: box.top }));
  await passes(2);
  const looks = [viewer.shown.joints[eye + 1], viewer.shown.joints[eye]];
  for (const id of ["idle", "gaze"]) document.getElementById(id).click();
  await passes(1);
  const { head_rotation, expression } = viewer.shown;
  return [Math.max(...turns), viewer.yaw, timesteps.size, viewer.playing, closed, ...looks,
    Array.from(head_rotation), expression[blink]];
})()"""
KEY = """(async () => {
  const viewer = await mien;
  while (Math.abs(viewer.yaw) < 0.1) await passes(1 / 60);
  const before = viewer.yaw;
  document.body.dispatchEvent(new KeyboardEvent("keydown", { key: "x", bubbles: true }));
  return [before, viewer.yaw];
})()"""


def test_a_page_opens_alive_and_faces_are_buttons(page: Path, portable: runtime.PortableAvatar) -> None:
    """The camera turns to the front, the filmed motion plays once, then the head blinks and looks at the pointer, which
    is to its left and up. With both switched off, it rests."""
    told = browse(page, [ALIVE], size=(300, 200), device=["lively"], opening=CLOCK)
    first, last, timesteps, playing, closed, aside, down, still, opened = told["results"][0]
    assert (told["requests"], told["messages"], last, playing) == ([], [], 0, False)
    assert (first > 0.2, timesteps >= 2, closed > 0.3, aside > 0.25, down < -0.1) == (True,) * 5, told["results"]
    np.testing.assert_allclose(still, portable.neutral.head_rotation, atol=1e-6)
    assert opened == pytest.approx(portable.neutral.expression[portable.expression_names.index("eyeBlinkLeft")])
    # Who asks for reduced motion gets a page that stands still, and faces that come at once.
    told = browse(page, [STILL, PRESS, GAZE, MARKS], size=(300, 200))
    assert (told["requests"], told["messages"]) == ([], [])
    still, (*states, labels, (turned, playing)), (moved, pitch, *works), marks = told["results"]
    names = ["Smile", "Laugh", "Surprise", "Wink", "Anger", "Sadness", "Disgust", "Look left"]
    # Kiss goes far beyond what was filmed, and Anger a little.
    assert (still, labels) == ([0, False, False], [[name, name == "Anger"] for name in names])
    smile, rest = runtime.Avatar(portable).face({"smile": 1.0}).expression, portable.neutral.expression
    assert [state for state, _ in states] == ["true", "false", "true"]
    np.testing.assert_allclose([expression for _, expression in states], [smile, rest, smile], atol=1e-3)
    assert (turned, playing, works) == (pytest.approx(0.1), True, [False, True])
    assert moved > 20
    assert pitch < -0.2
    # What was filmed goes from 0 to 1 in `drawn_head`.
    most = portable.expression_bounds[portable.expression_names.index("jawOpen"), 1]
    assert marks == ["0%", f"{round(100 / most)}%", False]
    expect_usable(page, "await mien;", 'document.getElementById("more").click();')


@pytest.mark.parametrize("looks", [-1, 1])
def test_a_key_ends_the_first_turn_in_front(portable: runtime.PortableAvatar, tmp_path: Path, looks: int) -> None:
    """The turn begins at the side that the camera saw: a head that looks to the picture's right shows its right."""
    turned = replace(portable.neutral, head_rotation=np.array([0.05, 0.2 * looks, 0.02], np.float32))
    write_page(tmp_path / "a.html", replace(portable, neutral=turned))
    told = browse(tmp_path / "a.html", [KEY], size=(300, 200), device=["lively"], opening=CLOCK)
    ((before, after),) = told["results"]
    assert -looks * before >= 0.1
    assert after == 0


STILL = "(async () => { const v = await mien; return [v.yaw, v.playing, document.getElementById('idle').checked]; })()"
PRESS = """(async () => {
  const viewer = await mien, buttons = [...document.querySelectorAll("#faces [aria-pressed]")], told = [];
  const press = (key) => document.body.dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true }));
  for (const act of [() => buttons[0].click(), () => buttons[0].click(), () => press("1")]) {
    act();
    told.push([buttons[0].getAttribute("aria-pressed"), Array.from(viewer.face.expression)]);
  }
  const yaw = viewer.yaw;
  press("ArrowLeft");
  press(" ");
  told.push(buttons.map((button) => [button.textContent, button.title !== ""]), [viewer.yaw - yaw, viewer.playing]);
  viewer.play(false);
  document.getElementById("reset").click();
  return told;
})()"""
GAZE = """(async () => {
  const viewer = await mien, pixels = () => {
    viewer.draw();
    const { width, height } = viewer.canvas, copy = new OffscreenCanvas(width, height).getContext("2d");
    copy.drawImage(viewer.canvas, 0, 0);
    return copy.getImageData(0, 0, width, height).data;
  };
  const before = pixels(), slider = document.getElementById("eyeLookUpLeft");
  slider.value = "1";
  slider.dispatchEvent(new Event("input", { bubbles: true }));
  const after = pixels(), eye = 3 * viewer.avatar.joint_names.indexOf("left_eye");
  return [after.filter((value, k) => Math.abs(value - before[k]) > 8).length, viewer.face.joints[eye],
    viewer.setExpression("smirk", 1), viewer.setExpression("eyeLookInRight", 0.5)];
})()"""
MARKS = """(async () => {
  await mien;
  const { style } = document.getElementById("jawOpen");
  return [style.getPropertyValue("--a"), style.getPropertyValue("--b"), document.getElementById("filmed").hidden];
})()"""


OUTSIDE = """(async () => {
  await mien;
  const shown = [...document.querySelectorAll("button")].filter((each) => each.checkVisibility());
  return shown.map((each) => each.getBoundingClientRect())
    .filter(({ left, right, top, bottom }) => left < 0 || right > innerWidth || top < 0 || bottom > innerHeight);
})()"""
COLUMNS = """(async () => {
  const viewer = await mien, { canvas } = viewer;
  return [-1.2, 0, 1.2].map((yaw) => {
    viewer.yaw = yaw;
    viewer.draw();
    const { width, height } = canvas, copy = new OffscreenCanvas(width, height).getContext("2d");
    copy.drawImage(canvas, 0, 0);
    const { data } = copy.getImageData(0, 0, width, height), seen = [];
    for (let k = 3; k < data.length; k += 4) if (data[k] > 128) seen.push(((k >> 2) % width) / width);
    return [seen.reduce((a, b) => Math.min(a, b)), seen.reduce((a, b) => Math.max(a, b))];
  });
})()"""


def test_a_head_fills_a_phone_and_is_whole(portable: runtime.PortableAvatar, tmp_path: Path) -> None:
    """On a phone that is held upright, the filmed picture would leave half of the width empty."""
    small = replace(portable.camera, K=np.array([[780, 0, 256], [0, 780, 256], [0, 0, 1]], np.float32))
    write_page(tmp_path / "a.html", replace(portable, camera=small))
    sizes = ((390, 844), (600, 600))
    pages = [browse(tmp_path / "a.html", [COLUMNS, OUTSIDE], size=size, device=["touch"])["results"] for size in sizes]
    phone, square = (np.array(columns) for columns, _ in pages)
    assert [outside for _, outside in pages] == [[], []], "no face is cut off"
    assert (np.abs(phone - 0.5) < 0.48).all()
    assert np.ptp(phone[1]) > 1.4 * np.ptp(square[1])


def test_a_page_with_an_address_has_a_poster(tmp_path: Path, portable: runtime.PortableAvatar) -> None:
    options = PageOptions(title='Ada & "Bo"', address="https://example.org/heads/a.html")
    write_page(tmp_path / "a.html", portable, None, options)
    text = (tmp_path / "a.html").read_text()
    for part in (
        "<title>Ada &amp; &quot;Bo&quot;</title>",
        '<meta property="og:image" content="https://example.org/heads/a.jpg">',
        '<meta property="og:title" content="Ada &amp; &quot;Bo&quot;">',
    ):
        assert part in text
    poster = cv2.imread(str(tmp_path / "a.jpg"))
    assert poster is not None
    assert poster.shape == (POSTER[1], POSTER[0], 3)
    assert poster[200:430, 500:700].std() > 20 > 12 > poster[:, :60].std(), "a head in the middle"
    write_page(tmp_path / "b.html", portable)
    assert "og:" not in (tmp_path / "b.html").read_text()
    assert not (tmp_path / "b.jpg").exists()
    for address in ("me.html", "javascript:alert(1)", "https://"):
        refuses("is no address; give one such as", check_page, tmp_path, PageOptions(address=address))
    runtime.write_portable(tmp_path / "c.mien", replace(drawn_head(10), filmed=None))
    given = ["--title", "Ada", "--address", "https://example.org/c.html"]
    assert main(["export", str(tmp_path / "c.mien"), "--out", str(tmp_path / "c.html"), *given]) == 0
    assert (tmp_path / "c.jpg").is_file()
    assert "<title>Ada</title>" in (tmp_path / "c.html").read_text()


PAGE = '<link rel="icon" href="data:,"><canvas id="view" width="512" height="512"></canvas>'
OPEN = """
const { readAny, Viewer } = await import("./mien.js"), { findBackend } = await import("./webgpu.js");
const file = new Uint8Array(await (await fetch("NAME.packed")).arrayBuffer());
const { avatar } = await readAny(file), before = document.getElementById("view"), canvas = before.cloneNode();
window.viewer?.dispose();
before.replaceWith(canvas);
window.viewer = new Viewer(canvas, avatar, null, await findBackend("BACKEND"));
viewer.background = [1, 1, 1, 1];
"""
RESIZE = "[viewer.canvas.width, viewer.canvas.height] = [300, 300];"
CLEAR = "viewer.background = [0, 0, 0, 0];"
LOSE = """
const { drawer } = viewer.renderer;
drawer.pipelines.device.destroy();
while (viewer.renderer.drawer === drawer) await new Promise((done) => setTimeout(done, 10));
"""


@pytest.fixture(scope="module")
def site(built: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the package and an empty page, or skip the test if the browser has no WebGPU."""
    folder = Path(shutil.copytree(built, tmp_path_factory.mktemp("site"), dirs_exist_ok=True))
    (folder / "index.html").write_text(PAGE)
    if run(folder, ["(async () => Boolean(await navigator.gpu?.requestAdapter()))()"])["results"] != [True]:
        pytest.skip(NO_WEBGPU)
    return folder


def opened(name: str, backend: str = "webgpu") -> str:
    return OPEN.replace("NAME", name).replace("BACKEND", backend)


def run(site: Path, scripts: list[str], webgpu: bool = True) -> dict[str, Any]:
    with web.served(site) as address:
        return browse(f"{address}/index.html", scripts, webgpu=webgpu)


HEADS = {
    "gaussian_avatars": lambda: drawn_head(4000, rank=2, sh=4, sh_frame="world"),
    "features": lambda: drawn_head(10_011, rank=5, columns=2, features=6), "headgas": lambda: web.painted_head(1500),
    "regions": lambda: web.painted_head(1500, activations="regions"),
    "mono_gaussian_avatar": skinned_head, "colors that depend on the view": lambda: points(1500)["points"],
}  # fmt: skip


@pytest.mark.unchecked
@pytest.mark.parametrize("method", list(HEADS)[:5])
def test_pictures_are_those_of_the_native_renderer(site: Path, method: str) -> None:
    """Posed and sorted on the GPU."""
    portable = HEADS[method]()
    faces = [runtime.Face(**vars(portable.neutral)), *faces_of(portable, 2)]
    write_packed(site / "drawn.packed", portable)
    told = run(site, [script(opened("drawn")), *(script(web.taking(face), SHOW) for face in faces)])
    expect_pictures(portable, faces, told)


@pytest.mark.unchecked
@pytest.mark.parametrize("method", list(HEADS)[1:])
def test_a_page_draws_every_kind_with_webgl2(tmp_path: Path, method: str) -> None:
    portable = HEADS[method]()
    faces = [runtime.Face(**vars(portable.neutral)), *faces_of(portable, 2)]
    assert write_page(tmp_path / "a.html", portable).psnr >= 45
    told = browse(tmp_path / "a.html", ["(async () => (await mien).poser.runsNetwork)()", *map(posing, faces)])
    assert told["requests"] == []
    assert (told["results"][0] is False) == (method in ("features", "headgas", "regions")), "on the GPU"
    expect_pictures(portable, faces, told)


def expect_pictures(portable: runtime.PortableAvatar, faces: list[runtime.Face], told: dict[str, Any]) -> None:
    assert told["messages"] == []
    expected = [rendered(portable, face)[0] for face in faces]
    for truth, address in zip(expected, told["results"][1:], strict=True):
        assert likeness(address, truth) >= 45
    assert psnr(expected[1], expected[2]) < 35


def test_size_background_and_a_lost_device(site: Path) -> None:
    portable = drawn_head(3000, rank=5)
    write_packed(site / "small.packed", portable)
    (face,) = faces_of(portable, 1)
    parts = (opened("small"), web.taking(face), RESIZE, CLEAR, LOSE)
    told = run(site, [*(script(part, SHOW) for part in parts), script("viewer.dispose();")])
    _, first, smaller, clear, after, _ = told["results"]
    expected, alpha = rendered(portable, face, 300)
    assert likeness(first, rendered(portable, face)[0]) >= 45
    assert picture(smaller).shape[:2] == (300, 300)
    assert likeness(smaller, expected) >= 45
    # WebGL2 has drawn the face that WebGPU had posed.
    for address in (clear, after):
        assert np.abs(picture(address)[..., 3] - alpha).max() < 0.02
    assert psnr(picture(after)[alpha > 0.9], picture(clear)[alpha > 0.9]) >= 45
    (message,) = told["messages"]
    assert message.startswith("mien: the WebGPU device is lost (")
    assert message.endswith("; WebGL2 draws instead")


def test_webgl2_draws_where_webgpu_cannot(site: Path) -> None:
    """A browser without half floats stands for a device with too little memory."""
    lacking = "this avatar needs half floats, which this browser's WebGPU lacks"
    for portable, backend, webgpu, before, reason in (
        (drawn_head(500), "webgpu", False, "", "WebGPU has no adapter here"),
        (drawn_head(500), "auto", True, "", "WebGPU has an adapter in software only"),
        (drawn_head(500), "webgl2", True, "", None),
        (web.painted_head(300), "webgpu", True, "delete window.Float16Array;", lacking),
    ):
        write_packed(site / "few.packed", portable)
        told = run(site, [script(before, opened("few", backend), SHOW)], webgpu=webgpu)
        # Chromium itself has a word to say about adapters.
        ours = [message for message in told["messages"] if message.startswith("mien")]
        assert ours == ([f"mien: {reason}; WebGL2 draws instead"] if reason else [])
        assert likeness(told["results"][0], rendered(portable)[0]) >= 45, reason


def test_a_page_draws_with_webgpu(site: Path, tmp_path: Path) -> None:
    """If it is asked to by its address. By itself it does so on a GPU only."""
    portable, page = drawn_head(3000, rank=2), tmp_path / "a.html"
    write_page(page, portable, None, PageOptions(webgpu=True))
    plain = write_page(tmp_path / "b.html", portable)
    assert 0 < page.stat().st_size - plain.size < 25_000
    (face,) = faces_of(portable, 1)
    told = browse(page, [posing(face), REST, script(WHITE, SLIDE, SHOW)], fragment="webgpu", webgpu=True)
    assert (told["requests"], told["messages"]) == ([], [])
    posed, rest, slid = told["results"]
    assert likeness(posed, rendered(portable, face)[0]) >= 45
    assert np.abs(picture(slid) - picture(rest)).max() > 0.1
    told = browse(page, ["mien.then(() => 0)"], webgpu=True)
    assert told["messages"] == ["mien: WebGPU has an adapter in software only; WebGL2 draws instead"]


def test_the_element_draws_with_webgpu(site: Path) -> None:
    portable = drawn_head(3000, rank=2)
    write_packed(site / "me.packed", portable)
    (site / "element.html").write_text(
        '<link rel="icon" href="data:,"><script type="module" src="element.js"></script>'
        '<mien-avatar src="me.packed" backend="webgpu" expression="jawOpen:0.5"></mien-avatar>'
    )
    steps = [script(LOADED, SHOT), "Boolean(avatar.viewer.renderer.drawer)"]
    with web.served(site) as address:
        told = browse(f"{address}/element.html", steps, webgpu=True)
    assert (told["messages"], told["results"][1]) == ([], True)
    assert likeness(told["results"][0], rendered(portable, {"jawOpen": 0.5}, 320)[0]) >= 45
