"""The element <mien-avatar>, the playground and the example in three.js, in a real browser."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from mien import runtime
from mien.export import write_glb, write_packed
from test_glb import mesh_model
from web_case import WEB, browse, bundle, drawn_head, expect_usable, likeness, picture, psnr, rendered, script, served

EXAMPLES = WEB / "examples"
LOADED = """
window.avatar = document.querySelector("mien-avatar");
if (!avatar.viewer) await new Promise((done, fail) => {
  avatar.addEventListener("load", done);
  avatar.addEventListener("error", (event) => fail(new Error(event.detail)));
});
"""
AHEAD = """
const { head } = avatar.viewer.view(100, 100);
return -(head[0] * head[3] + head[4] * head[7] + head[8] * head[11]);
"""
"""How far the camera is to the person's left: its place in the head frame is -R^T t of the view."""
SHOT = """
const { viewer } = avatar;
[viewer.canvas.width, viewer.canvas.height] = [320, 320];
viewer.background = [1, 1, 1, 1];
viewer.draw();
return viewer.canvas.toDataURL();
"""
PAGE = '<link rel="icon" href="data:,"><canvas id="scene" style="width: 400px; height: 400px"></canvas>'
ONE_BY_ONE = "for (const [name, value] of [['jawOpen', 0.7], ['eyeBlinkLeft', 1]]) avatar.setExpression(name, value);"
STILL = """
avatar.removeAttribute("idle");
for (let i = 0; i < 3; ++i) await new Promise(requestAnimationFrame);
avatar.expression = "jawOpen:0";
"""


@pytest.fixture(scope="module")
def site(built: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the package, an avatar, and the examples of the element and of the playground."""
    folder = Path(shutil.copytree(built, tmp_path_factory.mktemp("site"), dirs_exist_ok=True))
    write_packed(folder / "me.packed", drawn_head(2000, rank=2))
    shutil.copy(EXAMPLES / "element.html", folder / "index.html")
    shutil.copy(EXAMPLES / "playground.html", folder)
    return folder


def test_the_element_shows_an_avatar(site: Path) -> None:
    steps = [
        script(LOADED, STILL, SHOT),
        script("avatar.expression = 'jawOpen:0.7, eyeBlinkLeft:1';", SHOT),
        script("avatar.expression = '';", ONE_BY_ONE, SHOT),
        script("avatar.setAttribute('yaw', '20');", SHOT),
        *(script(f"avatar.setAttribute('yaw', '{yaw}');", AHEAD) for yaw in (0, 30, -30)),
        "[...['role', 'aria-label'].map((name) => avatar.getAttribute(name)), avatar.setExpression('smirk', 1),"
        " avatar.viewer.canvas.tabIndex]",
        script("avatar.remove(); const gone = avatar.viewer; document.body.append(avatar);", LOADED, "return gone;"),
        script(
            "const told = new Promise((done) => avatar.addEventListener('error', (event) => done(event.detail)));",
            "avatar.src = 'nobody.packed'; const said = await told, box = avatar.shadowRoot;",
            "const words = box.querySelector('p[part=error][role=alert]').textContent;",
            "return [said, words, box.querySelectorAll('canvas').length];",
        ),
    ]  # fmt: skip
    with served(site) as address:
        told = browse(f"{address}/index.html", steps, size=(500, 600))
    rest, open_, same, turned, ahead, left, right, facts, gone, error = told["results"]
    assert left - 0.2 > ahead > right + 0.2, "yaw goes to the left of the person, as for `mien render --yaw`"
    head = drawn_head(2000, rank=2)
    shut, wide = (rendered(head, face, 320)[0] for face in ({"jawOpen": 0.0}, {"jawOpen": 0.7, "eyeBlinkLeft": 1.0}))
    np.testing.assert_array_equal(picture(open_), picture(same))
    assert likeness(rest, shut) >= 45
    assert likeness(open_, wide) >= 45
    assert psnr(shut, wide) < 40
    assert likeness(turned, wide) < 30
    assert facts == ["img", "Avatar of drawn", False, 0]
    assert gone is None
    words = "nobody.packed cannot be fetched: the server answers 404"
    assert error == [words, words, 0], "the box says it, too"
    assert all(request.startswith(address) for request in told["requests"])
    # Once for the page, and once when it came back.
    assert sum(request.endswith("me.packed") for request in told["requests"]) == 2


def test_an_avatar_stands_in_a_scene_of_three(site: Path) -> None:
    """It is seen by the scene's camera, hides what is behind it, and is hidden by what is before it."""
    bundle(EXAMPLES / "three" / "main.js", site / "main.bundle.js", f"--alias:mien-web={site / 'mien.js'}")
    (site / "three.html").write_text(PAGE)
    begin = """
      const { start } = await import("./main.bundle.js");
      const file = new Uint8Array(await (await fetch("me.packed")).arrayBuffer());
      window.made = await start(document.getElementById("scene"), file);
    """
    shot = "made.look(%g); return document.getElementById('scene').toDataURL();"
    hidden = "for (const box of Object.values(made.boxes)) box.visible = false;"
    places = """
      const { camera, boxes } = made;
      return Object.values(boxes).map((box) => { const p = box.position.clone().project(camera); return [p.x, p.y]; });
    """
    steps = [script(begin, shot % 0), script(places), script(hidden, shot % 0), script(shot % 20)]
    with served(site) as address:
        told = browse(f"{address}/three.html", steps, size=(600, 600))
    assert told["messages"] == []
    scene, (front, _), alone, turned = told["results"]
    scene, alone, turned = (picture(address)[..., :3] for address in (scene, alone, turned))
    row, column = round((1 - front[1]) / 2 * 400), round((1 + front[0]) / 2 * 400)
    assert scene[row, column, 0] > 2 * scene[row, column, 2], "the red box before the head"
    assert np.abs(scene - alone)[row, column].max() > 0.1
    # The whole blue box would take 0.16 of the picture.
    assert 0.03 < (scene[..., 2] > scene[..., 0] + 0.3).mean() < 0.11
    exact = runtime.Avatar(drawn_head(2000, rank=2))
    moved = runtime.Gaussians(**{**vars(exact.pose()), "T_world_local": np.eye(4, dtype=np.float32)})
    (expected, alpha), (aside, _) = (
        exact.render(moved, scene_camera(np.radians(degrees), 400), background=(0xDD / 255, 0xE4 / 255, 0xEA / 255))
        for degrees in (0.0, 20.0)
    )
    assert psnr(alone, expected) >= 40
    assert psnr(turned, aside) >= 40
    # Where the head is opaque, the box behind it changes nothing.
    near_blue = np.s_[:200, :200]
    assert np.abs(scene - alone).max(-1)[near_blue][alpha[near_blue] > 0.99].max() < 0.03


DROP = """
  const words = document.getElementById("words"), data = new DataTransfer();
  data.items.add(new File([await (await fetch("%s")).arrayBuffer()], "%s"));
  dispatchEvent(new DragEvent("drop", { dataTransfer: data, cancelable: true }));
  while (!/drag it|cannot|is not/.test(words.textContent)) await new Promise((done) => setTimeout(done, 50));
"""
SEEN = """
  for (let i = 0; i < 4; ++i) await new Promise(requestAnimationFrame);
  const faces = document.querySelectorAll("nav button").length;
  return [words.textContent, document.querySelector("canvas").toDataURL(), faces];
"""


def test_any_file_can_be_dropped_on_the_playground(site: Path) -> None:
    """A .packed, a .mien and a .glb show the same person, and a face moves it; anything else is told."""
    drawn = drawn_head(1000)
    write_packed(site / "same.packed", drawn)
    runtime.write_portable(site / "same.mien", drawn)
    write_glb(site / "same.glb", drawn, mesh_model(drawn), 64)
    (site / "none.txt").write_text("nobody")
    kept = """
      const get = HTMLCanvasElement.prototype.getContext;
      HTMLCanvasElement.prototype.getContext = function (kind, made) {
        return get.call(this, kind, { ...made, preserveDrawingBuffer: true });
      };
    """
    names = ("same.packed", "same.mien", "same.glb")
    steps = [script(DROP % (name, name), SEEN) for name in names]
    steps += [script("document.querySelector('nav button').click(); const words = { textContent: '' };", SEEN)]
    steps += [script(DROP % ("none.txt", "none.txt"), SEEN)]
    with served(site) as address:
        told = browse(f"{address}/playground.html", steps, size=(600, 700), opening=kept)
    words, addresses, faces = zip(*told["results"], strict=True)
    assert words[:3] == tuple(f"{name}: drag it, or press a face." for name in names)
    assert words[4] == "none.txt is not a .mien file"
    assert faces[2] > 5
    # Colours of clear pixels are rounded, so they count by their alpha.
    packed, mien, glb, smile = (picture(url)[..., :3] * picture(url)[..., 3:] for url in addresses[:4])
    assert packed.std() > 0.05, "somebody is seen"
    assert psnr(packed, mien) >= 40
    np.testing.assert_array_equal(mien, glb)
    assert psnr(smile, glb) < 45


def test_everybody_can_use_the_playground(site: Path) -> None:
    with served(site) as address:
        expect_usable(f"{address}/playground.html", "", DROP % ("me.packed", "me.packed"))


def scene_camera(turn: float, side: int) -> runtime.Camera:
    """The camera of the example, which looks at the origin from 0.8 m, with OpenCV's axes."""
    eye = np.array([0.8 * np.sin(turn), 0.05, 0.8 * np.cos(turn)])
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0, 1, 0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ eye
    focal = side / (2 * np.tan(np.radians(25) / 2))
    K = np.array([[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1]])
    return runtime.Camera(K.astype(np.float32), viewmat.astype(np.float32), side, side)
