"""The help tells settings and presets with their ranges, and presets hold only what they may."""

import re
from collections.abc import Iterator
from dataclasses import fields
from operator import attrgetter
from pathlib import Path
from typing import Any

import pytest

from mien.avatar import METHODS
from mien.commands.settings_options import leaves
from mien.ranges import shown
from mien.training import MAIN_SETTINGS, PRESETS, TrainSettings
from test_settings import help_of, with_file


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
    listed = leaves(METHODS[method].config(), "method")
    assert [leaf for leaf in listed if f" {leaf.option('method')} " not in text] == []
    assert [leaf.heading for leaf in listed if f" {leaf.heading} options " not in text] == []
    rest = [field.name for field in fields(TrainSettings) if field.name not in MAIN_SETTINGS]
    assert [name for name in rest if f"--training.{name.replace('_', '-')} " not in text] == []
    about = about_options(text)
    for prefix, default in (("method", METHODS[method].config()), ("training", TrainSettings())):
        of_presets = {
            name: (preset.config(method) if prefix == "method" else preset.settings_of(method))
            for name, preset in PRESETS.items()
            if name in METHODS[method].presets
        }
        for leaf in leaves(default, prefix):
            option = leaf.option(prefix if leaf.name not in MAIN_SETTINGS else "").replace("--.", "--")
            if option not in about:
                assert option in ("--held-out-sequences", "--held-out-cameras")
                continue
            known = about[option].rpartition("(")[2]
            for name, settings in of_presets.items():
                value = attrgetter(leaf.name)(settings)
                if value == leaf.value and leaf.name != "steps":
                    assert f"{name}:" not in known, (option, name)
                    assert f"{name}," not in known, (option, name)
                else:
                    text = re.escape("none" if value is None else shown(value))
                    assert re.search(rf"\b{name}(, [a-z-]+)*: {text}[;)]", known), (option, known)
    assert ("paper" in about["--background"]) == ("paper" in METHODS[method].presets)


def test_help_all_with_a_preset_shows_its_values(capsys: pytest.CaptureFixture[str]) -> None:
    about = about_options(help_of(capsys, "create", "--preset", "paper", "--help-all"))
    assert about["--method.sh-degree"].endswith("(from 0 to 3; default: 3; draft, standard, fine: 0)")
    assert about["--background"].endswith("(default: white; draft, standard, fine: auto)")


def test_help_all_shows_what_a_file_asks_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = with_file(tmp_path, '{"method": {"kind": "headgas", "features": 321}}')
    shown = help_of(capsys, *line, "--help-all")
    assert "default: 321" in " ".join(shown.split())


def test_help_stays_short_and_says_how_to_see_more(capsys: pytest.CaptureFixture[str]) -> None:
    short = help_of(capsys, "train", "--method", "headgas", "--help")
    assert len(short.splitlines()) < 60
    assert "--method.features" not in short
    assert short.rstrip().endswith("mien train --method headgas --help-all")


def differences(changes: dict[str, Any], settings: Any, place: str = "") -> Iterator[tuple[str, bool]]:
    """Yield each setting that a preset names, and whether its value differs from the default."""
    for name, value in changes.items():
        default = getattr(settings, name)
        if isinstance(value, dict):
            yield from differences(value, default, f"{place}{name}.")
        else:
            yield place + name, default != (tuple(value) if isinstance(value, list) else value)


@pytest.mark.parametrize("name", METHODS)
def test_presets_are_differences_to_the_defaults(name: str) -> None:
    method = METHODS[name]
    assert {"draft", "standard", "fine"} <= set(method.presets) <= set(PRESETS), f"PRESETS of {name}"
    assert method.presets["standard"] == method.presets["fine"] == {}, f"{name} changes more than the steps"
    cheaper = {"photometric", "appearance"}
    assert set(method.presets["draft"].get("method", {})) <= cheaper, f"draft of {name}: more than losses and features"
    assert "settings" not in method.presets["draft"]
    for preset, changes in method.presets.items():
        assert type(PRESETS[preset].config(name)) is method.config
        for part, default in (("method", method.config()), ("settings", PRESETS[preset].settings)):
            for setting, differs in differences(changes.get(part, {}), default):
                assert differs, f"{preset} of {name} repeats the default of {setting}"
    for preset in PRESETS.values():
        assert all(differs for _, differs in differences(dict(preset.changes), TrainSettings()))
    assert PRESETS["standard"].settings == TrainSettings()
