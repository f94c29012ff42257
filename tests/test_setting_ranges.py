"""Settings and constants have a sentence and a range; the help tells them, and presets hold only what they may."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import pytest

import train_toy
from mien import _native
from mien.avatar import METHODS, HeadGasConfig, Rate, RefillSettings
from mien.commands.settings_options import leaves
from mien.errors import UserError
from mien.ranges import FRACTION, NotBelow, Range, check_ranges
from mien.training import MAIN_SETTINGS, PRESETS, TrainSettings, train, trainer
from refusals import refuses
from test_settings import help_of, with_file
from toy_scene import toy_sequence

CONFIGS: list[Any] = [method.config() for method in METHODS.values()]
EVERYTHING: list[Any] = [*CONFIGS, TrainSettings(), RefillSettings((0.1, 0.2), (10, 20))]


def numbers(settings: Any, path: str = "") -> Iterator[tuple[str, Any, Any, Any]]:
    """Yield dotted name, owner, hint and value of every field that holds numbers."""
    hints = get_type_hints(type(settings), include_extras=True)
    for field in fields(settings):
        value, hint = getattr(settings, field.name), hints[field.name]
        if is_dataclass(value):
            yield from numbers(value, f"{path}{field.name}.")
        elif {int, float} & ({hint} | set(get_args(hint)) | {a for arg in get_args(hint) for a in get_args(arg)}):
            yield path + field.name, settings, hint, value


def changed(settings: Any, path: str, value: Any) -> Any:
    """Return settings with another value of a dotted name."""
    name, _, rest = path.partition(".")
    return replace(settings, **{name: changed(getattr(settings, name), rest, value) if rest else value})


@pytest.mark.unchecked
@pytest.mark.parametrize("settings", EVERYTHING, ids=lambda settings: type(settings).__name__)
def test_every_number_has_a_range_that_is_checked(settings: Any) -> None:
    names = [name for name, *_ in numbers(settings)]
    assert len(names) >= 3
    for name, owner, hint, value in numbers(settings):
        marks = get_args(hint)[1:] if get_origin(hint) is Annotated else ()
        (allowed,) = [mark for mark in marks if isinstance(mark, Range)]
        assert allowed.holds(value), name
        whole = isinstance(allowed.least, int) and (isinstance(value, int) or "int" in str(hint))
        wrong = [math.nan, math.inf, -math.inf] if not whole else []
        wrong += [allowed.most + 1 if whole else allowed.most * 1.001 + 1e-3, allowed.least - (1 if whole else 1e-3)]
        for bad in wrong:
            value_ = (type(value[0] if value else 0.1)(bad),) if isinstance(value, tuple) else bad
            with pytest.raises(UserError) as told:
                check_ranges(changed(settings, name, value_), lambda name: f"--{name}")
            assert f"--{name} " in str(told.value), (name, bad, type(owner))
            assert "give " in str(told.value)


@dataclass(frozen=True)
class Some:
    sizes: Annotated[tuple[int, ...], Range(16, 64, filled=True)] = (16,)
    first: Annotated[float, FRACTION] = 0.0
    last: Annotated[float, FRACTION, NotBelow("first")] = 1.0


def test_ranges_in_words() -> None:
    for some, words in (
        (Some(sizes=()), "--sizes (nothing): give numbers from 16 to 64"),
        (Some(sizes=(16, 70)), "--sizes 16 70: give numbers from 16 to 64"),
        (Some(first=1.5), "--first 1.5: give a number from 0 to 1"),
        (Some(first=0.5, last=0.25), "--last 0.25: give at least as much as --first 0.5"),
    ):
        with pytest.raises(UserError) as told:
            check_ranges(some, lambda name: f"--{name}")
        assert str(told.value) == words
    check_ranges(Some(first=0.5, last=0.5), str)


def test_training_refuses_settings_out_of_range_and_tells_of_those_that_make_it_diverge(tmp_path: Path) -> None:
    face_model, sequence = toy_sequence(timesteps=5, size=32)
    for config, settings, words in (
        (train_toy.CONFIG, TrainSettings(record_every=0), "--training.record-every 0"),
        (replace(train_toy.CONFIG, sh_degree=4), train_toy.SETTINGS, "--method.sh-degree 4"),
    ):
        refuses(words, train, [sequence], face_model, config, settings, tmp_path / "run")
    assert not (tmp_path / "run").exists()
    face_model, sequence = toy_sequence(timesteps=5, size=32)
    config = replace(HeadGasConfig(points=50), log_scales_rate=Rate(100.0))
    with pytest.raises(UserError, match=r"training diverged by step \d+ \(.*\); lower the learning rates"):
        train([sequence], face_model, config, train_toy.SETTINGS, tmp_path / "run")
    assert not (tmp_path / "run" / "avatar").exists()


def test_threads_of_a_run_are_those_it_asks_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before, seen = _native.thread_count(), []
    face_model, sequence = toy_sequence(timesteps=5, size=32)
    settings, first = replace(train_toy.SETTINGS, steps=1, threads=before + 1), trainer.step
    monkeypatch.setattr(trainer, "step", lambda *given: seen.append(_native.thread_count()) or first(*given))
    train([sequence], face_model, train_toy.CONFIG, settings, tmp_path)
    assert seen == [before + 1]
    assert _native.thread_count() == before


def about_options(help_text: str) -> dict[str, str]:
    """The help of each option, in one line."""
    about: dict[str, str] = {}
    option = ""
    for line in help_text.replace("│", " ").splitlines():
        words = line.split()
        if words and words[0].startswith("--"):
            option = words[0]
        about[option] = " ".join([about.get(option, ""), *words])
    return about


@pytest.mark.parametrize("method", METHODS)
def test_help_all_lists_every_setting_of_the_method(method: str, capsys: pytest.CaptureFixture[str]) -> None:
    text = help_of(capsys, "train", "--method", method, "--help-all")
    about, default = about_options(text), METHODS[method].config()
    assert [leaf for leaf in leaves(default, "method") if f" {leaf.heading} options " not in text] == []
    for prefix, settings in (("method", default), ("training", TrainSettings())):
        for leaf in leaves(settings, prefix):
            option = leaf.option(prefix if leaf.name not in MAIN_SETTINGS else "").replace("--.", "--")
            assert leaf.about[0].isupper(), option
            assert option in about or option in ("--held-out-sequences", "--held-out-cameras")


def test_help_all_shows_the_values_of_a_preset_and_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    about = about_options(help_of(capsys, "create", "--preset", "paper", "--help-all"))
    assert about["--method.sh-degree"].endswith("(from 0 to 3; default: 3; draft, standard, fine: 0)")
    assert about["--background"].endswith("(default: white; draft, standard, fine: auto)")
    line = with_file(tmp_path, '{"method": {"kind": "headgas", "features": 321}}')
    assert "default: 321" in about_options(help_of(capsys, *line, "--help-all"))["--method.features"]
    short = help_of(capsys, "train", "--method", "headgas", "--help")
    assert len(short.splitlines()) < 60
    assert "--method.features" not in short
    assert short.rstrip().endswith("mien train --method headgas --help-all")


@pytest.mark.parametrize("name", METHODS)
def test_presets_change_what_they_may(name: str) -> None:
    method = METHODS[name]
    assert {"draft", "standard", "fine"} <= set(method.presets) <= set(PRESETS), f"PRESETS of {name}"
    assert method.presets["standard"] == method.presets["fine"] == {}, f"{name} changes more than the steps"
    cheaper = {"photometric", "appearance"}
    assert set(method.presets["draft"].get("method", {})) <= cheaper, f"draft of {name}: more than losses and features"
    assert "settings" not in method.presets["draft"]
    for preset in method.presets:
        assert type(PRESETS[preset].config(name)) is method.config
        PRESETS[preset].config(name).check()
        PRESETS[preset].settings_of(name).check()
    assert PRESETS["standard"].settings == TrainSettings()
