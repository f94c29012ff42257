"""The element <mien-avatar>, the playground, and the starter with the package of npm."""

import json
import shutil
import subprocess
import tarfile
from pathlib import Path

import numpy as np
import pytest

import web_case as web
from mien import runtime
from mien.formats.glb import write_glb
from mien.formats.page import write_packed
from test_glb import mesh_model

EXAMPLES = web.WEB / "examples"
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
PIXELS = "const { width, height } = avatar.viewer.canvas; avatar.style = ''; return width * height;"
ONE_BY_ONE = "for (const [name, value] of [['jawOpen', 0.7], ['eyeBlinkLeft', 1]]) avatar.setExpression(name, value);"
STILL = """
avatar.removeAttribute("idle");
for (let i = 0; i < 3; ++i) await new Promise(requestAnimationFrame);
avatar.expression = "jawOpen:0";
"""


@pytest.fixture(scope="module")
def site(built: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = Path(shutil.copytree(built, tmp_path_factory.mktemp("site"), dirs_exist_ok=True))
    write_packed(folder / "me.packed", web.drawn_head(2000, rank=2))
    shutil.copy(EXAMPLES / "element.html", folder / "index.html")
    shutil.copy(EXAMPLES / "playground.html", folder)
    return folder


def test_the_element_shows_an_avatar(site: Path) -> None:
    steps = [
        web.script(LOADED, STILL, SHOT),
        web.script("avatar.expression = 'jawOpen:0.7, eyeBlinkLeft:1';", SHOT),
        web.script("avatar.expression = '';", ONE_BY_ONE, SHOT),
        web.script("avatar.setAttribute('yaw', '20');", SHOT),
        *(web.script(f"avatar.setAttribute('yaw', '{yaw}');", AHEAD) for yaw in (0, 30, -30)),
        web.script("avatar.style = 'width: 2000px; height: 1600px';", STILL, PIXELS),
        "[...['role', 'aria-label'].map((name) => avatar.getAttribute(name)), avatar.setExpression('smirk', 1),"
        " avatar.viewer.canvas.tabIndex]",
        web.script("avatar.remove(); const gone = avatar.viewer; document.body.append(avatar);", LOADED, "return gone"),
        web.script(
            "const told = new Promise((done) => avatar.addEventListener('error', (event) => done(event.detail)));",
            "avatar.src = 'nobody.packed'; const said = await told, box = avatar.shadowRoot;",
            "const words = box.querySelector('p[part=error][role=alert]').textContent;",
            "return [said, words, box.querySelectorAll('canvas').length];",
        ),
    ]  # fmt: skip
    with web.served(site) as address:
        told = web.browse(f"{address}/index.html", steps, size=(500, 600))
    rest, open_, same, turned, ahead, left, right, pixels, facts, gone, error = told["results"]
    assert left - 0.2 > ahead > right + 0.2, "yaw goes to the left of the person, as for `mien render --yaw`"
    head = web.drawn_head(2000, rank=2)
    shut, wide = (
        web.rendered(head, face, 320)[0] for face in ({"jawOpen": 0.0}, {"jawOpen": 0.7, "eyeBlinkLeft": 1.0})
    )
    np.testing.assert_array_equal(web.picture(open_), web.picture(same))
    assert web.likeness(rest, shut) >= 45
    assert web.likeness(open_, wide) >= 45
    assert web.psnr(shut, wide) < 40
    assert web.likeness(turned, wide) < 30
    assert facts == ["img", "Avatar of drawn", False, 0]
    assert 1_590_000 < pixels < 1_610_000, "a large one is as sharp as a device can afford"
    assert gone is None
    words = "nobody.packed cannot be fetched: the server answers 404"
    assert error == [words, words, 0], "the box says it, too"
    assert all(request.startswith(address) for request in told["requests"])
    # Once for the page, and once when it came back.
    assert sum(request.endswith("me.packed") for request in told["requests"]) == 2


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
    drawn = web.drawn_head(1000)
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
    steps = [web.script(DROP % (name, name), SEEN) for name in names]
    steps += [web.script("document.querySelector('nav button').click(); const words = { textContent: '' };", SEEN)]
    steps += [web.script(DROP % ("none.txt", "none.txt"), SEEN)]
    with web.served(site) as address:
        told = web.browse(f"{address}/playground.html", steps, size=(600, 700), opening=kept)
    words, addresses, faces = zip(*told["results"], strict=True)
    assert words[:3] == tuple(f"{name}: drag it, or press a face." for name in names)
    assert words[4] == "none.txt is not a .mien file"
    assert faces[2] > 5
    # Colours of clear pixels are rounded, so they count by their alpha.
    packed, mien, glb, smile = (web.picture(url)[..., :3] * web.picture(url)[..., 3:] for url in addresses[:4])
    assert packed.std() > 0.05, "somebody is seen"
    assert web.psnr(packed, mien) >= 40
    np.testing.assert_array_equal(mien, glb)
    assert web.psnr(smile, glb) < 45
    with web.served(site) as address:
        web.expect_usable(f"{address}/playground.html", "", DROP % ("me.packed", "me.packed"))


SURPRISE = """
const buttons = [...document.querySelectorAll("nav button")];
const jaw = avatar.viewer.avatar.expression_names.indexOf("jawOpen");
buttons.find((button) => /surprise/i.test(button.textContent)).click();
avatar.viewer.draw();
return [buttons.length, avatar.viewer.face.expression[jaw], avatar.viewer.canvas.toDataURL()];
"""


def npm(folder: Path, *arguments: str | Path) -> str:
    command = [shutil.which("npm") or "npm", *map(str, arguments)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def packed(built: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("package")
    for name in ("package.json", "README.md", "LICENSE"):
        shutil.copy(web.WEB / name, folder)
    shutil.copytree(built, folder / "dist")
    npm(web.WEB, "run", "types", "--", "--outDir", folder / "dist" / "types")
    npm(folder, "pack", "--ignore-scripts")
    (found,) = folder.glob("mien-web-*.tgz")
    return found


def test_the_starter_is_built_as_its_readme_says_and_shows_an_avatar(packed: Path, tmp_path: Path) -> None:
    """It takes the package from the folder above it, since no registry has it."""
    with tarfile.open(packed) as package:
        package.extractall(tmp_path, filter="data")
    starter = Path(shutil.copytree(web.WEB / "examples" / "starter", tmp_path / "package" / "examples" / "starter"))
    npm(starter, "install", "--no-audit", "--no-fund")
    write_packed(starter / "public" / "me.packed", web.drawn_head(500))
    npm(starter, "run", "build")
    with web.served(starter / "dist") as address:
        told = web.browse(address, [web.script(LOADED, SURPRISE)], size=(640, 480))
        assert web.violations(address, (390, 844), (), "", LOADED) == [], "before and after its avatar is there"
    ((count, jaw, shown),) = told["results"]
    assert told["messages"] == []
    assert count >= 6
    assert jaw > 0.1
    assert len(np.unique(web.picture(shown).reshape(-1, 4), axis=0)) > 500, "a head in many colours is drawn"
    # The package has every file that package.json names, with types, and nothing else goes to a registry.
    package = json.loads((web.WEB / "package.json").read_text())
    assert "dependencies" not in package
    readme = (web.WEB / "README.md").read_text()
    assert "](" not in readme.replace("](https://", ""), "links to files of the repository lead nowhere on npm"
    assert (web.WEB / "LICENSE").read_text() == (web.WEB.parent / "LICENSE").read_text()
    with tarfile.open(packed) as archive:
        files = {name.removeprefix("package/") for name in archive.getnames()}
    wanted = {path.removeprefix("./") for export in package["exports"].values() for path in export.values()}
    assert wanted <= files
    beside = {"README.md", "LICENSE", "package.json"}
    assert beside <= files
    assert all(path.startswith("dist/") for path in files - beside)
