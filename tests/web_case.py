"""Avatars without a person for the tests of web pages, and programs that these tests need."""

import atexit
import base64
import json
import math
import os
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from mien import runtime
from mien.avatar.baking import make_portable
from mien.avatar.gaussian_avatars.avatar import GaussianAvatars
from mien.avatar.headgas.avatar import HeadGas
from mien.avatar.headgas.settings import HeadGasConfig
from mien.face import load_face_model
from mien.formats.shared.packed import Motion, pack, unpacked
from mien.runtime.baked import FeatureChanges, HeadActivations
from mien.runtime.posing import expression_changes, rig_points
from needs import NO_CHROMIUM, NO_NODE, NO_NODE_PACKAGES, NO_TASKS_VISION
from plain_settings import plain_gaussian_avatars
from toy_scene import toy_camera

WEB = Path(__file__).parent.parent / "web"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
PATIENCE_SECONDS = 300.0
"""Time after which a page or a script of node counts as hung."""


def package(name: str, missing: str = NO_NODE_PACKAGES) -> Path:
    """Return the folder of a package of npm, or skip the test."""
    folder = WEB / "node_modules" / name
    if not folder.is_dir():
        pytest.skip(missing)
    return folder


def node() -> str:
    """Return the path of node, or skip the test."""
    found = shutil.which("node")
    if found is None:
        pytest.skip(NO_NODE)
    package("esbuild")
    return found


def found_chromium() -> str:
    return os.environ.get("MIEN_CHROMIUM") or next(filter(None, map(shutil.which, BROWSERS)), "")


def chromium() -> str:
    """Return the path of Chromium, or skip the test."""
    return found_chromium() or pytest.skip(NO_CHROMIUM)


def tasks_vision() -> Path:
    """Return the folder of MediaPipe's face landmarker for pages, or skip the test."""
    node()
    return package("@mediapipe/tasks-vision", NO_TASKS_VISION)


def build(folder: Path) -> Path:
    subprocess.run([node(), str(WEB / "build.mjs"), str(folder)], check=True, capture_output=True)
    return folder


def bundle(source: Path, out: Path, *options: str) -> None:
    command = [node(), str(WEB / "node_modules" / "esbuild" / "bin" / "esbuild"), str(source), "--bundle"]
    command += ["--format=esm", f"--outfile={out}", *options]
    # A fresh build lies elsewhere than the packages.
    packages = os.environ | {"NODE_PATH": str(WEB / "node_modules")}
    subprocess.run(command, check=True, capture_output=True, env=packages)


class _Server:
    """A process of node that serves all tests of a worker, with one browser (web/tests/server.mjs)."""

    def __init__(self) -> None:
        command = [node(), str(WEB / "tests" / "server.mjs"), found_chromium()]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        atexit.register(self.end)

    def end(self) -> None:
        try:
            self.process.communicate(timeout=PATIENCE_SECONDS)
        except (subprocess.TimeoutExpired, ValueError, OSError):
            self.process.kill()

    def ask(self, question: dict[str, Any]) -> Any:
        """Return the answer to one question. A process that hangs is killed."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        hangs = threading.Timer(PATIENCE_SECONDS, self.process.kill)
        hangs.start()
        self.process.stdin.write(json.dumps(question, default=str) + "\n")
        self.process.stdin.flush()
        answer = self.process.stdout.readline()
        hangs.cancel()
        assert answer, "web/tests/server.mjs has ended, or was killed because it did not answer"
        told = json.loads(answer)
        assert "error" not in told, told["error"]
        return told.get("told")


_servers: list[_Server] = []


def ask_node(**question: Any) -> Any:
    if not _servers or _servers[-1].process.poll() is not None:
        _servers.append(_Server())
    return _servers[-1].ask(question)


def run_node(script: str, *given: Any) -> Any:
    """Return what the function of a script in web/tests returns."""
    return ask_node(run=script, given=given)


def pose_by_node(built: Path, path: Path, faces: list[runtime.Face], sizes: Sequence[int] = ()) -> list[Any]:
    """Return what the web runtime computes for each face of a file, in parts of these sizes, if they are given."""
    out = path.with_suffix(".out")
    run_node("pose.mjs", built / "mien.js", path, as_json(faces), out)
    rows = np.fromfile(out, np.float32).reshape(len(faces), -1)
    return [np.split(row, np.cumsum(sizes)[:-1]) for row in rows] if sizes else list(rows)


def stored(path: Path, portable: runtime.PortableAvatar) -> runtime.PortableAvatar:
    """Write a .mien or a .packed file, and return the avatar that it holds."""
    if path.suffix == ".mien":
        runtime.write_portable(path, portable)
        return portable
    path.write_bytes(pack(portable))
    return unpacked(portable)


def posed_by_python(baked: runtime.MeshBound, face: runtime.Face) -> tuple[np.ndarray, ...]:
    """Return points, centres in the head frame, raw opacities and first colours, as `pose_by_node` does."""
    changes = expression_changes(baked.changes, face, baked.face_index) if baked.changes else {}
    return (
        rig_points(baked.rig, face),
        runtime.pose(replace(baked, sh_frame="head"), face).means,
        baked.attributes.opacity_logits + changes.get("opacity_logits", 0),
        baked.attributes.sh[:, 0] + changes.get("color", 0),
    )


def browse(
    page: Path | str, scripts: Sequence[str] = (), size: tuple[int, int] = (900, 600), fragment: str = "",
    device: Sequence[str] = (), **more: Any,
) -> dict[str, Any]:  # fmt: skip
    """Run scripts in a page, a file or an address: their `results`, all `requests`, and `messages` of the console.
    The browser is what `device` lists: lively (it does not ask for reduced motion), dark, touch, mobile. See
    web/tests/browser.mjs for what `more` can ask for, such as screenshots and flags."""
    chromium()
    address = f"{page}#{fragment}" if fragment else str(page)
    told = {"width": size[0], "height": size[1], "scripts": list(scripts), **dict.fromkeys(device, True), **more}
    return ask_node(page=address, **told)


def until(done: Callable[[], bool], seconds: float = PATIENCE_SECONDS) -> None:
    ends = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < ends, "it never came"
        time.sleep(0.01)


_Quiet = type("_Quiet", (SimpleHTTPRequestHandler,), {"log_message": lambda *_: None})


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve a folder from loopback, as a web server of one's own does."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(folder))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()


def script(*parts: str) -> str:
    return "(async () => {" + "".join(parts) + "})()"


def picture(address: str) -> np.ndarray:
    """Decode the picture that a page returned, as RGB or RGBA, 0 to 1."""
    data = np.frombuffer(base64.b64decode(address.partition(",")[2]), np.uint8)
    pixels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    assert pixels is not None
    return pixels[..., [2, 1, 0, 3][: pixels.shape[-1]]].astype(np.float32) / 255


def rendered(
    portable: runtime.PortableAvatar, face: runtime.Face | dict[str, float] | None = None, side: int = 512
) -> tuple[np.ndarray, np.ndarray]:
    """Return the picture and the alpha of a face, or of expressions, by the native renderer."""
    exact = runtime.Avatar(portable)
    posed = runtime.pose(portable.baked, face) if isinstance(face, runtime.Face) else exact.pose(face)
    return exact.render(posed, exact.camera.resized(side, side))


def likeness(address: str, truth: np.ndarray) -> float:
    return psnr(picture(address)[..., :3], truth)


def psnr(first: np.ndarray, second: np.ndarray) -> float:
    error = np.square(first.clip(0, 1) - second.clip(0, 1), dtype=np.float64).mean()
    return float(-10 * np.log10(error)) if error > 0 else math.inf  # two back ends may draw the same bytes


def violations(page: Path | str, size: tuple[int, int], device: Sequence[str] = (), *steps: str) -> list[list[str]]:
    """Return what axe-core finds in a page with all parts unfolded: each rule, and the first element that breaks it.
    With steps, which are JavaScript, the page is looked at after each of them."""
    node()
    axe = (package("axe-core") / "axe.min.js").read_text()
    look = """
      document.querySelectorAll("details").forEach((each) => (each.open = true));
      const { violations } = await axe.run();
      return violations.map(({ id, nodes }) => [id, nodes[0].html.slice(0, 200)]);
    """
    told = browse(page, [f"{axe};0", *(script(step, look) for step in steps or ("",))], size, device=device)
    return [found for each in told["results"][1:] for found in each]


def expect_usable(page: Path | str, *steps: str) -> None:
    for size, device in (((1280, 800), ()), ((390, 844), ("dark", "touch"))):
        assert violations(page, size, device, *steps) == []


def drawn_head(
    count: int, rank: int = 0, sh: int = 1, sh_frame: str = "head", columns: int | None = None, features: int = 0
) -> runtime.PortableAvatar:
    """Return `count` Gaussians in random colours on the mean head of anny, 0.9 m in front of the camera.
    Each has `rank` activations, of which the bases take the first `columns` (None: all): of five regions, whose shares
    are random, and of the head's pose. `features` are without numbers of their own and biases."""
    model = load_face_model("anny")
    portable = make_portable(
        GaussianAvatars(plain_gaussian_avatars(), model, model.neutral()), toy_camera(512), "drawn"
    )
    baked, random = portable.baked, np.random.default_rng(0)
    assert isinstance(baked, runtime.MeshBound)

    def some(spread: float, *shape: int) -> np.ndarray:
        return (spread * random.standard_normal((count, *shape))).astype(np.float32)

    attributes = runtime.Attributes(some(1, 4), some(0.3, 3) - np.float32(1), some(2), some(0.7, sh, 3))

    def normal(*shape: int, spread: float = 1.0, seed: int = 1) -> np.ndarray:
        return (spread * np.random.default_rng(seed).standard_normal(shape)).astype(np.float32)

    inputs = len(portable.neutral.expression) + portable.neutral.joints.size
    changes, filmed = None, None
    if rank:
        regions, pose, rest = 5, rank // 2, np.zeros(inputs, np.float32)
        own, taken = regions * (rank - pose), columns or rank
        at_rest = normal(6, spread=0.1) - np.array([0, 0, 0, 0, 0, 0.9], np.float32)
        head = HeadActivations(at_rest, normal(6, pose, spread=4.0), normal(7, pose))
        shares = np.random.default_rng(2).dirichlet(np.ones(regions), len(baked.faces)).astype(np.float32)
        shares[::3] = np.eye(regions, dtype=np.float32)[0]
        parts = (some(0.3, 3, taken), some(0.3, taken), some(0.1, 3, taken))
        network = None
        if features:
            layers = (normal(32, features, spread=0.3), normal(4, 32, spread=0.3))
            zeros = tuple(np.zeros(len(layer), np.float32) for layer in layers)
            network = FeatureChanges(some(0.3, features), some(0.3, rank, features), some(1, 0), layers, zeros)
        changes = runtime.ExpressionChanges(
            rest, normal(inputs, own), normal(7, own), *parts, network, columns, shares, head
        )
        highest = rest + 1
        for name, most in (("mouthPucker", 0), ("browDownLeft", 0.2)):
            highest[portable.expression_names.index(name)] = rest[portable.expression_names.index(name)] + most
        filmed = runtime.Filmed(rest, highest, np.zeros((2, 2), np.float32))
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
    turn, place = np.array([0.05, -0.1, 0.02], np.float32), np.array([0.01, 0.02, -0.9], np.float32)
    neutral = replace(portable.neutral, head_rotation=turn, head_translation=place)
    return replace(portable, neutral=neutral, camera=replace(portable.camera, K=K))


def faces_of(portable: runtime.PortableAvatar, count: int) -> list[runtime.Face]:
    random, neutral = np.random.default_rng(1), portable.neutral

    def some(like: np.ndarray, spread: float) -> np.ndarray:
        return (spread * random.standard_normal(like.shape)).astype(np.float32)

    def face() -> runtime.Face:
        expression, joints = np.abs(some(neutral.expression, 0.4)), some(neutral.joints, 0.2)
        rotation = neutral.head_rotation + some(neutral.head_rotation, 0.1)
        return runtime.Face(expression, joints, rotation, neutral.head_translation)

    return [face() for _ in range(count)]


def motion_of(faces: list[runtime.Face], fps: float = 1.0) -> Motion:
    return Motion(*(np.stack([getattr(face, name) for face in faces]) for name in vars(faces[0])), fps=fps)


def taking(face: runtime.Face) -> str:
    """Return JavaScript by which a page's viewer takes a face."""
    numbers = "Object.entries(%s).map(([name, values]) => [name, Float32Array.from(values)])"
    return f"viewer.take(Object.fromEntries({numbers % json.dumps(as_json([face])[0])}));"


def as_json(faces: list[runtime.Face]) -> list[dict[str, list[float]]]:
    """Return faces in the form that a page takes."""
    return [{name: values.reshape(-1).tolist() for name, values in vars(face).items()} for face in faces]
