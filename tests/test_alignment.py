"""Frames aligned to a quick avatar come nearer to the truth, and drivers who never rest keep their expression."""

import itertools
import shutil
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from evaluation_case import make_experiment, two_cameras
from mien.avatar import Avatar, neutral_of
from mien.avatar.avatar import ParameterGroup, move_avatar
from mien.avatar.settings import Rate
from mien.avatar.store import Moments
from mien.cli import main
from mien.commands.create import Command as Create
from mien.commands.parsing import parse_options
from mien.driving import drive
from mien.driving.drivers import Driver, with_neutral
from mien.driving.rest import REST_EXPRESSION, REST_GAZE, REST_HEAD, facing, kept_share, rest_of
from mien.errors import UserError
from mien.evaluation.experiment import Experiment, avatar_image, target_image
from mien.evaluation.metrics import l1
from mien.face import FaceModel, FaceParams
from mien.pipeline.drive import open_driver
from mien.pipeline.names import check_neutral
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle
from mien.tracking import read_tracking, write_tracking
from mien.training import TrainSettings, train
from mien.training.alignment import align, align_faces, descend, steadier
from mien.training.settings import AlignmentSettings
from refusals import complaint, refuses
from shared_things import write_sequence, write_toy_workspace
from small_face_model import make_small_face_model
from test_motion import row, write_csv
from toy_scene import toy_face_model, toy_sequence

QUICK = AlignmentSettings(template_steps=6, template_gaussians=400, resolution=32, iterations=2)
OPTIONS = (
    "--alignment.template-steps", "6", "--alignment.resolution", "32", "--alignment.iterations", "2",
    "--alignment.template-gaussians", "400", "--split", "tail",
)  # fmt: skip


def astray(face: FaceParams) -> FaceParams:
    """Return face parameters that are a little wrong, differently at each timestep."""
    wrong = torch.Generator().manual_seed(1)
    return replace(
        face,
        expression=(face.expression + 0.05 * torch.randn(face.expression.shape, generator=wrong)).clamp(0, 1),
        head_rotation=face.head_rotation + 0.02 * torch.randn(face.head_rotation.shape, generator=wrong),
        head_translation=face.head_translation + 0.002 * torch.randn(face.head_translation.shape, generator=wrong),
    )


def aligned(experiment: Experiment, start: FaceParams, **changes: int) -> FaceParams:
    settings = replace(AlignmentSettings(resolution=72, iterations=20), **changes)
    known = [frame for frame in experiment.training_frames if frame.timestep != len(start) - 1]
    return align_faces(experiment.avatar, experiment.sequences, [start], known, settings)[0]


@pytest.mark.unchecked
def test_faces_come_nearer_to_the_truth_and_the_avatar_stays() -> None:
    experiment = make_experiment(10)
    truth, before = experiment.faces[0], {n: t.clone() for n, t in experiment.avatar.state_dict().items()}
    start = astray(truth)
    found = aligned(experiment, start)
    for name in ("head_rotation", "head_translation", "expression"):
        was, now = ((getattr(one, name) - getattr(truth, name)).norm() for one in (start, found))
        assert now < 0.9 * was, name
    for frame in experiment.held_out_frames:
        target = target_image(experiment, frame)
        was, now = (l1(avatar_image(experiment, frame, one[frame.timestep]), target) for one in (start, found))
        assert now < 0.75 * was
    assert all(tensor.equal(before[name]) for name, tensor in experiment.avatar.state_dict().items())
    assert all(tensor.grad is None and tensor.requires_grad for tensor in experiment.avatar.parameters())
    assert found.identity.equal(start.identity)


def test_what_was_stopped_goes_on_to_the_same_bytes(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("mien.training.alignment.ALIGNED_BETWEEN", 2)
    experiment = make_experiment(6)
    start, settings = astray(experiment.faces[0]), AlignmentSettings(resolution=32, iterations=2)
    begun: list[int] = []

    @contextmanager
    def interrupted(title: str, total: int, completed: int):  # noqa: ANN202
        begun.append(completed)
        done = itertools.count(1)

        def advance(amount: int = 1, status: str = "") -> None:
            if len(begun) == 1 and next(done) == 4:
                raise KeyboardInterrupt

        yield advance

    def run(folder: Path | None) -> FaceParams:
        given = experiment.avatar, experiment.sequences, [start], experiment.training_frames, settings
        return align_faces(*given, folder=folder, progress=interrupted)[0]

    pytest.raises(KeyboardInterrupt, run, tmp_path)
    resumed, whole = run(tmp_path), run(None)
    assert begun == [0, 4, 0]
    for name, tensor in whole.tensors().items():
        assert tensor.equal(resumed.tensors()[name]), name
    (tmp_path / "aligned.safetensors").write_bytes(b"damaged")
    assert run(tmp_path).expression.equal(whole.expression)


def test_what_matters_more_moves_further() -> None:
    """Adam would move both coefficients by the same in its first step."""
    values = torch.zeros(1, 2, requires_grad=True)
    group = ParameterGroup("face", {"face": values}, Rate(0.01), {"face": Moments.zeros(values.detach())})
    values.grad = torch.tensor([[4.0, 1.0]])
    descend([group], {"face": torch.tensor(2.0)})
    assert torch.allclose(values, torch.tensor([[-0.02, -0.005]]))
    assert values.grad is None


@pytest.mark.unchecked
def test_what_a_hand_covers_gets_the_corrections_of_its_neighbours() -> None:
    """No other frame depends on those beside it. Training frames say how large gradients are, and the last is none."""
    experiment = make_experiment(6)
    (sequence,), start = experiment.sequences, astray(experiment.faces[0])
    covered = torch.zeros(6, 1, 3, dtype=torch.bool)
    covered[2, 0, 0] = True
    sequence = replace(sequence, tracking=replace(sequence.tracking, covered=covered))
    experiment = replace(experiment, sequences=(sequence,))
    found = aligned(experiment, start, iterations=3).expression
    change = found - start.expression
    assert torch.allclose(change[2], (change[1] + change[3]) / 2, atol=1e-6)
    sequence.capture.images[5] = 255 - sequence.capture.images[5]
    assert aligned(experiment, start, iterations=3).expression[:5].equal(found[:5])


def test_corrections_of_the_pose_are_averaged_over_time() -> None:
    tracked = make_experiment(12).faces[0]
    tracked = replace(tracked, head_rotation=tracked.head_rotation[:1].repeat(12, 1))
    slow = torch.linspace(0, 0.01, 12)[:, None] * torch.tensor([1.0, -1.0, 0.5])
    trembling = torch.tensor([1.0, -1.0]).repeat(6)[:, None] * torch.tensor([0.002, 0.001, 0.003])
    moved = replace(tracked, head_translation=tracked.head_translation + slow, expression=tracked.expression / 2)
    for one in (moved, replace(moved, head_translation=moved.head_translation + trembling)):
        found = steadier(tracked, one, torch.arange(12) >= 0)
        assert torch.allclose(found.head_translation[1:-1], moved.head_translation[1:-1], atol=2e-4)
        assert torch.allclose(found.T_world_head[:, :3, :3], tracked.T_world_head[:, :3, :3], atol=1e-6)
        assert found.expression.equal(moved.expression)


@pytest.mark.unchecked
def test_held_out_frames_reach_neither_the_template_nor_other_faces(tmp_path: Path) -> None:
    found = []
    for wrong in (False, True):
        face_model, sequence = toy_sequence(5, 32)
        if wrong:
            sequence.capture.images[4] = np.random.default_rng(0).integers(0, 255, sequence.capture.images[4].shape)
        found += align([sequence], face_model, QUICK, TrainSettings(split="tail"), tmp_path / str(wrong))
    for name in ("expression", "joints", "head_rotation", "head_translation"):
        same = [one.equal(other) for one, other in zip(*(getattr(each, name) for each in found), strict=True)]
        assert same == [True] * 4 + [False], name


@pytest.mark.unchecked
def test_held_out_cameras_move_no_face(tmp_path: Path) -> None:
    found, experiment = [], make_experiment(3)
    for wrong in (False, True):
        sequence = two_cameras(experiment, "clip")
        if wrong:
            sequence.capture.images[:, 1] = 255 - sequence.capture.images[:, 1]
        settings = TrainSettings(split="none", held_out_cameras=("side",))
        found += align([sequence], experiment.avatar.face_model, QUICK, settings, tmp_path / str(wrong))
    assert all(tensor.equal(found[1].tensors()[name]) for name, tensor in found[0].tensors().items())


@pytest.mark.unchecked
@pytest.mark.parametrize("device", ["float64", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_a_template_of_another_device_aligns_on_the_processor(device: str, tmp_path: Path, monkeypatch) -> None:
    face_model, sequence = toy_sequence(10, 32)
    training = TrainSettings(split="tail", device="cuda" if device == "cuda" else "cpu")

    def elsewhere(*arguments) -> Avatar:
        avatar = train(*arguments)
        if device == "float64":
            move_avatar(avatar, torch.zeros((), dtype=torch.float64))
        return avatar

    usual = align([sequence], face_model, QUICK, replace(training, device="cpu"), tmp_path / "usual")[0]
    monkeypatch.setattr("mien.training.alignment.train", elsewhere)
    found = align([sequence], face_model, QUICK, training, tmp_path / "elsewhere")[0]
    for name in ("expression", "head_rotation", "head_translation"):
        torch.testing.assert_close(getattr(found, name), getattr(usual, name), atol=1e-3, rtol=0)


@pytest.fixture
def workspace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for stage in ("train", "track"):
        monkeypatch.setattr(f"mien.pipeline.{stage}.load_face_model", lambda name: toy_face_model())
    write_toy_workspace(tmp_path / "W")
    # What shows a tracking needs landmarks, which toys have not.
    monkeypatch.setattr("mien.pipeline.track.show_tracking", lambda *given: None)
    return tmp_path / "W"


@pytest.mark.unchecked
def test_the_command_aligns_once_and_always_from_the_tracking(workspace: Path, capsys) -> None:
    tracked = workspace / "sequences/clip/tracking"

    def run(*options: str, code: int = 0) -> str:
        assert main(["align", str(workspace), *OPTIONS, *options]) == code
        return capsys.readouterr().err

    def face() -> torch.Tensor:
        return read_tracking(tracked).face.expression.clone()  # not a map of the file

    before = face()
    told, once = run(), face()
    assert not once.equal(before)
    assert "clip: aligned; heads turned by" in told
    assert "Trained on the tracking before its alignment: toy." in told
    assert not list(workspace.glob("sequences/.alignment-*"))
    assert "the tracking is aligned, nothing to do" in run()
    run("--alignment.iterations", "3")
    assert not face().equal(once)
    run()
    assert face().equal(once)
    (tracked / "before_alignment.safetensors").unlink()
    assert "mien track --again" in (told := run("--seed", "1", code=2))
    assert "before_alignment.safetensors" in told
    shutil.rmtree(tracked)
    assert "run `mien track" in run(code=2)


@pytest.mark.unchecked
@pytest.mark.parametrize(("preset", "aligned", "tells"), [
    ("paper", True, True), ("paper", False, False), ("draft", True, False),
])  # fmt: skip
def test_a_run_as_published_says_that_its_frames_were_aligned(workspace, capsys, preset, aligned, tells) -> None:
    folder = workspace / "sequences/clip/tracking"
    write_tracking(folder, replace(read_tracking(folder), settings={"aligned": {"iterations": 2}} if aligned else {}))
    assert main(["train", str(workspace), "--run", "other", "--preset", preset, "--steps", "2"]) == 0
    told = [line for line in capsys.readouterr().err.splitlines() if "clip: frames were aligned to a quick" in line]
    assert len(told) == tells


def test_a_paper_s_epochs_are_passes_over_the_data_or_a_message_says_how(workspace, capsys, monkeypatch) -> None:
    monkeypatch.setattr("mien.pipeline.train.train", lambda *given, **more: None)
    summary = {"gaussians": 400, "steps": 1, "seconds": 0.0}
    monkeypatch.setattr("mien.pipeline.train.read_training_summary", lambda run_dir: summary)
    told = []
    line = ["train", str(workspace), "--run", "other", "--method", "mono_gaussian_avatar"]
    for preset, steps in (("paper", "479"), ("paper", "480"), ("draft", "479")):
        assert main([*line, "--preset", preset, "--steps", steps]) == 0
        told.append("over the 4 training frames, as in the paper; --steps 480 makes" in capsys.readouterr().err)
    assert told == [True, False, False]


def test_wrong_options_are_one_line(workspace: Path, capsys) -> None:
    for option, told in (
        (("--alignment.iterations", "0"), "--alignment.iterations 0: give a number from 1 to 100000"),
        (("--alignment.when", "never"), "leave it out, as this command aligns"),
        (("--split", "dataset"), "--split dataset: give one of blocks, tail, none"),
        (("--hold-out", "other"), "other"),
    ):
        assert told in complaint(capsys, "align", str(workspace), *option)


@pytest.mark.parametrize(("several", "when", "options", "aligns"), [
    (False, "auto", [], True), (False, "auto", ["--preset", "draft"], True),
    (False, "auto", ["--preset", "paper"], False), (False, "auto", ["--steps", "100"], False),
    (False, "never", [], False), (True, "auto", [], False), (True, "always", [], True),
])  # fmt: skip
def test_create_aligns_one_camera_and_no_paper(several, when, options, aligns) -> None:
    command = parse_options(Create, "mien create", ["a.mp4", "--out", "out", "--alignment.when", when, *options])
    assert command.aligns(several) == aligns


NAMES = (
    "jawOpen", "browInnerUp", "browOuterUpLeft", "browOuterUpRight", "mouthSmileLeft", "mouthSmileRight",
    "eyeBlinkLeft", "other",
)  # fmt: skip
FRAMES = 100


def model() -> FaceModel:
    small = make_small_face_model()
    return replace(small, expression_names=NAMES[: small.expression_basis.shape[0]])


def talking(held: dict[str, float], head: float = 0.0, eyes: float = 0.0) -> FaceParams:
    """Return a person who talks a little around what is held throughout. Angles to the left are in degrees."""
    random, given = np.random.default_rng(0), model()
    expression = 0.1 * random.uniform(size=(FRAMES, len(given.expression_names)))
    for name, value in held.items():
        expression[:, given.expression_names.index(name)] += value
    expression[:5] *= 0.9
    joints = torch.zeros(FRAMES, len(given.free_joint_names), 3)
    for index, name in enumerate(given.free_joint_names):
        if "eye" in name:
            joints[:, index, 1] = np.radians(eyes)
    rotation = torch.zeros(FRAMES, 3)
    rotation[:, 1] = np.radians(head)
    rotation[:, 0] = 0.02 * torch.sin(torch.arange(FRAMES) / 9)
    return FaceParams(
        given.neutral().identity, torch.from_numpy(expression).float(), joints, rotation,
        torch.zeros(FRAMES, 3), given.neutral().vertex_offsets,
    )  # fmt: skip


def driven(face: FaceParams, neutral: str | None = None) -> FaceParams:
    driver = with_neutral(Driver(face, neutral_of(face), 25.0, None), model(), neutral, "clip")
    return drive(driver.face, driver.at_rest, model().neutral())


def test_what_is_held_or_turned_throughout_reaches_the_avatar(capsys: pytest.CaptureFixture[str]) -> None:
    """An open mouth, raised brows and a grin that never end are motion. The default says so, and calm is as before."""
    for held in (
        {"jawOpen": 0.6}, {"browInnerUp": 0.8, "browOuterUpLeft": 0.7}, {"mouthSmileLeft": 0.7, "mouthSmileRight": 0.7},
    ):  # fmt: skip
        face, name = talking(held), list(held)[0]
        index = NAMES.index(name)
        torch.testing.assert_close(driven(face).expression[:, index], face.expression[:, index])
        told = capsys.readouterr().err
        for words in (
            "clip: its face at rest is the calmest tenth of its frames", f"clip: it never rests ({name} 0.",
            "--neutral calm",
        ):  # fmt: skip
            assert words in told
        assert driven(face, "calm").expression[:, index].mean() < 0.1
        torch.testing.assert_close(driven(face, "model").expression[:, index], face.expression[:, index])
    head, gaze = talking({}, head=55), talking({}, eyes=26)
    for neutral in (None, "model"):
        torch.testing.assert_close(driven(head, neutral).head_rotation, head.head_rotation, atol=1e-5, rtol=0)
    assert driven(head, "calm").head_rotation.abs().max() < 0.05
    assert driven(gaze, "calm").joints.abs().max() < 1e-5
    # Eyes that make up for a turned head move with it: it looks into the camera still.
    for face in (gaze, talking({}, head=60, eyes=-50)):
        torch.testing.assert_close(driven(face).joints, face.joints, atol=1e-5, rtol=0)


def test_who_rests_is_transferred_as_before_and_motion_grows_without_a_jump() -> None:
    for face in (talking({"browInnerUp": 0.2}, head=-25, eyes=24), talking({"jawOpen": 0.15}, eyes=10), talking({})):
        calm = neutral_of(face)
        rest = rest_of(calm, model())
        assert rest.moved == ()
        for name, tensor in calm.tensors().items():
            assert torch.equal(getattr(rest.face, name), tensor), name
    # What counts as ahead is the camera of any world. Who looks into it rests there.
    viewmat = torch.eye(4)
    viewmat[:3, :3] = matrix_from_axis_angle(torch.tensor([0.4, 2.2, -0.8]))
    ahead = facing(viewmat)
    calm = replace(neutral_of(talking({})), head_rotation=axis_angle_from_matrix(ahead)[None])
    assert rest_of(calm, model(), ahead).moved == ()
    aside = ahead @ matrix_from_axis_angle(torch.tensor([0.0, 1.0, 0.0]))
    rest = rest_of(replace(calm, head_rotation=axis_angle_from_matrix(aside)[None]), model(), ahead)
    torch.testing.assert_close(matrix_from_axis_angle(rest.face.head_rotation)[0], ahead, atol=1e-5, rtol=0)
    assert rest.moved == ("the head 57 degrees to the side",)
    for limits in (REST_EXPRESSION, REST_HEAD, REST_GAZE):
        sizes = torch.linspace(0, 2 * limits[1], 2001)
        moved = sizes * (1 - kept_share(sizes, limits))
        assert ((moved.diff() >= 0) & (moved.diff() < 0.01)).all()
        assert (moved[sizes <= limits[0]] == 0).all()
        torch.testing.assert_close(moved[sizes >= limits[1]], sizes[sizes >= limits[1]])


def tracked(folder: Path, first: float, then: float) -> Path:
    """Write a tracked sequence of 30 frames. Its first expression has two values, before and after frame 15."""
    _, sequence = toy_sequence(30, 32)
    expression = torch.zeros_like(sequence.tracking.face.expression)
    expression[:15, 0], expression[15:, 0] = first, then
    face = replace(sequence.tracking.face, expression=expression)
    write_sequence(folder, sequence.capture, replace(sequence.tracking, face=face))
    return folder


def recorded(path: Path, count: int, **values: float) -> Path:
    return write_csv(path, *(row(f"0:00:00:{index:02d}.0", JawOpen=0.5, **values) for index in range(count)))


def test_the_option_of_every_command(tmp_path: Path) -> None:
    workspace, other = tmp_path / "w", tmp_path / "other"
    tracked(workspace / "sequences" / "clip", 0.7, 0.5)
    still = tracked(other / "sequences" / "still", 0.1, 0.1)
    for neutral, expected in (
        (None, 0.5 / 3), ("first", 0.7), ("calm", 0.5), ("model", 0.0), (str(other), 0.1), (str(still), 0.1),
    ):  # fmt: skip
        driver = open_driver(workspace, None, toy_face_model(), neutral=neutral)
        assert float(driver.at_rest.expression[0, 0]) == pytest.approx(expected, abs=1e-6), neutral
    refuses(r"--neutral rest: no such file; give first, calm or model", check_neutral, "rest")
    with pytest.raises(UserError, match="was tracked with another face model"):
        open_driver(recorded(tmp_path / "a.csv", 3), None, model(), neutral=str(still))
    # The zero of a recording's coefficients is the recorder's neutral; its head may be turned throughout.
    by = recorded(tmp_path / "b.csv", 30, HeadYaw=0.9)
    for neutral, jaw, turn in ((None, 0.0, 0.0), ("calm", 0.5, 0.9), ("first", 0.5, 0.9), ("model", 0.0, 0.0)):
        rest = open_driver(by, None, model(), neutral=neutral).at_rest
        assert float(rest.expression[0, NAMES.index("jawOpen")]) == pytest.approx(jaw), neutral
        assert float(rest.head_rotation.norm()) == pytest.approx(turn, abs=1e-5), neutral
