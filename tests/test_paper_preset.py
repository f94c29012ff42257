"""Settings have a sentence and a range; the preset `paper` has the numbers of the papers everywhere."""

import math
import re
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cache
from operator import attrgetter
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import pytest
import torch

import train_toy
from mien.avatar.gaussian_avatars.avatar import GaussianAvatars
from mien.avatar.headgas.settings import HeadGasConfig
from mien.avatar.methods import METHODS
from mien.avatar.mono_gaussian_avatar.settings import LENGTH_UNIT
from mien.avatar.settings import Progress, Rate, RefillSettings
from mien.camera import Camera
from mien.commands.parsing import field_docs
from mien.disk.config import FRACTION, NotBelow, Range, check_ranges
from mien.errors import UserError
from mien.training import PRESETS, TrainSettings, train
from mien.training.adam import Adam
from mien.training.density_control.gradient import round_steps
from mien.training.footage.frames import LEAST_EXTENT, Frame, camera_extent
from mien.training.settings import MAIN_SETTINGS
from plain_settings import plain_gaussian_avatars
from refusals import refuses
from test_cli import help_of
from test_settings import with_file
from toy_scene import toy_face, toy_face_model, toy_sequence

HERE = Path(__file__).parent
PAGE = (HERE.parent / "docs" / "paper_preset.md").read_text(encoding="utf-8")
TABLE: dict[str, Any] = tomllib.loads((HERE / "paper_preset.toml").read_text(encoding="utf-8"))
PAPER: Any = PRESETS["paper"].config("gaussian_avatars")
STEPS = 600_000


def plain(text: str) -> str:
    """A text in one line, with each number written in one way."""
    text = re.sub(r"\bTrue\b", "yes", re.sub(r"\bFalse\b", "no", " ".join(text.split())))
    return re.sub(r"[\d.,]*\d(?:e-?\d+)?", lambda found: f"{float(found[0].replace(',', '')):.6g}", text)


def rows_of(section: str) -> dict[str, tuple[str, str, str]]:
    """The columns "paper", "here" and "why different" of a method, by the names in the first column."""
    (own,) = [text for text in re.split(r"^## ", PAGE, flags=re.MULTILINE) if text.startswith(f"{section}\n")]
    lines = own[own.index("| setting | paper | here | why different |") :].split("\n\n")[0].splitlines()[2:]
    cells = [[cell.strip() for cell in line.removeprefix("|").removesuffix("|").split(" | ")] for line in lines]
    return {name.replace("`", ""): (paper, here, why) for name, paper, here, why in cells}


def shown(value: Any) -> Any:
    """Settings for braces. A rate is its start, and its end if it has one."""
    if isinstance(value, Rate):
        return f"{value.start}" + ("" if value.end is None else f" to {value.end}")
    if is_dataclass(value):
        return SimpleNamespace(**{each.name: shown(getattr(value, each.name)) for each in fields(value)})
    return value


def rounds(config: Any, steps: int) -> list[int]:
    return sorted(round_steps(config.density.start, config.density.stop, config.density.rounds, steps))


def resets(config: Any, steps: int) -> list[int]:
    return [round(time * steps) for time in config.density.opacity_resets]


def of_density(config: Any, steps: int) -> dict[str, Any]:
    """What the settings of density control mean for a run of so many steps."""
    density, at, low = config.density, rounds(config, steps), resets(config, steps)
    gaps = {after - before for before, after in zip(at, at[1:], strict=False)}
    judged = min((step for step in low if step > at[0]), default=0)
    found = {"rounds": len(at), "first_round": at[0], "last_round": at[-1], "unit": {"extent": "E"}[density.size_unit]}
    found["judged_from"] = judged if density.size_start is None else round(density.size_start * steps)
    (found["round_gap"],) = gaps
    found |= {"resets": "some", "first_reset": low[0], "last_reset": low[-1]} if low else {"resets": "none"}
    if low:
        (found["reset_gap"],) = {after - before for before, after in zip(low[1:], low[2:], strict=False)}
    return found


def of_schedule(config: Any, steps: int) -> dict[str, Any]:
    """What epochs mean for a run of so many steps, and lengths in metres and in those of the paper."""
    found = {"frames": steps // config.epochs, "paper_lengths": round(1 / LENGTH_UNIT)}
    found["all_points"] = "all points" if config.face_points >= config.max_points else config.face_points
    if hasattr(config, "late_epoch"):
        found["halvings"] = [round(config.epochs * time) for time in config.rate_halvings]
        found["points_for_all_frames"] = config.points_per_step // config.frames_per_step
    return found


@cache
def figures(method: str) -> dict[str, Any]:
    """All that braces may name: the settings of a method by the preset `paper`, and what follows from them."""
    config: Any = PRESETS["paper"].config(method)
    steps = PRESETS["paper"].settings_of(method).steps
    found = {**vars(shown(config)), "steps": steps}
    if hasattr(config, "density"):
        found |= of_density(config, steps)
        found["times_extent"] = "times E" if config.means_times_extent else ""
        found["degrees"] = [steps * config.sh_warmup * degree / (config.sh_degree + 1) for degree in (1, 2, 3)]
        found["warmup_share"] = 1 / config.sh_warmup
    if hasattr(config, "epochs"):
        found |= of_schedule(config, steps)
    if config.photometric.perceptual.weight:
        perceptual = config.photometric.perceptual
        found["perceptual_from"] = round(perceptual.start * steps)
        found["blocks"] = ("no", "one", "two", "three", "four")[perceptual.blocks]
    if method == "headgas":
        found["higher_share"] = 1 / config.sh_higher_share
    tuning = found["face_tuning"]
    found["tuning"] = "on" if tuning.enabled else "off"
    begin = f" from epoch {round(tuning.begin * getattr(config, 'epochs', 1))}" if tuning.begin else ""
    rates = {tuning.expression, tuning.joints, tuning.head_rotation}
    found["face_rates"] = ", ".join(f"{rate}{begin}" for rate in rates)
    return found


def check_section(section: str) -> None:
    """Compare the rows of the table with those of the page, and both with the code."""
    own, page = TABLE[section], rows_of(section)
    assert [row[0] for row in own["rows"]] == list(page)
    known = figures(own["method"])
    for name, published, place, here, *of_paper in own["rows"]:
        paper, found, why = page[name]
        assert paper == published, name
        assert place, f"{name}: where is this published?"
        assert plain(found) == plain(here.format(**known)), name
        for part in of_paper:
            assert plain(part.format(**known)) in plain(paper), name
        numbers = [set(re.findall(r"[\d.e-]*\d", plain(cell))) for cell in (paper, found)]
        if not why and all(numbers) and "not stated" not in paper and "code" not in paper:
            assert numbers[0] & numbers[1], f"{name}: a row that does not say why differs in nothing"
    config = PRESETS["paper"].config(own["method"])
    assert {name: attrgetter(name)(config) for name in own["also"]} == own["also"]


@pytest.mark.unchecked
@pytest.mark.parametrize("section", ["GaussianAvatars", "HeadGaS"])
def test_docs_have_all_values(section: str) -> None:
    check_section(section)


def test_docs_have_all_values_of_point_avatar() -> None:
    check_section("PointAvatar")


def values(settings: Any, place: str = "") -> dict[str, Any]:
    """All settings by their dotted names. A learning rate is one of them."""
    found = {}
    for field in fields(settings):
        value = getattr(settings, field.name)
        inside = is_dataclass(value) and not isinstance(value, Rate)
        found |= values(value, f"{place}{field.name}.") if inside else {place + field.name: value}
    return found


@pytest.mark.parametrize("section", TABLE)
def test_what_no_row_names_is_as_in_standard(section: str) -> None:
    method = TABLE[section]["method"]
    assert PRESETS["standard"].config(method) == METHODS[method].config()
    named = {name for names, (_, _, why) in rows_of(section).items() for name in names.split(", ") + why.split("`")}
    standard, paper = values(METHODS[method].config()), values(PRESETS["paper"].config(method))
    for setting in paper:
        parts = setting.split(".")
        written = {".".join(parts[:end]) for end in range(1, len(parts) + 1)} | {parts[-1]}
        assert paper[setting] == standard[setting] or written & named, setting


def test_the_run_of_every_method_has_the_settings_of_the_first_table() -> None:
    default = TrainSettings()
    table = dict(re.findall(r"^\| `([a-z]+)` \| ([a-z]+ \| [a-z]+) \|$", PAGE, flags=re.MULTILINE))
    assert table == {name: f"{getattr(default, name)} | {value}" for name, value in PRESETS["paper"].changes.items()}
    with_preset = [name for name in METHODS if "paper" in METHODS[name].presets]
    assert set(METHODS) - set(with_preset) == {"textured_mesh"}, "which repeats no paper"
    for method in with_preset:
        settings = PRESETS["paper"].settings_of(method)
        assert settings == replace(default, steps=settings.steps, **PRESETS["paper"].changes)


def test_schedule() -> None:
    assert rounds(PAPER, STEPS) == list(range(12_000, 600_000, 2_000))
    assert resets(PAPER, STEPS) == [10_000, *range(60_000, 600_000, 60_000)]
    assert rounds(PAPER, 3_000) == list(range(60, 3_000, 10)), "a shorter run has the same schedule"
    assert resets(PAPER, 3_000) == [50, *range(300, 3_000, 300)]
    headgas: Any = PRESETS["paper"].config("headgas")
    assert rounds(headgas, PRESETS["paper"].settings_of("headgas").steps) == list(range(600, 15_000, 100))


def test_mono_gaussian_avatar_has_the_papers_sizes_rates_and_schedules() -> None:
    """A head model of four times life size: radius .5, scales .025, rate 1e-4."""
    paper: Any = PRESETS["paper"].config("mono_gaussian_avatar")
    assert (4 * paper.sphere_radius, 4 * paper.scale_gain, 4 * paper.means_rate.start) == (0.5, 0.025, 1e-4)
    check_section("MonoGaussianAvatar")


def test_the_preset_for_processors_is_that_of_the_paper_with_fewer_frames_and_points() -> None:
    method, small, paper = "mono_gaussian_avatar", PRESETS["paper-cpu"], PRESETS["paper"]
    config: Any = small.config(method)
    settings = small.settings_of(method)
    assert replace(config, max_points=100_000, frames_per_step=8) == paper.config(method)
    assert (config.max_points, config.frames_per_step) == (20_000, 1)
    assert replace(settings, steps=300_000) == paper.settings_of(method)
    assert [name for name in METHODS if "paper-cpu" in METHODS[name].presets] == [method]


def camera_at(*center: float) -> Camera:
    viewmat = torch.eye(4)
    viewmat[:3, 3] = -torch.tensor(center)
    return Camera(torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]), viewmat, 16, 16)


def test_extent_is_that_of_the_training_cameras_and_reaches_rates_in_its_unit_only() -> None:
    _, sequence = toy_sequence(2, 16)

    def extent(places: list[tuple[float, float, float]], *seen: int) -> float:
        cameras = tuple(camera_at(*place) for place in places)
        rig = replace(sequence, tracking=replace(sequence.tracking, cameras=cameras))
        return camera_extent([rig], [Frame(0, 0, index) for index in seen])

    three = [(0.0, 0.0, 0.0), (4.0, 0.0, 0.0), (2.0, 30.0, 0.0)]
    assert extent(three, 0, 1, 0) == pytest.approx(1.1 * 2)
    assert extent(three, 0) == extent([(0, 0, 0), (0.1, 0, 0)], 0, 1) == LEAST_EXTENT == 0.5
    angles = torch.linspace(-math.pi / 4, math.pi / 4, 16).tolist()
    arc = [(math.sin(angle), 0.0, math.cos(angle)) for angle in angles]
    assert extent(arc, *range(16)) == pytest.approx(0.8, abs=0.02)
    assert (PAPER.density.split_size, PAPER.density.prune_size) == (0.005 / LEAST_EXTENT, 0.05 / 0.5)
    for config, factor in ((plain_gaussian_avatars(), 1), (plain_gaussian_avatars(means_times_extent=True), 3)):
        moved = []
        for width in (1.0, 3.0):
            torch.manual_seed(0)
            avatar = GaussianAvatars(config, toy_face_model(), toy_face(5))
            store = avatar.store
            (store["means"].sum() + store["log_scales"].sum()).backward()
            Adam().step(avatar.parameter_groups(), Progress(0, 10, extent=width))
            moved.append([float(store[name].detach().abs().max()) for name in ("means", "log_scales")])
        assert moved[1] == [pytest.approx(factor * moved[0][0]), moved[0][1]]


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


def about_options(help_text: str) -> dict[str, str]:
    about: dict[str, str] = {}
    option = ""
    for line in help_text.replace("│", " ").splitlines():
        words = line.split()
        if words and words[0].startswith("--"):
            option = words[0]
        about[option] = " ".join([about.get(option, ""), *words])
    return about


def described(settings: Any, prefix: str) -> Iterator[tuple[str, str]]:
    """Yield every option of some settings, with the text below its field."""
    for one in fields(settings):
        value, option = getattr(settings, one.name), prefix + one.name.replace("_", "-")
        if is_dataclass(value):
            yield from described(value, f"{option}.")
        else:
            yield option, field_docs(type(settings))[one.name]


@pytest.mark.parametrize("method", METHODS)
def test_help_all_lists_every_setting_of_the_method(method: str, capsys: pytest.CaptureFixture[str]) -> None:
    text = help_of(capsys, "train", "--method", method, "--help-all")
    about, default = about_options(text), METHODS[method].config()
    for prefix, settings in (("method", default), ("training", TrainSettings())):
        for option, description in described(settings, f"--{prefix}."):
            assert description[0].isupper(), option
            assert option in about or option.removeprefix("--training.").replace("-", "_") in MAIN_SETTINGS


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
    cheaper = {"photometric", "appearance", "one_frame_from"}
    assert set(method.presets["draft"].get("method", {})) <= cheaper, f"draft of {name}: more than it may"
    assert "settings" not in method.presets["draft"]
    for preset in method.presets:
        assert type(PRESETS[preset].config(name)) is method.config
        PRESETS[preset].config(name).check()
        PRESETS[preset].settings_of(name).check()
    assert PRESETS["standard"].settings == TrainSettings()
