"""Pictures of other programs and faces fitted to held-out pictures get the figures of `mien evaluate`."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from evaluation_case import drawn_sequence, make_experiment, write_run, write_sequence
from mien.avatar.methods import METHODS
from mien.cli import main
from mien.disk.files import read_json
from mien.evaluation import evaluate, protocols
from mien.evaluation.experiment import Experiment, avatar_image, target_image
from mien.evaluation.image_folders import ImageFolders, read_crops, score_folders, write_crops
from mien.evaluation.metrics import l1, psnr
from mien.evaluation.scoring import ScoreSettings
from mien.evaluation.text import protocol_lines
from mien.media.video import write_video
from mien.tracking.scoring import Scoring
from plain_settings import plain_config, plain_run
from refusals import complaint, refuses
from shared_things import write_toy_workspace

pytestmark = pytest.mark.unchecked
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
    scores = score_folders(ImageFolders(tmp_path / "mine.mp4", folders.truth), PLAIN)
    assert scores["psnr"] > 40
    assert score_folders(ImageFolders(folders.truth, tmp_path / "mine.mp4"), PLAIN)["psnr"] > 40
    (folders.truth / "c.png").unlink()
    refuses(r"has 3 pictures, .* has 2", score_folders, ImageFolders(tmp_path / "mine.mp4", folders.truth), PLAIN)


def test_command(folders: ImageFolders, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = ["evaluate", "images", str(folders.images), str(folders.truth), "--no-perceptual"]
    out = tmp_path / "scores.json"
    assert main([*given, "--json", "--out", str(out)]) == 0
    printed = json.loads(capsys.readouterr().out)
    stored = read_json(out, "mien.scores", 1)
    assert printed["psnr"] == stored["psnr"]
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
