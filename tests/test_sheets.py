"""Sheets show every expression or side once, above its name, and drive and render tell what is beyond the film."""

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from mien.camera import Camera, camera_from_fov
from mien.cli import main
from mien.commands.stages import driving
from mien.commands.stages.sheets import (
    TURNTABLE_TILES,
    Tile,
    draw_sheet,
    expression_tiles,
    filmed_tiles,
    named_picture,
    nearer_tiles,
    turntable_tiles,
)
from mien.driving import ARKIT_NAMES
from mien.face import FaceModel, load_face_model
from mien.render.camera_paths import orbit
from mien.runtime import Filmed
from shared_things import toy_workspace
from small_face_model import make_small_face_model
from toy_scene import toy_camera

CAMERA = toy_camera(32)


workspace = pytest.fixture(toy_workspace)


def _turntable(span: float = 90.0) -> list[Tile]:
    return turntable_tiles(make_small_face_model().neutral(), CAMERA, torch.zeros(3), span)


def test_every_expression_that_the_face_model_shows_has_a_tile() -> None:
    model = load_face_model("anny")
    face = model.neutral()
    tiles = expression_tiles(model, face, CAMERA, 1.0)
    names = [tile.name.split()[0] for tile in tiles[1:]]
    assert names == [name for name in ARKIT_NAMES if name not in ("mouthClose", "tongueOut")]
    for name, tile in zip(names, tiles[1:], strict=True):
        coefficients = tile.face.expression[0]
        if name.startswith("eyeLook"):
            assert not coefficients.any(), name
            assert tile.face.joints.abs().max() > 0.2, name
        else:
            assert coefficients.nonzero().flatten().tolist() == [model.expression_names.index(name)], name
            assert not tile.face.joints.any(), name
    strong = {tile.name for tile in expression_tiles(model, face, CAMERA, 1.5)}
    assert {"jawOpen 1.20", "browInnerUp 1.50"} <= strong, "coefficients stay within the bounds of the face model"


def test_strengths_relative_to_what_was_filmed() -> None:
    model = make_small_face_model()
    count = len(model.expression_names)
    model = replace(model, expression_bounds=torch.tensor([[0.0, 1.0]]).repeat(count, 1))
    highest = np.linspace(0.2, 0.9, count + 3).astype(np.float32)
    filmed = Filmed(0 * highest, highest, np.diag(highest), highest[:1], np.zeros((2, 2), np.float32))
    tiles = filmed_tiles(model, model.neutral(), CAMERA, filmed, 1.5)
    shown = [float(tile.face.expression.max()) for tile in tiles[1:]]
    assert shown == pytest.approx([min(1.5 * value, 1.0) for value in highest[:count][::-1].tolist()])


def test_a_turntable_ends_at_half_of_its_angle_on_either_side() -> None:
    tiles, around = _turntable(120.0), _turntable(360.0)
    assert [tile.name for tile in (tiles[0], tiles[4], tiles[-1])] == ["-60 degrees", "front", "+60 degrees"]
    assert len(tiles) == TURNTABLE_TILES
    torch.testing.assert_close(tiles[-1].camera.viewmat, orbit(CAMERA, torch.zeros(3), torch.pi / 3).viewmat)
    assert not torch.allclose(around[0].camera.viewmat, around[-1].camera.viewmat, atol=0.1)


def test_names_are_legible_and_gaps_have_the_colour_of_the_background() -> None:
    picture = np.zeros((20, 40, 3), np.uint8)
    named = named_picture(picture, "a name that is far too wide for its tile")
    assert np.array_equal(named[:20], picture)
    assert (named[20:] < 255).any()
    assert (named[20:, -2:] == 255).all(), "no letter is cut off"
    small = draw_sheet(_turntable(), lambda face, camera: picture)
    assert small.shape[1] == TURNTABLE_TILES * 40 + (TURNTABLE_TILES - 1) * 4
    blue = (26, 32, 80)
    picture = np.full((512, 512, 3), blue, np.uint8)
    sheet = draw_sheet(_turntable(), lambda face, camera: picture, blue)
    high = named_picture(picture, "-70 degrees").shape[0] - 512
    assert sheet.shape == (3 * (512 + high) + 2 * 4, 3 * 512 + 2 * 4, 3), "it fits a screen"
    bar = sheet[512 : 512 + high, :512].astype(int)
    rows = np.flatnonzero(np.abs(bar - blue).sum(-1).max(1) > 300)
    assert np.ptp(rows) > 0.03 * 512, "letters are as large as their picture asks for, and light over a dark colour"
    assert (sheet[:, 512:516] == blue).all()


def test_tiles_come_nearer_until_what_they_show_fills_them() -> None:
    """A ball below the middle of the picture is magnified, and the picture ends where it ended before."""
    gray = (90, 90, 90)

    def wall(_: object, camera: Camera) -> np.ndarray:
        return np.full((camera.height, camera.width, 3), gray, np.uint8)

    def ball(_: object, camera: Camera) -> np.ndarray:
        x, y = (round(float(at)) for at in (camera.K @ torch.tensor([0.0, 0.1, 1.0]))[:2])
        return cv2.circle(wall(None, camera), (x, y), round(0.05 * float(camera.K[0, 0])), (255, 0, 0), -1)

    start = camera_from_fov(0.8, 200, 200, torch.eye(4))
    tiles = [Tile("one", make_small_face_model().neutral(), start)]
    near = nearer_tiles(tiles, ball, gray)[0].camera
    shown = (ball(None, near) != gray).any(-1)
    assert 0.7 < max(np.ptp(np.flatnonzero(shown.any(axis))) / 200 for axis in (0, 1)) < 0.98
    corner = torch.linalg.inv(start.K) @ torch.tensor([100.0, 200.0, 1.0])
    assert float((near.K @ corner)[1]) >= 199.99, "the picture's lower border stays at the border or beyond"
    assert nearer_tiles(tiles, wall, gray) == tiles


@pytest.mark.parametrize("options", [["expressions"], ["filmed", "--strength", "1.5"], ["turntable", "--span", "180"]])
def test_the_command_draws_a_sheet(workspace: Path, tmp_path: Path, options: list[str]) -> None:
    out = tmp_path / "sheet.png"
    assert main(["render", str(workspace), "--out", str(out), "--size", "32", "--sheet", *options]) == 0
    sheet = cv2.imread(str(out))
    assert sheet is not None
    assert sheet.shape[1] % 36 == 32 or sheet.shape[1] == 32
    assert len(np.unique(sheet.reshape(-1, 3), axis=0)) > 20


def test_a_sheet_without_a_name_lies_in_the_runs_folder(workspace: Path, tmp_path: Path, capsys) -> None:
    """Other pictures need a name, because it says what they are."""
    render = ["render", str(shutil.copytree(workspace, tmp_path / "W")), "--size", "32"]
    assert main([*render, "--sheet", "turntable"]) == 0
    (sheet,) = (tmp_path / "W/runs").glob("*/sheet_turntable.png")
    assert f"{sheet}: 9 pictures" in capsys.readouterr().err
    assert main(render) == 2
    assert "--out: is missing" in capsys.readouterr().err


def test_what_is_beyond_the_film_is_told_and_softened(workspace: Path, tmp_path: Path, capsys) -> None:
    still = ["render", str(workspace), "--out", str(tmp_path / "a.png"), "--size", "32"]
    for value, told in ((1, True), (0, False)):
        assert main([*still, "--set", f"drop={value}"]) == 0
        words = "beyond what was filmed, so it may look wrong: drop=1 (0.00 to"
        assert (words in capsys.readouterr().err) == told


def test_a_driver_who_goes_far_is_softened_unless_asked(workspace: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    read, draw = driving.read_tracked_driver, driving.draw

    def far(folders: list[Path], face_model: FaceModel) -> driving.Driver:
        driver = read(folders, face_model)
        turned = driver.face.head_rotation + torch.tensor([-1.0, 0.0, 0.0])
        return replace(driver, face=replace(driver.face, head_rotation=turned))

    monkeypatch.setattr(driving, "read_tracked_driver", far)
    drive = ["drive", str(workspace), "--by", str(workspace), "--size", "32", "--out", str(tmp_path / "f.mp4")]
    looked_up: dict[bool, list[torch.Tensor]] = {True: [], False: []}
    for softens, seen in looked_up.items():
        monkeypatch.setattr(driving, "draw", lambda *given, to=seen: to.append(given[1].T_world_local) or draw(*given))
        assert main([*drive, *([] if softens else ["--unlimited"])]) == 0
        told = capsys.readouterr().err
        assert ("5 of 5 frames go beyond what was filmed and are softened" in told) == softens
    for near, wild in zip(*looked_up.values(), strict=True):
        assert float(near[1, 2]) < float(wild[1, 2]) - 0.3, "the head looks up less"
