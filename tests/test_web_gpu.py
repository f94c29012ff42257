"""The back end in WebGPU draws as the native renderer does, and WebGL2 takes over where it is missing or lost."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import web_case as web
from mien import runtime
from mien.formats.page import write_packed, write_page
from needs import NO_WEBGPU
from test_web import REST, SHOW, SLIDE, WHITE, points, posing, skinned_head
from test_web_element import LOADED, SHOT
from web_case import browse, drawn_head, faces_of, likeness, picture, psnr, rendered, script

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
    "some columns": lambda: drawn_head(10_011, rank=5, columns=2),
    "headgas": lambda: web.painted_head(1500),
    "mono_gaussian_avatar": skinned_head,
    "colors that depend on the view": lambda: points(1500)["points"],
}


@pytest.mark.unchecked
@pytest.mark.parametrize("method", list(HEADS)[:4])
def test_pictures_are_those_of_the_native_renderer(site: Path, method: str) -> None:
    """Posed and sorted on the GPU."""
    portable = HEADS[method]()
    faces = [runtime.Face(**vars(portable.neutral)), *faces_of(portable, 2)]
    write_packed(site / "drawn.packed", portable)
    told = run(site, [script(opened("drawn")), *(script(web.taking(face), SHOW) for face in faces)])
    expect_pictures(portable, faces, told)


@pytest.mark.unchecked
@pytest.mark.parametrize("method", list(HEADS)[2:])
def test_a_page_draws_every_kind_with_webgl2(tmp_path: Path, method: str) -> None:
    portable = HEADS[method]()
    faces = [runtime.Face(**vars(portable.neutral)), *faces_of(portable, 2)]
    assert write_page(tmp_path / "a.html", portable).psnr >= 45
    told = browse(tmp_path / "a.html", ["(async () => (await mien).poser.runsNetwork)()", *map(posing, faces)])
    assert told["requests"] == []
    assert (told["results"][0] is False) == (method == "headgas"), "its network runs on the GPU"
    expect_pictures(portable, faces, told)


def expect_pictures(portable: runtime.PortableAvatar, faces: list[runtime.Face], told: dict[str, Any]) -> None:
    assert told["messages"] == []
    expected = [rendered(portable, face)[0] for face in faces]
    for truth, address in zip(expected, told["results"][1:], strict=True):
        assert likeness(address, truth) >= 45
    assert psnr(expected[1], expected[2]) < 35


def test_size_background_and_a_lost_device(site: Path) -> None:
    portable = drawn_head(3000, rank=2)
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
    write_page(page, portable, webgpu=True)
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
