"""Pictures of other programs, faces fitted to held-out pictures, and cross-reenactment get their figures."""

import contextlib
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from evaluation_case import drawn_sequence, make_experiment, two_cameras, write_run, write_sequence
from mien.avatar.methods import METHODS
from mien.cli import main
from mien.disk.files import read_json
from mien.evaluation import cross, evaluate, protocols
from mien.evaluation.cross import cross_reenactment, load_driven
from mien.evaluation.experiment import Experiment, avatar_image, target_image
from mien.evaluation.image_folders import ImageFolders, read_crops, score_folders, write_crops
from mien.evaluation.metrics import l1, psnr
from mien.evaluation.redetection import angle_degrees, measure_motion, transfer_figures
from mien.evaluation.scoring import ScoreSettings
from mien.evaluation.text import protocol_lines
from mien.face.params import most_frontal_camera
from mien.media.video import probe_video, write_video
from mien.rotation import matrix_from_axis_angle
from mien.tracking import write_tracking
from mien.tracking.scoring import Scoring
from plain_settings import plain_config, plain_run
from refusals import complaint, refuses
from shared_things import write_toy_workspace

pytestmark = [pytest.mark.unchecked, pytest.mark.usefixtures("short_films")]
PLAIN = ScoreSettings(perceptual=False)


def write_pictures(folder: Path, names: str, seed: int = 0, size: tuple[int, int] = (40, 36)) -> None:
    folder.mkdir(exist_ok=True)
    for name, picture in zip(names, np.random.default_rng(seed).integers(0, 256, (len(names), *size, 3)), strict=True):
        cv2.imwrite(str(folder / f"{name}.png"), picture.astype(np.uint8))


@pytest.fixture
def folders(tmp_path: Path) -> ImageFolders:
    for seed, name in enumerate(("truth", "mine")):
        write_pictures(tmp_path / name, "abc", seed)
    return ImageFolders(tmp_path / "mine", tmp_path / "truth")


def test_the_same_pictures_get_the_same_figures_as_in_evaluate(tmp_path: Path) -> None:
    experiment = make_experiment(20)
    folder, run_dir = write_sequence(tmp_path, experiment, experiment.sequences[0]), tmp_path / "runs" / "first"
    write_run(run_dir, experiment, [folder], plain_run(steps=2, checkpoint_every=2))
    settings = protocols.EvaluationSettings(perceptual_frames=3, pictures=True, baselines=False, video_frames=0)
    entry = evaluate(run_dir, [folder], settings)["protocols"]["self_reenactment"]
    pictures = run_dir / "pictures" / "self_reenactment"
    scores = score_folders(ImageFolders(pictures / "rendering", pictures / "truth"), ScoreSettings(perceptual_frames=3))
    assert (scores["per_frame"]["name"][0], scores["crop"]) == ("clip_0_000016", entry["crop"])
    for metric in ("psnr", "ssim", "l1", "perceptual"):
        assert scores[metric] == pytest.approx(entry[metric], abs=1e-6)
        assert scores["head"][metric] == pytest.approx(entry["head"][metric], abs=1e-6)


def test_mattes_cut_the_truth_and_give_the_head_crop(folders: ImageFolders, tmp_path: Path, capsys) -> None:
    matte = np.zeros((40, 36), np.uint8)
    matte[10:30, 5:25] = 255
    (tmp_path / "mattes").mkdir()
    for name in "abc":
        truth = cv2.imread(str(folders.truth / f"{name}.png"))
        assert truth is not None
        cv2.imwrite(str(tmp_path / "mattes" / f"{name}.png"), matte)
        cv2.imwrite(str(folders.images / f"{name}.png"), np.where(matte[..., None] > 0, truth, 0))
    black = score_folders(ImageFolders(folders.images, folders.truth, tmp_path / "mattes", background="black"), PLAIN)
    assert black["psnr"] == black["head"]["psnr"] == 100.0
    assert black["mask"] == "mattes, over black"
    assert "not black where" not in " ".join(capsys.readouterr().err.split())
    white = score_folders(ImageFolders(folders.images, folders.truth, tmp_path / "mattes"), PLAIN)
    assert white["head"]["psnr"] == 100.0
    assert white["psnr"] < 10
    assert "not white where the mattes are empty" in " ".join(capsys.readouterr().err.split())


def test_figures_are_those_of_the_metrics(folders: ImageFolders, capsys, tmp_path: Path) -> None:
    write_pictures(folders.images, "d")
    scores = score_folders(folders, PLAIN)
    assert scores["frames"] == 3
    assert "1 pictures have no truth" in capsys.readouterr().err
    pictures = [[cv2.imread(str(folder / f"{n}.png")) for n in "abc"] for folder in (folders.images, folders.truth)]
    images, truths = torch.from_numpy(np.array(pictures)).float() / 255
    figures = [psnr(image, truth) for image, truth in zip(images, truths, strict=True)]
    assert scores["per_frame"]["psnr"] == pytest.approx(figures, rel=1e-6)
    assert scores["psnr"] == pytest.approx(np.mean(figures))
    assert (scores["crop"], scores["head"]["psnr"]) == (None, None)
    # An alpha channel is put over the background.
    for name in "abc":
        cv2.imwrite(str(folders.images / f"{name}.png"), np.zeros((40, 36, 4), np.uint8))
        cv2.imwrite(str(folders.truth / f"{name}.png"), np.full((40, 36, 3), 255, np.uint8))
    assert score_folders(folders, PLAIN)["psnr"] == 100.0


def test_crops_beside_the_truth_are_found(folders: ImageFolders) -> None:
    path = folders.truth / "crops.json"
    write_crops(path, {name: (4, 4, 20, 20) for name in "abc"})
    assert score_folders(folders, PLAIN)["head"]["psnr"] is not None
    for crops, words in (
        ({"a": (4, 4, 20, 20)}, "no head box for b, c"),
        ({name: (99, 4, 20, 20) for name in "abc"}, "is outside the picture"),
    ):
        write_crops(path, crops)
        refuses(words, score_folders, folders, PLAIN)
    path.write_text('{"format": "mien.crops", "version": 1, "crops": {"a": [1, 2, 3]}}')
    refuses("'a' has no box", read_crops, path)


def test_pictures_that_do_not_match_or_are_damaged_are_named(folders: ImageFolders, tmp_path: Path) -> None:
    (folders.images / "b.png").rename(folders.images / "z.png")
    refuses(r"lacks 1 of the 3 pictures.*\(b; it has a, c, z\)", score_folders, folders, PLAIN)
    write_pictures(folders.images, "b", size=(20, 20))
    refuses("b has 20x20 pixels, and its truth has 36x40", score_folders, folders, PLAIN)
    path = folders.images / "b.png"
    path.write_bytes(path.read_bytes()[:-40])
    refuses(r"b\.png: is not a complete picture", score_folders, folders, PLAIN)
    cv2.imwrite(str(path), np.zeros((40, 36, 3), np.uint16))
    refuses("8 bits", score_folders, folders, PLAIN)


def test_videos_are_matched_by_order(folders: ImageFolders, tmp_path: Path) -> None:
    smooth = [np.full((40, 36, 3), 60 * index, np.uint8) for index in range(3)]
    write_video(tmp_path / "mine.mp4", smooth, 25, crf=10)
    for name, picture in zip("abc", smooth, strict=True):
        cv2.imwrite(str(folders.truth / f"{name}.png"), picture)
    assert score_folders(ImageFolders(tmp_path / "mine.mp4", folders.truth), PLAIN)["psnr"] > 40
    assert score_folders(ImageFolders(folders.truth, tmp_path / "mine.mp4"), PLAIN)["psnr"] > 40
    (folders.truth / "c.png").unlink()
    refuses(r"has 3 pictures, .* has 2", score_folders, ImageFolders(tmp_path / "mine.mp4", folders.truth), PLAIN)


def test_command(folders: ImageFolders, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = ["evaluate", "images", str(folders.images), str(folders.truth), "--no-perceptual"]
    out = tmp_path / "scores.json"
    assert main([*given, "--json", "--out", str(out)]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["psnr"] == read_json(out, "mien.scores", 1)["psnr"]
    assert main(given) == 0
    assert f"PSNR {printed['psnr']:.2f} dB" in capsys.readouterr().out
    for wrong in (
        ["evaluate"], ["evaluate", "images", str(folders.images)], ["evaluate", str(tmp_path), str(tmp_path)],
        ["evaluate", "images", str(tmp_path / "none"), str(folders.truth)], [*given, "--fit-faces"],
    ):  # fmt: skip
        assert main(wrong) == 2
    write_toy_workspace(tmp_path / "W")
    told = complaint(capsys, "evaluate", str(tmp_path / "W"), "--fit-faces", "--fit-steps", "0")
    assert "--fit-steps 0: give a number from 1 to 10000" in told


QUICK = protocols.EvaluationSettings(perceptual=False, video_frames=0, baselines=False, threads=1)
FIT = replace(QUICK, fit_faces=True)


def astray(experiment: Experiment) -> Experiment:
    """Return the experiment with face parameters that are a little wrong."""
    (face,) = experiment.faces
    wrong = replace(
        face, expression=(face.expression + 0.1).clamp(0, 1), head_rotation=face.head_rotation + 0.02,
        head_translation=face.head_translation + torch.tensor([0.004, -0.004, 0.0]),
    )  # fmt: skip
    return replace(experiment, faces=(wrong,), face_source="corrected")


def drawn_by(method: str) -> Experiment:
    """Return an experiment whose pictures a new avatar of that method drew."""
    base, chosen = make_experiment(5), METHODS[method]
    torch.manual_seed(0)
    avatar = chosen.avatar(plain_config(method), base.avatar.face_model, base.faces[0])
    sequence = drawn_sequence(avatar, base.faces[0], base.sequences[0].tracking.cameras[0])
    scorings = (Scoring(sequence.scoring, base.scorings[0].crops),)
    return replace(base, avatar=avatar, sequences=(sequence,), scorings=scorings)


@pytest.mark.parametrize("method", METHODS)
def test_fitted_faces_draw_the_picture_better_and_change_nothing_else(method: str) -> None:
    experiment = astray(drawn_by(method))
    avatar, frame = experiment.avatar, experiment.held_out_frames[0]
    before = {name: tensor.clone() for name, tensor in avatar.state_dict().items()}
    wanted = [tensor.requires_grad for tensor in avatar.parameters()]
    start = experiment.face(frame)
    truth = target_image(experiment, frame)
    with torch.no_grad():
        fitted = protocols.fit_face(experiment, [frame], 20)
    assert l1(avatar_image(experiment, frame, fitted), truth) < 0.9 * l1(avatar_image(experiment, frame), truth)
    assert all(torch.equal(tensor, before[name]) for name, tensor in avatar.state_dict().items())
    assert [tensor.requires_grad for tensor in avatar.parameters()] == wanted
    assert all(tensor.grad is None for tensor in avatar.parameters())
    assert not any(term for group in avatar.parameter_groups() for one in group.factored.values() for term in one.terms)
    assert fitted.identity.equal(start.identity)
    low, high = avatar.face_model.expression_bounds.unbind(-1)
    low, high = start.expression.minimum(low), start.expression.maximum(high)
    assert bool(((fitted.expression >= low) & (fitted.expression <= high)).all())
    assert experiment.face(frame).expression.equal(start.expression)


def test_fits_are_a_third_figure_in_any_order_and_never_the_headline(tmp_path: Path) -> None:
    experiment = astray(make_experiment(10))
    frames = experiment.held_out_frames
    for steps, shown in ((3, protocols.FITTED), (0, protocols.AVATAR)):
        forward, backward = (
            {
                frame: drawn
                for frame, drawn, _ in protocols.drawn_frames(experiment, list(order), {protocols.OPENED}, None, steps)
            }
            for order in (frames, frames[::-1])
        )
        for frame in frames:
            assert forward[frame][shown].equal(backward[frame][shown])
            assert forward[frame][protocols.OPENED].equal(protocols.opened(forward[frame][shown])), (
                "the fitted face, if there is one"
            )
    experiment = astray(make_experiment(10))
    plain = protocols.evaluate_frames(experiment, QUICK)
    partial = protocols.PartialScores(tmp_path / "partial", "one")
    scored = protocols.evaluate_frames(experiment, FIT, partial)
    assert set(scored.scores) == {protocols.AVATAR, protocols.AS_TRACKED, protocols.FITTED}
    assert scored.scores[protocols.AVATAR] == plain.scores[protocols.AVATAR]
    without, entry = (protocols.protocol_content(experiment, each, FIT) for each in (plain, scored))
    assert "fitted" not in without
    assert entry["psnr"] == without["psnr"]
    assert entry["fitted"]["psnr"] > entry["psnr"] + 1
    assert entry["fitted"]["head"]["psnr"] > entry["head"]["psnr"]
    assert entry["fitted"]["fit"]["steps"] == 20
    assert "fitted" not in protocol_lines("self_reenactment", entry)[1]
    assert protocols.evaluate_frames(experiment, FIT, partial).scores == scored.scores, "resumed"


def _face(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(478, 3)) * 50


def _turn(*axis_angle: float) -> np.ndarray:
    return matrix_from_axis_angle(torch.tensor(axis_angle, dtype=torch.float64)).numpy()


def test_head_pose_size_and_identity_do_not_count_as_expression() -> None:
    at_rest, rotation = _face(), _turn(0.0, 0.4, 0.0)
    moved = measure_motion(0.8 * at_rest @ rotation.T + 5, at_rest)
    assert np.abs(moved.displacement).max() < 1e-9
    np.testing.assert_allclose(moved.rotation, rotation, atol=1e-9)
    assert angle_degrees(moved.rotation) == pytest.approx(np.degrees(0.4))
    opened = at_rest.copy()
    opened[14, 1] += 10  # the lower lip
    unit = np.linalg.norm(at_rest[33] - at_rest[263])
    same_on_a_larger_face = measure_motion(3 * opened, 3 * at_rest)
    assert np.linalg.norm(same_on_a_larger_face.displacement, axis=1).max() == pytest.approx(10 / unit)


def test_figures_of_perfect_still_and_opposite_avatars() -> None:
    at_rest = _face()
    motions = []
    for step in range(6):
        points = at_rest.copy()
        points[14] += (at_rest[14] - at_rest[13]) * 0.2 * step
        motions.append(measure_motion(points @ _turn(0.0, 0.1 * step, 0.0).T, at_rest))
    perfect = transfer_figures([(one, one) for one in motions])
    assert perfect["expression_error"] == 0
    assert perfect["head_rotation_error_degrees"] == pytest.approx(0, abs=1e-5)
    assert perfect["mouth_correlation"] == pytest.approx(1)
    assert perfect["eyes_correlation"] is None, "eyes that never move correlate with nothing"
    still = transfer_figures([(one, motions[0]) for one in motions])
    assert still["expression_error"] == pytest.approx(still["expression_error_still"])
    assert still["head_rotation_error_degrees"] == pytest.approx(still["head_rotation_error_still_degrees"])
    opposite = transfer_figures(list(zip(motions, motions[::-1], strict=True)))
    assert opposite["mouth_correlation"] == pytest.approx(-1)


class _MadeUpReader(contextlib.nullcontext):
    """Detector whose landmarks turn with the brightness of the picture. It finds no face in white pictures."""

    def __enter__(self) -> "_MadeUpReader":
        return self

    def read(self, image: np.ndarray) -> np.ndarray:
        return (_face() @ _turn(0.0, float(image.mean()) / 255, 0.0).T)[None][: int(image.min() < 255)]


@pytest.fixture(scope="module")
def two_people(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return a run, and a sequence of another workspace with two cameras."""
    root = tmp_path_factory.mktemp("cross")
    experiment = make_experiment(timesteps=10)
    own = write_sequence(root / "anna", experiment, experiment.sequences[0])
    settings = plain_run(steps=5, checkpoint_every=5, split="none")
    write_run(root / "anna" / "runs" / "first", experiment, [own], settings)
    other = make_experiment(timesteps=10, seed=1)
    return own, write_sequence(root / "bert", other, two_cameras(other, "talk"))


def test_protocol_from_folders(two_people: tuple[Path, Path], monkeypatch, capsys) -> None:
    monkeypatch.setattr(cross, "MeshReader", lambda *_, **__: _MadeUpReader())
    own, driver = two_people
    anna, bert = own.parent.parent, driver.parent.parent
    assert main(["evaluate", str(anna), "--no-perceptual", "--drivers", str(bert), str(own)]) == 0
    assert "cross_reenactment (2 drivers, 20 frames): expression error" in capsys.readouterr().err
    entry = json.loads((anna / "runs/first/metrics.json").read_text())["protocols"]["cross_reenactment"]
    assert [one["driver"] for one in entry["drivers"]] == ["bert_talk", "anna_clip"]
    assert entry["faces_found"] == 1.0
    assert entry["head_rotation_error_degrees"] == pytest.approx(
        np.mean([one["head_rotation_error_degrees"] for one in entry["drivers"]])
    )
    assert probe_video(anna / "runs/first/videos/cross_reenactment_bert_talk.mp4").frames == 10
    page = (anna / "runs/first/report.html").read_text()
    assert "Cross-reenactment" in page
    assert page.count("<video") == 2
    # The driven avatar keeps its identity, and moves from its own neutral face.
    driven = load_driven(own.parent.parent / "runs" / "first", own, driver)
    assert len(driven.faces) == 10
    torch.testing.assert_close(driven.faces.identity, driven.avatar.subject.identity)
    assert driven.driver_camera == 0, "the front camera looks at the face"
    moved = (driven.faces.head_rotation - driven.avatar.subject.head_rotation).norm(dim=1)
    assert moved[driven.by_rest[0]] < moved[driven.by_rest[-1]]
    assert most_frontal_camera(driven.tracking.cameras[::-1], driven.avatar.subject) == 1


def test_drivers_that_cannot_drive(two_people: tuple[Path, Path], tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(cross, "MeshReader", lambda *_, **__: _MadeUpReader())
    monkeypatch.setattr(cross.Driven, "driver_picture", lambda self, timestep: np.full((8, 8, 3), 255, np.uint8))
    own, driver = two_people
    run = own.parent.parent / "runs" / "first"
    refuses("no face is found in the driver's pictures", cross_reenactment, run, own, [driver], 0)
    seldom = lambda self, timestep: np.full((8, 8, 3), 255 if timestep % 2 else 90, np.uint8)  # noqa: E731
    monkeypatch.setattr(cross.Driven, "driver_picture", seldom)
    entry = cross_reenactment(run, own, [driver], 0)[0]
    assert (entry["faces_found"], entry["frames"]) == (1.0, 5), "where the driver has no face, none can be missed"
    tracking = replace(make_experiment(timesteps=10).sequences[0].tracking, face_model_hash="other")
    write_tracking(tmp_path / "sequences" / "x" / "tracking", tracking)
    refuses("track the driver with the avatar's", cross_reenactment, run, own, [tmp_path / "sequences" / "x"], 0)
