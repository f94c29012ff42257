"""ARKit's names of gaze move the pixels of the eyes, each its eye and its way, wherever an avatar is shown.

The avatar has green eyeballs with blue irises, and everything else has one colour. So pictures tell where an iris is.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from jaxtyping import Float

from mien import runtime
from mien.avatar import GaussianAvatars, make_portable
from mien.camera import Camera
from mien.cli import main
from mien.commands.stages.sheets import expression_tiles
from mien.export import write_glb, write_page
from mien.face import FaceModel, load_face_model
from mien.runtime.named import GAZE_NAMES
from mien.runtime.posing import SH_C0
from mien.training.run import write_imported_run
from needs import NO_NODE_PACKAGES
from plain_settings import plain_gaussian_avatars
from test_glb import mesh_model
from toy_scene import toy_camera
from web_case import WEB, browse, bundle, picture, script, served

SIDE = 192
DISTANCE, ZOOM = 0.55, 2.0
"""The camera's distance to the middle of the head in metres, and how much nearer than `toy_camera` it sees."""
COLORS = {"eyes": (0.1, 0.8, 0.1), "irises": (0.1, 0.1, 0.9)}
SKIN = (0.8, 0.6, 0.5)
REACH = 0.025 * 1.2 * ZOOM / (DISTANCE - 0.08)
"""How far from the middle of an iris pixels may change, since lids follow the eye: 25 mm, as a share of the picture's
width. The other eye is 63 mm away, and the front of an eye 80 mm nearer than the middle of the head."""

Picture = Float[np.ndarray, "h w 3"]


@pytest.fixture(scope="module")
def model() -> FaceModel:
    return load_face_model("anny")


@pytest.fixture(scope="module")
def avatar(model: FaceModel) -> GaussianAvatars:
    """A flat Gaussian on each triangle of the mean head, with wide eyes."""
    face = replace(model.neutral(), head_translation=torch.tensor([[0.0, 0.0, -DISTANCE]]))
    for side in ("Left", "Right"):
        face.expression[:, model.expression_names.index(f"eyeWide{side}")] = 1
    made = GaussianAvatars(plain_gaussian_avatars(), model, face)
    names = [model.region_names[region] for region in model.face_regions[made.store["face_index"]].tolist()]
    colors = torch.tensor([COLORS.get(name, SKIN) for name in names])
    with torch.no_grad():
        made.store["sh_constant"].copy_((colors[:, None] - 0.5) / SH_C0)
        made.store["opacity_logits"].fill_(6.0)
        wide = torch.tensor([0.35 if name in COLORS else 0.8 for name in names])
        made.store["log_scales"].copy_(torch.stack([wide, wide, 0 * wide + 0.05], dim=1).log())
    return made


@pytest.fixture(scope="module")
def camera() -> Camera:
    camera = toy_camera(SIDE)
    camera.K[:2, :2] *= ZOOM
    return camera


@pytest.fixture(scope="module")
def portable(avatar: GaussianAvatars, camera: Camera) -> runtime.PortableAvatar:
    return make_portable(avatar, camera, "looking")


@pytest.fixture(scope="module")
def workspace(avatar: GaussianAvatars, camera: Camera, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A workspace with the avatar as that of a run."""
    root = tmp_path_factory.mktemp("gaze") / "W"
    (root / "sequences").mkdir(parents=True)
    write_imported_run(root / "runs" / "looking", avatar, avatar.subject, camera, root)
    return root


def eyes_of(image: Picture) -> dict[str, np.ndarray]:
    """Return which pixels show each eye [h, w]. The person's left is the picture's right."""
    red, green, blue = np.moveaxis(image, -1, 0)
    shown = np.maximum(green, blue) > red + 0.2
    left = np.arange(image.shape[1]) >= image.shape[1] // 2
    return {"Left": shown & left, "Right": shown & ~left}


def iris_of(image: Picture, eye: np.ndarray) -> np.ndarray:
    """Return the middle (x, y) of the blue pixels of an eye [h, w], in pixels."""
    weights = np.clip(image[..., 2] - image[..., :2].max(-1), 0, None) * eye
    assert weights.sum() > 1, "no iris is seen"
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
    return np.array([(weights * columns).sum(), (weights * rows).sum()]) / weights.sum()


def check(before: Picture, after: Mapping[str, Picture]) -> None:
    """Check that each name moves the iris of its eye its way, and no pixel beyond that eye."""
    assert set(after) == set(GAZE_NAMES)
    at_rest = eyes_of(before)
    for name, image in after.items():
        side = "Left" if name.endswith("Left") else "Right"
        other = "Right" if side == "Left" else "Left"
        wide = np.ptp(np.flatnonzero(at_rest[side].any(0)))
        moves = {each: iris_of(image, eyes_of(image)[each]) - iris_of(before, at_rest[each]) for each in at_rest}
        # The person's left is the picture's right, and rows go down.
        right = {"Out": 1, "In": -1}.get(name[7 : -len(side)], 0) * (1 if side == "Left" else -1)
        down = {"Up": -1, "Down": 1}.get(name[7 : -len(side)], 0)
        assert np.abs(moves[other]).max() < 0.02 * wide, (name, moves)
        assert moves[side] @ (right, down) > 0.1 * wide, (name, moves)
        assert abs(moves[side] @ (down, right)) < 0.07 * wide, (name, moves)
        rows, columns = np.nonzero(np.abs(image - before).max(-1) > 0.05)
        changed = np.stack([columns, rows], axis=1) - iris_of(before, at_rest[side])
        assert np.abs(changed).max() < REACH * image.shape[1], name


def test_the_command_line_moves_them(workspace: Path, tmp_path: Path) -> None:
    def drawn(name: str, value: int) -> Picture:
        out = tmp_path / "still.png"
        options = ["--out", str(out), "--size", str(SIDE), "--set", f"{name}={value}"]
        assert main(["render", str(workspace), *options]) == 0
        return read(out)

    before = drawn(GAZE_NAMES[0], 0)
    check(before, {name: drawn(name, 1) for name in GAZE_NAMES})


def read(path: Path) -> Picture:
    image = cv2.imread(str(path))
    assert image is not None
    return image[..., ::-1].astype(np.float32) / 255


def test_an_expression_sheet_moves_them(workspace: Path, model: FaceModel, tmp_path: Path) -> None:
    """Each picture of the sheet is compared with its first one, which shows the face as it is."""
    size, out = 128, tmp_path / "sheet.png"
    options = ["--sheet", "expressions", "--out", str(out), "--size", str(size), "--zoom", "1"]
    assert main(["render", str(workspace), *options]) == 0
    sheet = read(out)
    names = [tile.name.split()[0] for tile in expression_tiles(model, model.neutral(), toy_camera(size), 1.0)]
    columns = (sheet.shape[1] + 4) // (size + 4)
    step = (sheet.shape[0] + 4) // math.ceil(len(names) / columns)

    def tile(index: int) -> Picture:
        row, column = divmod(index, columns)
        return sheet[row * step :][:size, column * (size + 4) :][:, :size]

    check(tile(0), {name: tile(names.index(name)) for name in GAZE_NAMES})


SHOTS = """
  const given = %s, shots = [];
  for (const name of ["", ...given]) {
    %s
    [viewer.canvas.width, viewer.canvas.height] = [%d, %d];
    viewer.background = [1, 1, 1, 1];
    viewer.draw();
    shots.push(viewer.canvas.toDataURL());
  }
  return shots;
"""
"""Draws without a name, and with each name at 1; the second part sets one."""


def shots(setting: str) -> str:
    return SHOTS % (json.dumps(GAZE_NAMES), setting, SIDE, SIDE)


def check_shots(told: dict[str, list[list[str]]]) -> None:
    before, *after = (picture(address)[..., :3] for address in told["results"][0])
    check(before, dict(zip(GAZE_NAMES, after, strict=True)))


def test_the_sliders_of_a_page_move_them(portable: runtime.PortableAvatar, tmp_path: Path) -> None:
    write_page(tmp_path / "me.html", portable)
    setting = """
    for (const each of given) {
      const slider = document.getElementById(each);
      slider.value = each === name ? "1" : "0";
      slider.dispatchEvent(new Event("input", { bubbles: true }));
    }
    """
    check_shots(browse(tmp_path / "me.html", [script("const viewer = await mien;", shots(setting))], (SIDE, SIDE)))


@pytest.fixture(scope="module")
def site(portable: runtime.PortableAvatar, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the avatar as a .glb file, and three.js."""
    folder = tmp_path_factory.mktemp("site")
    if not (WEB / "node_modules" / "three").is_dir():
        pytest.skip(NO_NODE_PACKAGES)
    write_glb(folder / "me.glb", portable, mesh_model(portable), 512)
    bundle(WEB / "tests" / "glb.mjs", folder / "glb.bundle.js")
    (folder / "glb.html").write_text('<link rel="icon" href="data:,">')
    return folder


def test_morph_targets_of_a_glb_file_move_them(site: Path) -> None:
    """three.js draws the mesh, whose eyes are painted into its texture."""
    degrees = math.degrees(2 * math.atan(0.5 / (1.2 * ZOOM)))
    drawn = f"const shown = await open('me.glb', {SIDE}, {DISTANCE}, {degrees});"
    each = "return ['', ...given].map((name) => shown(name && { [name]: 1 }));"
    opened = "const { open } = await import('./glb.bundle.js');"
    with served(site) as address:
        steps = [script(opened, drawn, f"const given = {json.dumps(GAZE_NAMES)};", each)]
        check_shots(browse(f"{address}/glb.html", steps, (SIDE, SIDE)))
