"""The split of GaussianAvatars by name: tables 1 and 2 of its supplement, and what the command line makes of it."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mien.capture import write_capture
from mien.cli import main
from mien.commands.stages import training as training_stage
from mien.commands.stages.evaluating import _driver_folders
from mien.errors import UserError
from mien.tracking import write_tracking
from mien.training import PRESETS, TrainSettings, doubly_held_out, split_by_name, with_named_split
from mien.training.footage.frames import training_frames
from mien.training.footage.named_split import SEQUENCES, driving_sequences
from toy_scene import toy_sequence

FOLDERS = (
    "EMO-1-shout+laugh", "EMO-2-surprise+fear", "EMO-3-angry+sad", "EMO-4-disgust+happy", "EXP-2-eyes",
    "EXP-3-cheeks+nose", "EXP-4-lips", "EXP-5-mouth", "EXP-8-jaw-1", "EXP-9-jaw-2", "FREE", "SEN-01-cramp_small_danger",
)  # fmt: skip
"""Names of NeRSemble's folders."""
NAMED = TrainSettings(split="gaussian-avatars")


@pytest.mark.parametrize(
    ("subject", "test"),
    [
        ("074", "EMO-4"), ("104", "EXP-2"), ("218", "EXP-9"), ("253", "EMO-4"), ("264", "EXP-9"), ("302", "EMO-2"),
        ("304", "EXP-2"), ("306", "EXP-2"), ("460", "EMO-3"),
    ],
)  # fmt: skip
def test_table_2(subject: str, test: str) -> None:
    for names in (FOLDERS, (*SEQUENCES, "FREE"), tuple(f"{subject}_{name}" for name in FOLDERS)):
        split = split_by_name(names, f"nersemble_{subject}")
        assert split.subject == subject
        assert test in split.held_out
        assert len(split.sequences) == 10
        assert set(split.sequences) | set(split.left_out) == set(names)
        assert driving_sequences(split.left_out) == [name for name in names if "FREE" in name]
        assert with_named_split(NAMED, split).held_out_sequences == (split.held_out,)


def test_a_given_subject_wins_over_the_folder() -> None:
    assert split_by_name(FOLDERS, "104", "306").subject == "306"
    assert split_by_name(FOLDERS, "somebody", "74").held_out == "EMO-4-disgust+happy"


def test_what_the_names_do_not_say_is_told_with_the_remedy() -> None:
    for names, folder, subject, words in (
        (FOLDERS, "me", None, "'me' does not say which subject it is; give --subject (the subjects are 074"),
        (FOLDERS, "104_306", None, "does not say which subject"),
        (FOLDERS, "1306", None, "does not say which subject"),
        (FOLDERS, "306", "307", "--subject 307: is not a subject of --split gaussian-avatars; the subjects are 074"),
        (FOLDERS[1:], "306", None, "EMO-1 of subject 306 is missing; capture it with --name EMO-1 and track again"),
        (("FREE",), "306", None, "EMO-1, EMO-2, EMO-3, EMO-4, EXP-2, EXP-3, EXP-4, EXP-5, EXP-8, EXP-9 of subject"),
        ((*FOLDERS, "EXP-2"), "306", None, "EXP-2-eyes and EXP-2 are both EXP-2; name one of them with --sequences"),
    ):  # fmt: skip
        with pytest.raises(UserError) as told:
            split_by_name(names, folder, subject)
        assert words in str(told.value)
        assert "\n" not in str(told.value)


def test_either_name_of_the_camera_is_held_out() -> None:
    split = split_by_name(SEQUENCES, "306")
    ids: dict[str, tuple[str, ...]] = {name: ("07", "08", "09") for name in SEQUENCES}
    assert with_named_split(NAMED, split, ids).held_out_cameras == ("08",)
    ids["EXP-4"] = ("222200036", "222200037")
    settings = with_named_split(NAMED, split, ids)
    assert settings.held_out_cameras == ("08", "222200037")
    assert with_named_split(settings, split, ids) == settings, "the config of a run can be repeated"
    ids["EXP-4"] = ("front",)
    with pytest.raises(UserError, match=r"EXP-4 has no camera 08 or 222200037, which it holds out \(there are front\)"):
        with_named_split(NAMED, split, ids)


def test_nothing_else_may_be_held_out() -> None:
    split = split_by_name(SEQUENCES, "306")
    for settings, words in (
        (replace(NAMED, held_out_sequences=("EMO-1",)), "--hold-out EMO-1: --split gaussian-avatars decides"),
        (replace(NAMED, held_out_cameras=("03",)), "--hold-out-cameras 03: --split gaussian-avatars decides"),
    ):
        with pytest.raises(UserError, match=words):
            with_named_split(settings, split)


def test_a_split_that_was_not_filled_in_is_refused() -> None:
    _, sequence = toy_sequence(6, 16)
    with pytest.raises(UserError, match="are not filled in"):
        training_frames([sequence], NAMED)


def test_frames_withheld_twice_are_told() -> None:
    assert doubly_held_out(TrainSettings()) is None
    assert doubly_held_out(TrainSettings(split="none", held_out_sequences=("a",))) is None
    told = doubly_held_out(TrainSettings(held_out_sequences=("a", "b")))
    assert told is not None
    assert told.startswith(
        "--split blocks holds out a fifth of each other sequence as well, beside --hold-out a b; add"
    )


# -- the command line -------------------------------------------------------------------------------------------------


def write_subject(root: Path, names: tuple[str, ...] = FOLDERS, camera: str = "08") -> Path:
    """Write a workspace whose sequences have two cameras each."""
    _, sequence = toy_sequence(5, 16)
    capture = sequence.capture
    two = replace(
        capture, camera_ids=(camera, "09"), images=capture.images.repeat(2, 1), mattes=capture.mattes.repeat(2, 1),
        landmarks=capture.landmarks.repeat(2, 1), valid=capture.valid.repeat(2, 1),
        principal_point=capture.principal_point.repeat(2, 0), calibration=sequence.tracking.cameras * 2,
    )  # fmt: skip
    first = root / "sequences" / names[0]
    write_capture(first / "capture", two)
    tracking = sequence.tracking
    write_tracking(
        first / "tracking",
        replace(
            tracking, cameras=tracking.cameras * 2, neck_lines=tracking.neck_lines.repeat(1, 2, 1),
            residuals=tracking.residuals.repeat(1, 2),
        ),
    )  # fmt: skip
    for name in names[1:]:
        shutil.copytree(first, root / "sequences" / name)
    return root


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[list[str], TrainSettings]]:
    found: list[tuple[list[str], TrainSettings]] = []

    def remember(
        workspace: object, names: list[str], run: object, method: object, settings: TrainSettings, view: bool
    ) -> None:
        found.append((names, settings))

    monkeypatch.setattr(training_stage, "run_training_stage", remember)
    return found


def test_train_takes_the_split_by_name(tmp_path: Path, asked: list[Any], capsys: pytest.CaptureFixture[str]) -> None:
    root = write_subject(tmp_path / "306")
    assert main(["train", str(root), "--split", "gaussian-avatars"]) == 0
    names, settings = asked.pop()
    assert names == [*FOLDERS[:10]]
    held = {"held_out_sequences": ("EXP-2-eyes",), "held_out_cameras": ("08",)}
    assert settings == replace(PRESETS["standard"].settings, split="gaussian-avatars", **held)
    shown = capsys.readouterr().err
    assert "held out are the sequence EXP-2-eyes and camera 08; not used: FREE, SEN-01" in shown
    assert "warning" not in shown
    config = tmp_path / "again.json"
    config.write_text(json.dumps({"settings": {"split": settings.split, "held_out_cameras": ["08"]}}))
    assert main(["train", str(root), "--config", str(config)]) == 0
    assert asked.pop() == (names, settings)


@pytest.mark.parametrize(
    ("folder", "names", "camera", "line", "words"),
    [
        ("me", FOLDERS, "08", "", "does not say which subject"),
        ("306", FOLDERS[:4], "08", "", "EXP-2, EXP-3, EXP-4, EXP-5, EXP-8, EXP-9 of subject 306 is missing"),
        ("306", FOLDERS, "front", "", "has no camera 08"),
        ("306", FOLDERS, "08", "--hold-out FREE", "--hold-out FREE: --split gaussian-avatars decides"),
        ("306", FOLDERS, "08", "--subject 999", "--subject 999: is not a subject"),
        ("306", FOLDERS, "08", "--sequences FREE", "is missing"),
    ],
)
def test_train_refuses_what_does_not_fit(
    folder: str, names: tuple[str, ...], camera: str, line: str, words: str, tmp_path: Path,
    asked: list[Any], capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    root = write_subject(tmp_path / folder, names, camera)
    capsys.readouterr()
    assert main(["train", str(root), "--split", "gaussian-avatars", *line.split()]) == 2
    (told,) = filter(str.strip, capsys.readouterr().err.splitlines())
    assert words in told
    assert not asked


def test_other_commands_and_splits_say_where_it_belongs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = write_subject(tmp_path / "306", FOLDERS[:2])
    capsys.readouterr()
    for line, words in (
        (["create", str(root), "--out", str(tmp_path / "new"), "--split", "gaussian-avatars"], "needs ten sequences"),
        (["train", str(root), "--subject", "306"], "--subject 306: is for --split gaussian-avatars"),
    ):
        assert main(line) == 2
        (told,) = filter(str.strip, capsys.readouterr().err.splitlines())
        assert words in told


def test_doubled_holding_out_is_told_before_training(
    tmp_path: Path, asked: list[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    root = write_subject(tmp_path / "w", FOLDERS[:3])
    assert main(["train", str(root), "--hold-out", FOLDERS[0]]) == 0
    assert "warning: --split blocks holds out a fifth of each other sequence as well" in capsys.readouterr().err
    assert main(["train", str(root), "--hold-out", FOLDERS[0], "--split", "none"]) == 0
    assert "warning" not in capsys.readouterr().err


def test_free_drives_the_avatars_of_others(tmp_path: Path) -> None:
    root = write_subject(tmp_path / "304", FOLDERS[8:])
    assert [folder.name for folder in _driver_folders([root], driving_sequences)] == ["FREE"]
    assert len(_driver_folders([root], list)) == 4
    other = write_subject(tmp_path / "253", FOLDERS[:2])
    with pytest.raises(UserError, match="has no sequence FREE, which drives avatars under --split gaussian-avatars"):
        _driver_folders([other], driving_sequences)
    assert _driver_folders([other / "sequences" / FOLDERS[0]], driving_sequences) == [other / "sequences" / FOLDERS[0]]
