"""Settings of methods and runs come from options and files in a known order, and wrong ones are refused before work."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mien.avatar import GaussianAvatarsConfig
from mien.avatar.headgas.settings import HeadGasConfig
from mien.avatar.methods import METHODS
from mien.avatar.mono_gaussian_avatar.settings import PRESETS as mono_gaussian_avatar_presets
from mien.avatar.settings import FaceTuning, GradientSettings, MethodConfig, Rate
from mien.cli import main
from mien.pipeline import train as training
from mien.training import PRESETS, TrainSettings
from refusals import complaint
from shared_things import toy_workspace
from test_training_batch import RESULTS
from toy_scene import toy_face_model

RUN, STANDARD = TrainSettings(), GaussianAvatarsConfig()
OPEN = TrainSettings(
    background="white", edges="filmed", inside="free", light="steady", mesh="tracked", unseen="trained"
)
"""Settings of a run by the preset `paper`."""

Choices = tuple[MethodConfig, TrainSettings]


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    """Return a workspace with a tracked sequence, which `mien train` checks before any work."""
    for name in ("capture/capture.json", "tracking/tracking.json"):
        path = tmp_path / "w" / "sequences" / "clip" / name
        path.parent.mkdir(parents=True)
        path.touch()
    return tmp_path / "w"


@pytest.fixture
def choices(workspace: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a function that gives the settings that `mien train` uses with some options."""
    asked: list[Choices] = []
    monkeypatch.setattr(training, "run_training_stage", lambda *given, **_: asked.append((given[3], given[4])))

    def choose(line: str, file: object = None) -> Choices:
        words = ["train", str(workspace)] if file is None else with_file(workspace, json.dumps(file))
        assert main([*words, *line.split()]) == 0
        return asked.pop()

    return choose


def with_file(workspace: Path, content: str) -> list[str]:
    """Return the words of a training with a file of settings that has this content."""
    path = workspace / "file.json"
    path.write_text(content)
    return ["train", str(workspace), "--config", str(path)]


@pytest.mark.parametrize("method", METHODS)
def test_without_options_a_run_has_the_defaults(method: str, choices: Any) -> None:
    config = METHODS[method].config()
    for line, expected in (
        ("", (config, RUN)),
        ("--preset standard", (config, RUN)),
        ("--preset draft", (PRESETS["draft"].config(method), replace(RUN, steps=4000))),
        ("--preset fine", (config, replace(RUN, steps=12_000))),
    ):
        assert choices(f"--method {method} {line}") == expected


def test_a_preset_that_the_method_does_not_have_is_refused(workspace, capsys, monkeypatch) -> None:
    """Every method here has `paper`; a new one may not."""
    name = "mono_gaussian_avatar"
    monkeypatch.delitem(mono_gaussian_avatar_presets, "paper")
    words = f"--preset paper: {name} has no such preset; it has draft and standard"
    for command in (["train", str(workspace)], ["create", str(workspace), "--out", str(workspace / "new")]):
        assert words in complaint(capsys, *command, "--method", name, "--preset", "paper")
    line = with_file(workspace, json.dumps({"method": {"kind": name}}))
    assert words in complaint(capsys, *line, "--preset", "paper")


def test_options_reach_every_depth_and_win_over_the_file_and_the_file_over_the_preset(choices: Any) -> None:
    line = """--method.sh-degree 2 --method.sh-frame head --method.density.max-gaussians=20000 --training.resolution 256
        --method.means-rate.start 4e-3 --method.means-rate.end 4e-5 --method.photometric.alpha_weight 0.1 --steps 70
        --method.density.opacity-resets 0.2 0.5 --training.record-every 7 --method.face-tuning.begin 0.5
            --method.face-tuning.head-translation 4e-4"""
    config = replace(
        STANDARD, sh_degree=2, sh_frame="head", means_rate=Rate(4e-3, 4e-5),
        photometric=replace(STANDARD.photometric, alpha_weight=0.1),
        density=GradientSettings(grow_gradient=1e-4, max_gaussians=20_000, opacity_resets=(0.2, 0.5)),
        face_tuning=FaceTuning(head_translation=4e-4, begin=0.5, keep_mean_pose=True, keep_turns=True),
    )  # fmt: skip
    assert choices(line) == (config, replace(RUN, steps=70, resolution=256, record_every=7))
    config, _ = choices("--method headgas --method.features 8 --method.density.rounds 3")
    assert config == HeadGasConfig(features=8, density=replace(HeadGasConfig().density, rounds=3))
    file = {
        "method": {"kind": "headgas", "features": 32, "density": {"rounds": 5}},
        "settings": {"steps": 2000, "seed": 3, "held_out_sequences": ["smile"], "record_every": 7},
    }
    config = HeadGasConfig(features=32, density=replace(HeadGasConfig().density, rounds=5))
    run = replace(RUN, steps=2000, seed=3, record_every=7)
    paper: Any = PRESETS["paper"].config("gaussian_avatars")
    other = {"method": {"sh_degree": 2}, "settings": {"steps": 700, "seed": 4}}
    for line, given, expected in (
        ("--preset paper", None, (paper, replace(OPEN, steps=600_000))),
        ("--preset paper --steps 30", other, (replace(paper, sh_degree=2), replace(OPEN, steps=30, seed=4))),
        ("--preset paper --method.sh-degree 1", other, (replace(paper, sh_degree=1), replace(OPEN, steps=700, seed=4))),
        ("--hold-out", file, (config, run)),
        ("--hold-out --method.features 8 --steps 50 --preset draft --seed 0", file,
         (replace(config, features=8), replace(run, steps=50, seed=0))),
        ("--method headgas", {"settings": {"seed": 1}}, (HeadGasConfig(), replace(RUN, seed=1))),
        ("", {}, choices("")),
    ):  # fmt: skip
        assert choices(line, given) == expected
    assert choices("--preset draft", {"settings": {"split": "tail"}})[1] == replace(RUN, steps=4000, split="tail")


def test_face_tuning_is_turned_off_and_on(choices: Any) -> None:
    off = FaceTuning(enabled=False, keep_mean_pose=True, keep_turns=True)
    assert choices("--method.face-tuning.enabled False")[0] == replace(STANDARD, face_tuning=off)
    file = {"method": {"face_tuning": {"enabled": False}}}
    assert choices("", file)[0] == replace(STANDARD, face_tuning=off)
    assert choices("--method.face-tuning.enabled True", file)[0] == STANDARD


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("--method.sh-degre 2", "--method.sh-degre, 2; Perhaps you meant: --method.sh-degree"),
        ("--method.max-gaussians 2", "Perhaps you meant: --method.density.max-gaussians"),
        ("--method headgas --method.sh-frame head", "Unrecognized options: --method.sh-frame"),
        ("--training.steps 3", "Unrecognized options: --training.steps"),
        ("--method.sh-degree 1.5", "--method.sh-degree"),
        ("--method.sh-frame upside-down", "world"),
        ("--method.density.start 0.8", "--method.density.stop 0.7: give at least as much as --method.density.start"),
        ("--method.density.opacity-resets 0.4 0.1", "opacity-resets 0.4 0.1: give numbers from 0 to 1, ascending"),
        ("--seed 99999999999999999999", "--seed 99999999999999999999: give a number from -9223372036854775808"),
    ],
)  # fmt: skip
def test_options_that_make_no_sense_are_refused_before_any_work(line: str, words: str, workspace, capsys) -> None:
    new = workspace / "new"
    for command in (["train", str(workspace)], ["create", str(workspace), "--out", str(new)]):
        assert words in complaint(capsys, *command, *line.split())
    assert not (workspace / "runs").exists()
    assert not new.exists()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "cannot be read as json"),
        ('{"method": {"sh_degree": NaN}}', "it holds the number NaN"),
        ('{"method": {"sh_degree": 1, "sh_degree": 2}}', "it holds 'sh_degree' twice"),
        ('{"format": "mien.capture"}', "has format 'mien.capture' version 1; give a run's config.json"),
        ('{"methods": {}}', "methods: a file of settings has no such setting; did you mean method?"),
        ('{"method": {"kind": "nerf"}}', "method.kind nerf: give the name of a method: gaussian_avatars"),
        ('{"method": 3}', "method is not an object of settings"),
        ('{"settings": {"stepps": 3}}', "settings.stepps: a run has no such setting; did you mean steps? there are"),
        ('{"settings": {"steps": "many"}}', "settings.steps 'many': give a whole number"),
        ('{"settings": {"split": "half"}}', "settings.split 'half': give one of blocks, tail, none"),
        ('{"settings": {"held_out_sequences": "a"}}', "settings.held_out_sequences 'a': give a list, each entry a"),
        ('{"method": {"density": {"round": 3}}}', "method.density.round: gaussian_avatars has no such setting; did"),
        ('{"method": {"density": 3}}', "method.density 3: give an object of settings"),
        ('{"method": {"density": {"kind": "RefillSettings"}}}', "method.density.kind 'RefillSettings'"),
        (f'{{"settings": {{"steps": 1{"0" * 4000}}}}}', "settings.steps 1000"),
        ("[" * 100_000, "cannot be read as json"),
        ('{"' + "x" * 3000 + '": 1}', "xxx...: a file of settings has no such setting"),
        ('{"settings": {"held_out_sequences": ["nobody"]}}', "--hold-out nobody: no such sequence"),
        ('{"method": {"face_tuning": {"enabled": 1}}}', "method.face_tuning.enabled 1: give true or false"),
    ],
)  # fmt: skip
def test_files_that_make_no_sense_are_refused_before_any_work(content: str, words: str, workspace, capsys) -> None:
    line = complaint(capsys, *with_file(workspace, content))
    assert words in line
    assert len(line) < 1000
    assert not (workspace / "runs").exists()


def test_paths_that_are_no_file_and_files_of_another_method_are_refused(workspace: Path, capsys) -> None:
    runs = workspace / "runs"
    runs.mkdir()
    for path, words in (
        (workspace / "gone.json", "gone.json: no such file"), (runs, "is a folder; give a json file, such as DIR/"),
        ("/dev/null", "is not an ordinary file"), ("", "--config= is empty"),
    ):  # fmt: skip
        assert words in complaint(capsys, "train", str(workspace), f"--config={path}")
    words = [*with_file(workspace, '{"method": {"kind": "headgas"}}'), "--method", "gaussian_avatars"]
    assert "has settings of headgas, but --method asks for gaussian_avatars" in complaint(capsys, *words)


def test_a_run_is_repeated_from_its_config_to_the_same_bytes(made_once, tmp_path, monkeypatch, capsys) -> None:
    shutil.copytree(toy_workspace(made_once), tmp_path, dirs_exist_ok=True)
    monkeypatch.setattr(training, "load_face_model", lambda name: toy_face_model())
    toy, again = (tmp_path / "runs" / name for name in ("toy", "again"))
    words = ["train", str(tmp_path), "--config"]
    assert main([*words, str(toy / "config.json"), "--run", "again"]) == 0
    told = capsys.readouterr().err
    assert "config.json: method and settings are taken from it, not its sequences (clip)" in told
    for name in RESULTS:
        assert (again / name).read_bytes() == (toy / name).read_bytes(), name
    first, second = (json.loads((run / "config.json").read_text()) for run in (toy, again))
    assert all(first[part] == second[part] for part in ("method", "settings", "data"))
    # This file is edited, so its checksum is wrong. A run still reads its own config.json strictly.
    (again / "config.json").write_text(json.dumps({**first, "settings": {**first["settings"], "steps": 4}}))
    assert main([*words, str(again / "config.json"), "--run", "shorter"]) == 0
    assert json.loads((tmp_path / "runs/shorter/training.json").read_text())["steps"] == 4
    capsys.readouterr()
    assert "damaged or edited" in complaint(capsys, "evaluate", str(tmp_path), "--run", "again")
