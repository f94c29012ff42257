"""Settings and constants have a sentence, numbers a range outside of which they are refused; constants are used."""

import ast
import math
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import pytest

import mien
import train_toy
from mien import _native
from mien.avatar import (
    METHODS,
    FaceTuning,
    GradientSettings,
    HeadGasConfig,
    Progress,
    Rate,
    RefillSettings,
)
from mien.capture.constants import CAPTURE
from mien.commands.help_text import field_docs
from mien.driving.constants import DRIVING
from mien.errors import UserError
from mien.face.constants import FACE
from mien.ranges import FRACTION, NotBelow, Range, check_ranges
from mien.tracking.constants import TRACKING
from mien.training import PRESETS, TrainSettings, train
from plain_settings import plain_gaussian_avatars
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


@pytest.mark.parametrize("settings", [*EVERYTHING, FaceTuning(), Rate(1.0)], ids=lambda one: type(one).__name__)
def test_every_field_has_a_sentence(settings: Any) -> None:
    docs = field_docs(type(settings))
    for field in fields(settings):
        about = docs[field.name]
        assert about[0].isupper(), field.name
        assert about.endswith("."), field.name
        assert not about.startswith("Of "), field.name
        if is_dataclass(getattr(settings, field.name)):
            test_every_field_has_a_sentence(getattr(settings, field.name))


def constants(name: str, room: Any) -> Iterator[tuple[str, str, bool]]:
    """Yield each constant's name, its name behind the local name `known`, and whether its class documents it."""
    docs = field_docs(type(room))
    for field in fields(room):
        value = getattr(room, field.name)
        if is_dataclass(value):
            yield from constants(f"{name}.{field.name}", value)
        else:
            yield f"{name}.{field.name}", f"known.{field.name}", bool(docs.get(field.name))


def dotted(node: ast.AST) -> str:
    """Return `A.b.c` of an expression that is a chain of names, and nothing of another one."""
    if isinstance(node, ast.Attribute):
        before = dotted(node.value)
        return f"{before}.{node.attr}" if before else ""
    return node.id if isinstance(node, ast.Name) else ""


def test_every_constant_says_what_it_is_and_is_used() -> None:
    rooms = {"CAPTURE": CAPTURE, "DRIVING": DRIVING, "FACE": FACE, "TRACKING": TRACKING}
    texts = [path.read_text(encoding="utf-8") for path in Path(str(mien.__file__)).parent.rglob("*.py")]
    trees = [ast.parse(text) for text in texts if any(f"{name}." in text for name in (*rooms, "known"))]
    used = {dotted(node) for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    for room, values in rooms.items():
        for name, local, documented in constants(room, values):
            assert documented, name
            assert {name, local} & used, f"nothing uses {name}"


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


def test_what_is_in_range_passes() -> None:
    for settings in (*CONFIGS, *(preset.settings for preset in PRESETS.values())):
        settings.check()
    for name, method in METHODS.items():
        for preset in method.presets:
            PRESETS[preset].config(name).check()
            PRESETS[preset].settings_of(name).check()
    plain_gaussian_avatars(density=GradientSettings(start=0.5, stop=0.5, opacity_resets=())).check()
    TrainSettings(resolution=16).check()


def test_ranges_in_words() -> None:
    """Messages say the allowed range in words."""

    @dataclass(frozen=True)
    class Some:
        sizes: Annotated[tuple[int, ...], Range(16, 64, filled=True)] = (16,)
        first: Annotated[float, FRACTION] = 0.0
        last: Annotated[float, FRACTION, NotBelow("first")] = 1.0

    for some, words in (
        (Some(sizes=()), "--sizes (nothing): give numbers from 16 to 64"),
        (Some(sizes=(16, 70)), "--sizes 16 70: give numbers from 16 to 64"),
        (Some(first=1.5), "--first 1.5: give a number from 0 to 1"),
        (Some(first=0.5, last=0.25), "--last 0.25: give at least as much as --first 0.5"),
    ):
        with pytest.raises(UserError) as told:
            check_ranges(some, lambda name: f"--{name}")
        assert str(told.value) == words


def test_training_refuses_settings_out_of_range(tmp_path: Path) -> None:
    face_model, sequence = toy_sequence(timesteps=5, size=32)
    with pytest.raises(UserError, match="--training.record-every 0"):
        train([sequence], face_model, train_toy.CONFIG, TrainSettings(record_every=0), tmp_path / "run")
    config = replace(train_toy.CONFIG, sh_degree=4)
    with pytest.raises(UserError, match="--method.sh-degree 4"):
        train([sequence], face_model, config, train_toy.SETTINGS, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_settings_that_make_training_diverge_are_told(tmp_path: Path) -> None:
    face_model, sequence = toy_sequence(timesteps=5, size=32)
    config = replace(HeadGasConfig(points=50), log_scales_rate=Rate(100.0))
    with pytest.raises(UserError, match=r"training diverged by step \d+ \(.*\); lower the learning rates"):
        train([sequence], face_model, config, train_toy.SETTINGS, tmp_path / "run")
    assert not (tmp_path / "run" / "avatar").exists()


def test_a_rate_that_starts_at_nothing_stays_there() -> None:
    assert Rate(0.0, 1e-3).at(Progress(5, 10)) == 0
    assert Rate(1e-2, 1e-4).at(Progress(5, 10)) == pytest.approx(1e-3)


def test_threads_of_a_run_are_those_it_asks_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before, seen = _native.thread_count(), []
    face_model, sequence = toy_sequence(timesteps=5, size=32)
    settings = replace(train_toy.SETTINGS, steps=1, threads=before + 1)
    monkeypatch.setattr("mien.training.trainer.step", lambda state, *_: _end(state, seen))
    monkeypatch.setattr("mien.training.trainer.write_results", lambda *_: None)
    train([sequence], face_model, train_toy.CONFIG, settings, tmp_path)
    assert seen == [before + 1]
    assert _native.thread_count() == before


def _end(state: Any, seen: list[int]) -> str:
    seen.append(_native.thread_count())
    state.step += 1
    return ""
