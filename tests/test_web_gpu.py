"""The back end in WebGPU draws as the native renderer does, and WebGL2 takes over where it is missing or lost."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mien import runtime
from mien.export import write_packed
from needs import NO_WEBGPU
from test_web import SIDE, picture, psnr
from test_web_element import script, served
from test_web_skinned import skinned_head
from web_case import as_json, browse, build, chromium, drawn_head, faces_of, painted_head

ADAPTER = "(async () => Boolean(await navigator.gpu?.requestAdapter()))()"
PAGE = '<link rel="icon" href="data:,"><canvas id="view" width="512" height="512"></canvas>'
OPEN = """
const { readAny, Viewer } = await import("./mien.js"), { findBackend } = await import("./webgpu.js");
const file = new Uint8Array(await (await fetch("NAME.packed")).arrayBuffer());
const { avatar } = await readAny(file), canvas = document.getElementById("view");
window.viewer = new Viewer(canvas, avatar, null, await findBackend("BACKEND"));
viewer.background = [1, 1, 1, 1];
"""
DRAW = """
viewer.draw();
return canvas.toDataURL("image/png");
"""
POSE = """
const { canvas } = viewer, face = FACE;
viewer.take(Object.fromEntries(Object.entries(face).map(([name, values]) => [name, Float32Array.from(values)])));
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the package and an empty page, in a browser that has WebGPU."""
    chromium()
    folder = build(tmp_path_factory.mktemp("site"))
    (folder / "index.html").write_text(PAGE)
    with served(folder) as address:
        if browse(f"{address}/index.html", [ADAPTER], webgpu=True)["results"] != [True]:
            pytest.skip(NO_WEBGPU)
    return folder


def opened(name: str, backend: str = "webgpu") -> str:
    return OPEN.replace("NAME", name).replace("BACKEND", backend)


def run(site: Path, scripts: list[str], webgpu: bool = True) -> dict[str, Any]:
    with served(site) as address:
        return browse(f"{address}/index.html", scripts, webgpu=webgpu)


HEADS = {
    "gaussian_avatars": lambda: drawn_head(12_000, rank=2, sh=4, sh_frame="world"),
    "headgas": lambda: painted_head(5000),
    "mono_gaussian_avatar": skinned_head,
}


@pytest.mark.slow
@pytest.mark.parametrize("method", HEADS)
def test_webgpu_draws_as_the_native_renderer(site: Path, method: str) -> None:
    portable = HEADS[method]()
    write_packed(site / f"{method}.packed", portable)
    faces = [runtime.Face(**vars(portable.neutral)), *faces_of(portable, 2)]
    poses = [script(POSE.replace("FACE", json.dumps(face)), DRAW) for face in as_json(faces)]
    told = run(site, [script(opened(method)), *poses])
    assert told["messages"] == []
    exact = runtime.Avatar(portable)
    camera = exact.camera.resized(SIDE, SIDE)
    expected = [exact.render(runtime.pose(portable.baked, face), camera)[0] for face in faces]
    for truth, address in zip(expected, told["results"][1:], strict=True):
        assert psnr(picture(address)[..., :3], truth) >= 45
    assert psnr(expected[1], expected[2]) < 35
