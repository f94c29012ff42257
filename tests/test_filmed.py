"""Driving keeps to what training saw; films and `unseen_view` turn to the sides that were filmed, and beside them."""

import math
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import train_toy
from known import known
from mien import runtime
from mien.avatar import Avatar, load_avatar
from mien.avatar.baking import make_portable, measure_filmed
from mien.avatar.files import write_avatar
from mien.avatar.methods import DEFAULT_METHOD, METHODS
from mien.camera import Camera, camera_from_fov, look_at
from mien.cli import main
from mien.driving.motion import ARKIT_NAMES
from mien.driving.transfer import keep_to_filmed
from mien.evaluation import living
from mien.evaluation.living import Living
from mien.face import FaceModel, FaceParams, load_face_model
from mien.lab.benchmarking.quality import unseen_table
from mien.lab.benchmarking.unseen_views import Front, angle_names, camera_beside, write_unseen_chart
from mien.lab.synthetic.recipe import SIDES
from mien.lab.synthetic.references import REFERENCES
from mien.pipeline import drive as driving
from mien.pipeline import sheets
from mien.pipeline.view import viewed_file
from mien.render.camera_paths import orbit
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle
from mien.runtime.baked import Filmed
from mien.runtime.filmed import ROOM, head_angles, soft_limits, within_filmed_inputs, within_filmed_poses
from mien.training.footage.filmed import FILE, read_coverage
from plain_settings import plain_config
from reference_signatures import tiny
from refusals import complaint, refuses
from shared_things import toy_workspace, write_toy_workspace
from small_face_model import make_small_face_model
from toy_scene import toy_camera, toy_face_model, toy_sequence
from web_case import drawn_head

EYE = np.array([0.0, 0.0, 1.0])
PARTS = ("lowest", "highest", "head_angles")


def _face(yaws: list[float], expression: torch.Tensor | None = None) -> FaceParams:
    """Heads at the origin that turn to their left by some angles in radians."""
    count = len(yaws)
    rotation = torch.tensor([[0.0, yaw, 0.0] for yaw in yaws])
    values = torch.zeros(count, 3) if expression is None else expression
    return FaceParams(torch.zeros(2), values, torch.zeros(count, 2, 3), rotation, torch.zeros(count, 3))


def _filmed(yaws: list[float], expression: torch.Tensor | None = None) -> runtime.Filmed:
    face = _face(yaws, expression)
    return measure_filmed(face, torch.tensor(EYE).float().expand(len(face), 3))


def _avatar(face: FaceParams, method: str = DEFAULT_METHOD) -> Avatar:
    return METHODS[method].avatar(plain_config(method), toy_face_model(), face)


def _written(path: Path, avatar: Avatar, **changes: object) -> runtime.PortableAvatar:
    """Write an avatar as a .mien file, and read it."""
    runtime.write_portable(path, replace(make_portable(avatar, toy_camera(32), "toy"), **changes))
    return runtime.read_portable(path)


def test_limits_are_soft_and_common_expressions_reach_their_full_motion() -> None:
    values = np.linspace(-5, 5, 1001)
    limited = soft_limits(values, np.array(-1.0), np.array(2.0), np.array(0.0), 1e-6)
    inside = (values >= -1) & (values <= 2)
    assert np.array_equal(limited[inside], values[inside])
    assert -(1 + ROOM) < limited.min() < limited.max() < 2 * (1 + ROOM)
    slopes = np.diff(limited) / np.diff(values)
    assert (slopes > 0).all(), "more motion of the driver is never less of the avatar"
    assert slopes.max() < 1 + 1e-9
    assert np.abs(np.diff(slopes)).max() < 0.08, "no kink"
    # Of three expressions, the first was filmed at 1, and the others never.
    single = torch.cat([torch.eye(3)[:1].repeat(20, 1), torch.zeros(20, 3)])
    inputs = np.zeros((3, 9), np.float32)
    inputs[0, 0], inputs[1], inputs[2, :3] = 1.0, 1.5, -0.1
    bounds = np.array([[0.0, 1.5]] * 3)
    names = ("jawLeft", "mouthSmileLeft", "noseSneerLeft")
    kept = within_filmed_inputs(_filmed([0.0] * 40, single), inputs, np.zeros(9, np.float32), bounds, names)
    assert np.array_equal(kept[0], inputs[0]), "what was filmed keeps its bits"
    assert 1 < kept[1, 0] < 1.3
    assert kept[1, 1] == 1.5, "a smile is common, and goes on to the bound of the face model"
    assert 0 < kept[1, 2] < 0.3, "an expression that was never filmed is shown a little"
    assert (kept[2, :3] > -0.1).all()


def test_the_camera_sees_the_head_from_sides_that_were_filmed() -> None:
    filmed = _filmed([-0.3, 0.1, 0.2])
    np.testing.assert_allclose(filmed.head_angles[0], [-0.2, 0.3], atol=1e-6)
    asked = _face([-0.25, 0.15, 1.2, -1.2])
    rotation, translation = asked.head_rotation.numpy(), asked.head_translation.numpy()
    kept = within_filmed_poses(filmed, rotation, translation, EYE)
    assert np.array_equal(kept[:2], rotation[:2])
    yaws = head_angles(kept, translation, EYE)[:, 0]
    assert -0.2 - math.radians(8) - 1e-6 < yaws[2] < -0.2
    assert 0.3 < yaws[3] < 0.3 + math.radians(8) + 1e-6
    looking_up = np.array([[-1.0, 0.0, 0.0]], np.float32)
    pitch = head_angles(within_filmed_poses(filmed, looking_up, translation[:1], EYE), translation[:1], EYE)[0, 1]
    assert -math.radians(8) < pitch < 0
    # A limited head keeps its roll.
    roll, turn = torch.tensor([0.0, 0.0, 0.4]), torch.tensor([0.0, 1.0, 0.0])
    rolled = axis_angle_from_matrix((matrix_from_axis_angle(turn) @ matrix_from_axis_angle(roll))[None]).numpy()
    kept = within_filmed_poses(_filmed([-0.1, 0.1]), rolled, translation[:1], EYE)
    up = matrix_from_axis_angle(torch.from_numpy(kept))[0, :, 1]
    assert math.atan2(-float(up[0]), float(up[1])) == pytest.approx(0.4, abs=0.08)


def test_driving_with_its_own_training_frames_changes_nothing() -> None:
    model, sequence = toy_sequence()
    face, eye = sequence.tracking.face, sequence.tracking.cameras[0].position
    subject = _avatar(face).subject
    filmed = measure_filmed(face, eye.expand(len(face), 3))
    kept, softened, parts = keep_to_filmed(face, filmed, subject, model, eye)
    assert (softened, parts) == (0, [])
    for name, tensor in face.tensors().items():
        assert torch.equal(getattr(kept, name), tensor), name
    wild = replace(face, head_rotation=face.head_rotation + torch.tensor([0.0, 1.5, 0.0]))
    wild.expression[1, 0] = 9.0
    kept, softened, parts = keep_to_filmed(wild, filmed, subject, model, eye)
    assert (softened, parts) == (len(face), ["head", "drop"])
    assert (kept.head_rotation - wild.head_rotation).abs().amax(1).min() > 0.3


def test_it_is_kept_in_a_run_and_in_a_mien_file_and_checked(tmp_path: Path) -> None:
    face = toy_sequence()[1].tracking.face
    avatar = _avatar(face)
    write_avatar(tmp_path / "a", avatar)
    assert load_avatar(tmp_path / "a").filmed is None
    assert _written(tmp_path / "a.mien", avatar).filmed is None
    avatar.filmed = good = measure_filmed(face, torch.ones(len(face), 3))
    write_avatar(tmp_path / "a", avatar)
    for found in (load_avatar(tmp_path / "a").filmed, _written(tmp_path / "a.mien", avatar).filmed):
        assert found is not None
        assert all(np.array_equal(getattr(found, name), getattr(good, name)) for name in PARTS)
    for change in ({"lowest": good.highest + 1}, {"head_angles": good.head_angles[:, ::-1].copy()}):
        avatar.filmed = replace(good, **change)
        write_avatar(tmp_path / "a", avatar)
        refuses("filmed", load_avatar, tmp_path / "a")
        refuses("filmed", _written, tmp_path / "a.mien", avatar)


@pytest.mark.parametrize("method", METHODS)
def test_a_confidence_that_does_not_fit_is_refused(method: str, tmp_path: Path) -> None:
    avatar = _avatar(toy_sequence()[1].tracking.face, method)
    good = np.full(len(toy_face_model().faces), 0.5, np.float32)
    found = _written(tmp_path / "a.mien", avatar, confidence=good)
    assert np.array_equal(known(found.confidence), good)
    wrong = [good + 1, good - 1, good * np.float32("nan")]
    wrong += [good[1:], good[:0]] if isinstance(found.baked, runtime.MeshBound) else []
    for confidence in wrong:
        refuses("confidence", _written, tmp_path / "a.mien", avatar, confidence=confidence)


@pytest.mark.unchecked
def test_a_mien_file_and_the_viewer_have_the_confidence_of_the_run(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(train_toy, "SETTINGS", replace(train_toy.SETTINGS, steps=2, unseen="filled"))
    write_toy_workspace(tmp_path / "me")
    run, path = tmp_path / "me" / "runs" / "toy", tmp_path / "me.mien"
    covered = known(read_coverage(run, load_avatar(run).face_model))
    assert covered.seen.unique().numel() > 1
    export = ["export", str(tmp_path / "me"), "--out", str(path)]
    assert main(export) == 0
    mesh = known(viewed_file(path).mesh)
    for found in (runtime.read_portable(path).confidence, mesh.seen):
        assert found is not None
        assert np.array_equal(found, covered.seen.numpy())
    (run / FILE).unlink()
    assert main(export) == 0
    assert runtime.read_portable(path).confidence is None


CAMERA = toy_camera(32)


workspace = pytest.fixture(toy_workspace)


def test_every_expression_has_a_tile_whose_strength_is_relative_to_what_was_filmed() -> None:
    model = load_face_model("anny")
    face = model.neutral()
    tiles = sheets.expression_tiles(model, face, CAMERA, 1.0)
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
    strong = {tile.name for tile in sheets.expression_tiles(model, face, CAMERA, 1.5)}
    assert {"jawOpen 1.20", "browInnerUp 1.50"} <= strong, "coefficients stay within the bounds of the face model"
    model = make_small_face_model()
    count = len(model.expression_names)
    model = replace(model, expression_bounds=torch.tensor([[0.0, 1.0]]).repeat(count, 1))
    highest = np.linspace(0.2, 0.9, count + 3).astype(np.float32)
    filmed = Filmed(0 * highest, highest, np.zeros((2, 2), np.float32))
    tiles = sheets.filmed_tiles(model, model.neutral(), CAMERA, filmed, 1.5)
    shown = [float(tile.face.expression.max()) for tile in tiles[1:]]
    assert shown == pytest.approx([min(1.5 * value, 1.0) for value in highest[:count][::-1].tolist()])
    anny = load_face_model("anny")
    blinks = np.array([0.6 if name == "eyeBlinkLeft" else 0.3 for name in anny.expression_names], np.float32)
    tiles = sheets.preset_tiles(anny, face, CAMERA, torch.zeros(3), Filmed(0 * blinks, blinks, filmed.head_angles))
    smile, shut = (tiles[index].face.expression[0] for index in (1, 12))
    assert float(smile.max()) == pytest.approx(0.7)
    assert sorted(shut[shut > 0].tolist()) == pytest.approx([0.6, 1.0]), "only the left lids were filmed shut"
    assert (tiles[14].name, torch.equal(tiles[14].camera.viewmat, CAMERA.viewmat)) == ("as it is, aside", False)
    face, center = make_small_face_model().neutral(), torch.zeros(3)
    tiles, around = (sheets.turntable_tiles(face, CAMERA, center, span) for span in (120.0, 360.0))
    assert [tile.name for tile in (tiles[0], tiles[4], tiles[-1])] == ["-60 degrees", "as filmed", "+60 degrees"]
    assert len(tiles) == sheets.TURNTABLE_TILES
    torch.testing.assert_close(tiles[-1].camera.viewmat, orbit(CAMERA, torch.zeros(3), torch.pi / 3).viewmat)
    assert not torch.allclose(around[0].camera.viewmat, around[-1].camera.viewmat, atol=0.1)


def test_tiles_come_nearer_until_what_they_show_fills_them() -> None:
    """A ball below the middle of the picture is magnified, and the picture ends where it ended before."""
    gray = (90, 90, 90)

    def wall(_: object, camera: Camera) -> np.ndarray:
        return np.full((camera.height, camera.width, 3), gray, np.uint8)

    def ball(_: object, camera: Camera) -> np.ndarray:
        x, y = (round(float(at)) for at in (camera.K @ torch.tensor([0.0, 0.1, 1.0]))[:2])
        return cv2.circle(wall(None, camera), (x, y), round(0.05 * float(camera.K[0, 0])), (255, 0, 0), -1)

    start = camera_from_fov(0.8, 200, 200, torch.eye(4))
    tiles = [sheets.Tile("one", make_small_face_model().neutral(), start)]
    near = sheets.nearer_tiles(tiles, ball, gray)[0].camera
    shown = (ball(None, near) != gray).any(-1)
    assert 0.7 < max(np.ptp(np.flatnonzero(shown.any(axis))) / 200 for axis in (0, 1)) < 0.98
    corner = torch.linalg.inv(start.K) @ torch.tensor([100.0, 200.0, 1.0])
    assert float((near.K @ corner)[1]) >= 199.99, "the picture's lower border stays at the border or beyond"
    assert sheets.nearer_tiles(tiles, wall, gray) == tiles


@pytest.mark.parametrize("options", [["expressions"], ["filmed", "--strength", "1.5"], ["turntable", "--span", "180"]])
def test_the_command_draws_a_sheet(workspace: Path, tmp_path: Path, options: list[str]) -> None:
    out = tmp_path / "sheet.png"
    assert main(["render", "sheet", str(workspace), *options, "--out", str(out), "--size", "32"]) == 0
    sheet = known(cv2.imread(str(out)))
    assert sheet.shape[1] % 36 == 32 or sheet.shape[1] == 32
    assert len(np.unique(sheet.reshape(-1, 3), axis=0)) > 20


def test_a_sheet_lies_in_the_runs_folder_and_what_is_beyond_the_film_is_told(workspace, tmp_path, capsys) -> None:
    """Other pictures need a name, because it says what they are."""
    copy = str(shutil.copytree(workspace, tmp_path / "W"))
    assert main(["render", "sheet", copy, "turntable", "--size", "32"]) == 0
    (sheet,) = (tmp_path / "W/runs").glob("*/sheet_turntable.png")
    assert f"{sheet}: 9 pictures" in capsys.readouterr().err
    assert "Missing from mien render: --out" in complaint(capsys, "render", copy)
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


def test_views_begin_at_the_tracked_camera_and_show_moments_of_the_held_out_sequence() -> None:
    """Whatever the tracked face, focal length and distance are, the avatar is seen as it was trained."""
    own = _camera(0.48, (0.02, 0.1, 0.8))
    front = Front(_camera(0.5, (0.0, 0.1, 0.9)), own, np.array([0.01, 0.0, 0.02]), np.array([0.03, -0.01, 0.05]))
    placed = camera_beside(front.true, front)
    torch.testing.assert_close(placed.viewmat, own.viewmat)
    torch.testing.assert_close(placed.K, own.K)
    # The side views are those timesteps of the sequence, in the front camera as well, and no one else's.
    reference = REFERENCES["mono-sides"]
    assert known(reference.views).sequence in reference.held_out_sequences
    front, aside, views = tiny(reference).scenes()
    for index, timestep in enumerate(known(views.moments)):
        torch.testing.assert_close(views.vertices(index), aside.vertices(timestep))
    assert not torch.equal(front.vertices(0), aside.vertices(0))
    assert len(views.cameras) == len(SIDES) + 1
    torch.testing.assert_close(views.cameras[0].viewmat, aside.camera.viewmat)


def test_a_camera_aside_sees_a_true_tracking_where_it_sees_the_person() -> None:
    """The tracked world is turned, moved and a tenth larger; through the placed camera every point is at its pixel."""
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (20, 3))
    turn = matrix_from_axis_angle(torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)).numpy()
    shift = np.array([0.05, -0.02, 0.3])
    tracked = 1.1 * points @ turn.T + shift
    true = _camera(0.5, (0.0, 0.1, 0.9))
    view = true.viewmat.double().numpy()
    moved = np.eye(4)
    moved[:3, :3] = view[:3, :3] @ turn.T
    moved[:3, 3] = 1.1 * view[:3, 3] - moved[:3, :3] @ shift
    own = replace(true, viewmat=torch.from_numpy(moved).float())
    front = Front(true, own, points.mean(0), tracked.mean(0))
    assert front.scale == pytest.approx(1 / 1.1)
    behind = front.behind(np.array([0.0, 0.6, 0.8]))
    expected = 1.1 * (points.mean(0) - 0.08 * np.array([0.0, 0.6, 0.8])) @ turn.T + shift
    np.testing.assert_allclose(behind.tracked_middle, expected, atol=1e-6)
    aside = _camera(0.5, (0.5, 0.1, 0.7))
    placed = camera_beside(aside, behind)
    seen, _ = placed.project(torch.from_numpy(tracked).float())
    expected, _ = aside.project(torch.from_numpy(points).float())
    torch.testing.assert_close(seen, expected, atol=1e-2, rtol=0)
    torch.testing.assert_close(placed.viewmat[:3, :3] @ placed.viewmat[:3, :3].T, torch.eye(3), atol=1e-5, rtol=0)


def _camera(field_of_view: float, place: tuple[float, float, float]) -> Camera:
    viewmat = look_at(torch.tensor(place), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    return camera_from_fov(field_of_view, 320, 320, viewmat)


def test_table_and_chart(tmp_path) -> None:  # noqa: ANN001
    names = list(dict.fromkeys(angle_names()))
    assert names == ["front", "15", "30", "45", "60", "90", "180", "above 25", "below 25"]
    figures = {"psnr": 20.0, "ssim": 0.5, "l1": 0.1, "perceptual": 0.25}
    unknown = {**figures, "head": {**figures, "perceptual": None}}
    rows = {name: {"avatar": {**figures, "head": figures}, "mesh": unknown} for name in names}
    assert unseen_table("mono-sides", rows).splitlines()[3] == "| 15 | 20.00 / 0.500 / 0.250 | 20.00 / 0.500 / - |"
    write_unseen_chart(tmp_path / "chart.svg", rows)
    assert (tmp_path / "chart.svg").stat().st_size > 1000
    assert REFERENCES["ring-16"].views is None


DEGREES = np.degrees(1.0)


avatar = pytest.fixture(lambda: runtime.Avatar(drawn_head(1500)))


def aside(avatar: runtime.Avatar, degrees: float) -> runtime.Avatar:
    """The avatar of a person whose head, at rest, is turned to its left."""
    portable = avatar.portable
    turned = living.turned_head(avatar, degrees / DEGREES, 0.0)
    return runtime.Avatar(replace(portable, neutral=replace(portable.neutral, head_rotation=turned)))


def test_the_head_turns_to_the_sides_that_were_filmed_and_never_leaves_the_film(avatar: runtime.Avatar, monkeypatch):
    # The head of the drawn person looks 5.1 degrees to its right of the camera.
    assert np.multiply(living.yaws_of(aside(avatar, 5.1), (15, 10)), DEGREES) == pytest.approx((-10, 15), abs=0.1)
    # A camera that sees its right already leaves less on that side.
    assert np.multiply(living.yaws_of(aside(avatar, 10.1), (15, 10)), DEGREES) == pytest.approx((-15, 10), abs=0.1)
    assert living.yaws_of(avatar, (0, 0)) == (-living.LEAST_YAW, living.LEAST_YAW)
    assert living.yaws_of(avatar, (180, 180)) == living.yaws_of(avatar, None) == (-living.MOST_YAW, living.MOST_YAW)
    yaws = (-0.1, 0.4)
    monkeypatch.setattr(living, "FPS", 4)
    pictures = np.stack(list(living.pictures_of(Living(avatar, living.near_camera(avatar, yaws), yaws))))
    drawn = pictures.min(-1) < 200
    rows, columns = np.flatnonzero(drawn.max((0, 2))), np.flatnonzero(drawn.max((0, 1)))
    for ends in (rows, columns):
        assert ends[0] > 0
        assert ends[-1] < living.SIDE - 1
    assert max(np.ptp(rows), np.ptp(columns)) > 0.8 * living.SIDE
    assert np.mean(pictures[0] != pictures[5]) > 0.1, "the head turns"
