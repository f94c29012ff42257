"""The page as people meet it: it opens alive, its faces are buttons, and everybody can use it."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mien import runtime
from mien.cli import main
from mien.export import Described, write_page
from mien.export.page_head import POSTER, check_address
from refusals import refuses
from web_case import browse, drawn_head, expect_usable, faces_of, motion_of

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
    assert still == [0, False, False]
    assert labels[:4] == ["Smile", "Laugh", "Surprise", "Wink"]
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
  told.push(buttons.map((button) => button.textContent), [viewer.yaw - yaw, viewer.playing]);
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
    described = Described('Ada & "Bo"', "https://example.org/heads/a.html")
    write_page(tmp_path / "a.html", portable, described=described)
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
        refuses("is no address; give one such as", check_address, address)
    runtime.write_portable(tmp_path / "c.mien", replace(drawn_head(10), filmed=None))
    given = ["--title", "Ada", "--address", "https://example.org/c.html"]
    assert main(["export", str(tmp_path / "c.mien"), "--out", str(tmp_path / "c.html"), *given]) == 0
    assert (tmp_path / "c.jpg").is_file()
    assert "<title>Ada</title>" in (tmp_path / "c.html").read_text()
