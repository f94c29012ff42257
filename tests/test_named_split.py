"""The splits of GaussianAvatars (tables 1 and 2 of its supplement) and of the NeRSemble benchmark, by name."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from capture_helpers import random_capture
from known import known
from mien.capture import write_capture
from mien.cli import main
from mien.errors import UserError
from mien.pipeline import train as training_stage
from mien.pipeline.evaluate import driver_folders
from mien.tracking import write_tracking
from mien.training import PRESETS, TrainSettings
from mien.training.footage.frames import training_frames
from mien.training.settings import doubly_held_out
from mien.training.settings.splits import SEQUENCES, SPLITS, Recorded, Recordings, driving_sequences, fill_in
from refusals import complaint, refuses
from toy_scene import toy_face_model, toy_sequence, toy_tracking

FOLDERS = (
    "EMO-1-shout+laugh", "EMO-2-surprise+fear", "EMO-3-angry+sad", "EMO-4-disgust+happy", "EXP-2-eyes",
    "EXP-3-cheeks+nose", "EXP-4-lips", "EXP-5-mouth", "EXP-8-jaw-1", "EXP-9-jaw-2", "FREE", "SEN-01-cramp_small_danger",
)  # fmt: skip
"""Names of NeRSemble's folders."""
NAMED, BENCHMARK = TrainSettings(split="gaussian-avatars"), TrainSettings(split="nersemble-benchmark")
OWN = TrainSettings(split="dataset")
FRONTAL = "222200037"
RECORDED = ("EMO-1-shout+laugh", "EXP-2-eyes", "FREE", "SEN-01-cramp_small_danger", "SEN-10-port_strong_smokey")
TESTS = (RECORDED[0], "FREE", RECORDED[4])
SUBJECTS = {
    "074": "EMO-4", "104": "EXP-2", "218": "EXP-9", "253": "EMO-4", "264": "EXP-9", "302": "EMO-2", "304": "EXP-2",
    "306": "EXP-2", "460": "EMO-3",
}  # fmt: skip
"""Subjects of table 2, with the sequence that is held out of each."""


def given(names: Any, folder: str = "306", subject: str | None = None, cameras: Any = None) -> Recordings:
    """Return sequences whose captures have these cameras, or were not read."""
    ids: dict[str, Any] = cameras if isinstance(cameras, dict) else dict.fromkeys(names, cameras)
    return Recordings({name: None if ids[name] is None else Recorded(ids[name], 10) for name in names}, folder, subject)


@pytest.mark.parametrize("subject", SUBJECTS)
def test_table_2(subject: str) -> None:
    rule = SPLITS["gaussian-avatars"]
    for names in (FOLDERS, (*SEQUENCES, "FREE"), tuple(f"{subject}_{name}" for name in FOLDERS)):
        sequences = given(names, f"nersemble_{subject}")
        used = rule.used(sequences)
        assert len(used) == 10
        left_out = [name for name in names if name not in used]
        assert driving_sequences(left_out) == [name for name in names if "FREE" in name]
        (held,) = fill_in(NAMED, sequences).held_out_sequences
        assert SUBJECTS[subject] in held
    for number in (subject, subject.lstrip("0")):
        (held,) = fill_in(NAMED, given(FOLDERS, "104", number)).held_out_sequences
        assert SUBJECTS[subject] in held, "a given subject wins over the folder"


def test_what_the_names_do_not_say_and_what_is_withheld_twice_is_told() -> None:
    for names, folder, subject, words in (
        (FOLDERS, "me", None, "'me' does not say which subject it is; give --subject (the subjects are 074"),
        (FOLDERS, "104_306", None, "does not say which subject"),
        (FOLDERS, "306", "307", "--subject 307: is not a subject of --split gaussian-avatars; the subjects are 074"),
        (FOLDERS[1:], "306", None, "EMO-1 of subject 306 is missing; capture it with --name EMO-1 and track again"),
        (("FREE",), "306", None, "EMO-1, EMO-2, EMO-3, EMO-4, EXP-2, EXP-3, EXP-4, EXP-5, EXP-8, EXP-9 of subject"),
        ((*FOLDERS, "EXP-2"), "306", None, "EXP-2-eyes and EXP-2 are both EXP-2; name one of them with --sequences"),
    ):  # fmt: skip
        with pytest.raises(UserError) as told:
            fill_in(NAMED, given(names, folder, subject))
        assert words in str(told.value)
        assert "\n" not in str(told.value)
    held = TrainSettings(held_out_sequences=("FREE",))
    assert "--split blocks holds out a fifth of each other sequence" in known(doubly_held_out(held))
    assert doubly_held_out(TrainSettings()) is doubly_held_out(replace(held, split="none")) is None


def test_either_name_of_the_camera_is_held_out() -> None:
    ids: dict[str, tuple[str, ...]] = {name: ("07", "08", "09") for name in SEQUENCES}
    assert fill_in(NAMED, given(SEQUENCES, cameras=ids)).held_out_cameras == ("08",)
    ids["EXP-4"] = ("222200036", "222200037")
    settings = fill_in(NAMED, given(SEQUENCES, cameras=ids))
    assert settings.held_out_cameras == ("08", "222200037")
    assert fill_in(settings, given(SEQUENCES, cameras=ids)) == settings, "the config of a run can be repeated"
    for settings, words in (
        (replace(NAMED, held_out_sequences=("EMO-1",)), "--hold-out EMO-1: --split gaussian-avatars decides"),
        (replace(NAMED, held_out_cameras=("03",)), "--hold-out-cameras 03: --split gaussian-avatars decides"),
    ):
        refuses(words, fill_in, settings, given(SEQUENCES, cameras=ids))
    ids["EXP-4"] = ("front",)
    words = r"EXP-4 has no camera 08 or 222200037, which it holds out \(there are front\)"
    refuses(words, fill_in, NAMED, given(SEQUENCES, cameras=ids))
    refuses("the sequence EMO-1 has no split of its dataset", fill_in, OWN, given(["EMO-1"], cameras=("08",)))
    refuses("is not filled in", training_frames, [toy_sequence(6, 16)[1]], NAMED)


def test_the_benchmark_holds_out_test_sequences_and_cameras() -> None:
    short = ("306_EMO-1", "306_EMO-10", "EXP-2", "FREEZE", "SEN-9", "sen")
    for names, cameras, held, hidden in (
        (RECORDED, (FRONTAL, "222200046", "222200036"), TESTS, ("222200046", "222200036")),
        (short, (FRONTAL,), ("306_EMO-1", "SEN-9"), ()),
        # The task of novel views holds out the hidden cameras.
        (("HAIR",), ("222200036", FRONTAL, "222200039"), (), (FRONTAL, "222200039")),
    ):
        filled = fill_in(BENCHMARK, given(names, cameras=cameras))
        assert (filled.held_out_sequences, filled.held_out_cameras) == (held, hidden)
        assert fill_in(filled, given(names, cameras=cameras)) == filled, "the config of a run can be repeated"
    # What it cannot hold out is told.
    for names, cameras, settings, words in (
        (["FREE"], (FRONTAL,), BENCHMARK, "holds out all of FREE, and nothing is left"),
        (["FREE", "HAIR"], ("222200046",), BENCHMARK, f"trains on camera {FRONTAL}, and there are 222200046"),
        (["HAIR"], (FRONTAL, "222200046"), BENCHMARK, "trains on a camera besides"),
        (["HAIR", "EXP-1-head"], ("222200036",), BENCHMARK, "publishes none; train with --split none, and write the"),
        (["FREE", "HAIR"], (FRONTAL,), replace(BENCHMARK, held_out_sequences=("HAIR",)), "--hold-out HAIR: --split"),
        (["FREE", "HAIR"], (FRONTAL,), replace(BENCHMARK, held_out_cameras=("x",)), "--hold-out-cameras x: --split"),
    ):
        with pytest.raises(UserError) as told:
            fill_in(settings, given(names, cameras=cameras))
        assert words in str(told.value)
        assert "\n" not in str(told.value)


first = pytest.fixture(scope="module")(lambda tmp_path_factory: _write_sequence(tmp_path_factory.mktemp("first"), "08"))


def _write_sequence(folder: Path, camera: str) -> Path:
    tracking = toy_tracking(toy_face_model(), 2, 16)
    cameras = tracking.cameras * 2
    capture = replace(random_capture(2, 2, 16, 16), camera_ids=(camera, "09"), calibration=cameras)
    write_capture(folder / "capture", capture)
    lines, residuals = tracking.neck_lines.repeat(1, 2, 1), tracking.residuals.repeat(1, 2)
    write_tracking(folder / "tracking", replace(tracking, cameras=cameras, neck_lines=lines, residuals=residuals))
    return folder


def subject(first: Path, root: Path, names: tuple[str, ...] = FOLDERS) -> Path:
    """Return a workspace with copies of the sequence under these names."""
    for name in names:
        shutil.copytree(first, root / "sequences" / name, copy_function=os.link)
    return root


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[list[str], TrainSettings]]:
    """Return the sequences and settings of trainings, which are left out."""
    found: list[tuple[list[str], TrainSettings]] = []
    monkeypatch.setattr(training_stage, "run_training_stage", lambda *given: found.append((given[1], given[4])))
    return found


@pytest.mark.unchecked
def test_train_takes_the_split_by_name(first: Path, tmp_path: Path, asked: list[Any], capsys) -> None:
    root = subject(first, tmp_path / "306")
    assert main(["train", str(root), "--split", "gaussian-avatars"]) == 0
    names, settings = asked.pop()
    assert names == [*FOLDERS[:10]]
    held = {"held_out_sequences": ("EXP-2-eyes",), "held_out_cameras": ("08",)}
    assert settings == replace(PRESETS["standard"].settings, split="gaussian-avatars", **held)
    shown = capsys.readouterr().err
    assert "held out are the sequence EXP-2-eyes and the camera 08; not used: FREE, SEN-01" in shown
    assert "warning" not in shown
    config = tmp_path / "again.json"
    config.write_text(json.dumps({"settings": {"split": settings.split, "held_out_cameras": ["08"]}}))
    assert main(["train", str(root), "--config", str(config)]) == 0
    assert asked.pop() == (names, settings)
    root = subject(_write_sequence(tmp_path / "first", FRONTAL), tmp_path / "393", RECORDED)
    assert main(["train", str(root), "--split", "nersemble-benchmark"]) == 0
    names, settings = asked.pop()
    assert tuple(names) == RECORDED
    assert (settings.held_out_sequences, settings.held_out_cameras) == (TESTS, ("09",))
    assert f"held out are the sequences {', '.join(TESTS)} and the camera 09" in capsys.readouterr().err


@pytest.mark.unchecked
def test_train_refuses_what_does_not_fit(first: Path, tmp_path: Path, asked: list[Any], capsys) -> None:
    subject(first, tmp_path / "306")
    subject(first, tmp_path / "me")
    create, named = ("create", str(tmp_path / "a.mp4"), "--out", str(tmp_path / "new")), "--split gaussian-avatars"
    for line, words in (
        (("train", str(tmp_path / "me"), *named.split()), "does not say which subject"),
        (("train", str(tmp_path / "306"), *named.split(), "--hold-out", "FREE"), f"--hold-out FREE: {named} decides"),
        (("train", str(tmp_path / "306"), "--subject", "306"), f"--subject 306: is for {named}"),
        ((*create, *named.split()), "needs ten sequences"),
        ((*create, "--split", "nersemble-benchmark"), "needs several sequences"),
    ):
        assert words in complaint(capsys, *line)
    assert not asked


@pytest.mark.unchecked
def test_free_drives_the_avatars_of_others(first: Path, tmp_path: Path) -> None:
    root = subject(first, tmp_path / "304", FOLDERS[8:])
    assert [folder.name for folder in driver_folders([root], driving_sequences)] == ["FREE"]
    assert len(driver_folders([root], list)) == 4
    other = subject(first, tmp_path / "253", FOLDERS[:2])
    with pytest.raises(UserError, match="has no sequence FREE, which drives avatars under --split gaussian-avatars"):
        driver_folders([other], driving_sequences)
    assert driver_folders([other / "sequences" / FOLDERS[0]], driving_sequences) == [other / "sequences" / FOLDERS[0]]
