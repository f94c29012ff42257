"""A step of training on a GPU launches little and waits for nothing, counted with tensors on the device `meta`."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from types import ModuleType

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from launches import META, Launches, no_gsplat, pin
from mien.adam import FactoredMoments
from mien.avatar import GaussianAvatarsConfig
from mien.avatar.methods import METHODS
from mien.avatar.settings import MethodConfig, Progress
from mien.machine.progress import Advance
from mien.training import PRESETS, TrainSettings, trainer
from mien.training.alignment import align_faces
from mien.training.checkpoint import TrainingState
from mien.training.density_control import gradient, refill
from mien.training.footage.frames import training_frames
from mien.training.settings import AlignmentSettings
from mien.training.whole_head import side_views
from plain_settings import plain_config, plain_run
from toy_scene import toy_data, toy_face, toy_sequence

LONG = {"steps": 1_000_000, "split": "none", "record_every": 1_000_000}
"""A run in whose first steps nothing happens that most steps do not have."""


class Constants(TorchFunctionMode):
    """Lists tensors that are made of numbers on the device `meta`: a GPU copies them from memory that is not pinned."""

    def __init__(self) -> None:
        super().__init__()
        self.waits: list[str] = []

    def __torch_function__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        if func in (torch.tensor, torch.as_tensor, Tensor.new_tensor) and result.device.type == "meta":
            self.waits.append(f"{func.__name__} of {args[-1]}")
        return result


@pytest.fixture(autouse=True)
def gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    pretend(monkeypatch)


def pretend(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let tensors on `meta` be drawn by a gsplat without kernels, and what comes back be a face."""
    monkeypatch.setitem(sys.modules, "gsplat", no_gsplat())
    rasterize = sys.modules["mien.render.rasterize"]
    assert isinstance(rasterize, ModuleType)
    monkeypatch.setattr(rasterize, "choose_backend", lambda like: "gsplat")
    monkeypatch.setattr(Tensor, "pin_memory", pin)
    monkeypatch.setattr(side_views, "fetch", fetched)


def fetched(tensor: Tensor):
    face = toy_face(3)[1]
    known = (face.expression, face.joints, face.head_rotation, face.head_translation)
    flat = torch.cat([own.flatten() for own in known])
    return lambda: torch.cat([flat, torch.zeros(len(tensor) - len(flat))])


def configs() -> dict[str, MethodConfig]:
    """All methods, with every loss, and again with colours that depend on the view where a method has them."""
    found = {}
    for name in METHODS:
        config = plain_config(name)
        tuning = replace(config.face_tuning, keep_mean_pose=True, keep_turns=True)
        config = replace(config, face_tuning=tuning)
        found[name] = replace(config, photometric=replace(config.photometric, alpha_weight=0.1))
        if "sh_degree" in {field.name for field in fields(config)}:
            found[f"{name}-sh3"] = replace(config, sh_degree=3)
    return found


CONFIGS = configs()


def steps(config: MethodConfig, settings: TrainSettings, count: int) -> Iterator[tuple[TrainingState, int]]:
    """Take steps on `meta`, none of which waits, and yield the number of their launches."""
    face_model, sequence = toy_sequence(timesteps=3, size=32)
    state = trainer.start([sequence], face_model, config, settings, META)
    data = toy_data(sequence, settings, META)
    for number in range(count):
        with Constants() as constants, Launches() as launches:
            trainer.step(state, data, settings)
        # The first step moves to a GPU what stays there.
        assert number == 0 or not launches.waits + constants.waits
        yield state, launches.count


@pytest.mark.unchecked
@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS.keys())
def test_a_step_of_training_waits_for_nothing(config: MethodConfig) -> None:
    """The trainer's own step reads no number, in a run whose pictures are composited in every step."""
    *_, (state, _) = steps(config, plain_run(background="random", **LONG), 3)
    with Constants() as constants, Launches() as launches:
        state.track.steady_pose()
    assert not launches.waits + constants.waits
    store = state.avatar.store
    assert all(store[name].device.type == "meta" for name in store.names())
    updated = {**store.moments, **state.adam.state()}
    assert updated
    for moments in updated.values():
        if isinstance(moments, FactoredMoments):
            assert moments.second.device.type == "meta"
        else:
            assert (float(moments.step), moments.first.device.type) == (3, "meta")


@pytest.mark.unchecked
@pytest.mark.parametrize("method", ["gaussian_avatars", "headgas", "mono_gaussian_avatar"])
def test_a_round_of_density_waits_once(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    reads: list[int] = []

    def counted(*masks: Tensor) -> list[int]:
        reads.append(len(masks))
        return [5, 3, 40][: len(masks)]

    for module in (gradient, refill):
        monkeypatch.setattr(module, "count_each", counted)
    ((state, _),) = steps(without_features(PRESETS["paper"].config(method)), plain_run(**LONG), 1)
    posed, density = state.avatar.pose(state.track.face(0)), state.density
    assert density is not None
    with Constants() as constants, Launches() as launches:
        assert any(
            density.adapt(state.avatar.store, posed, Progress(number, 1000, 0, 1.0), torch.Generator)
            for number in range(1000)
        )
    assert not launches.waits + constants.waits
    assert len(reads) == 1
    assert len(state.avatar.store) == {1: 400, 3: 51}[reads[0]]


def without_features(config: MethodConfig) -> MethodConfig:
    """The settings without the perceptual loss, whose network belongs to PyTorch."""
    photometric = config.photometric
    return replace(config, photometric=replace(photometric, perceptual=replace(photometric.perceptual, weight=0.0)))


@pytest.mark.unchecked
@pytest.mark.parametrize(
    ("method", "changes", "most"),
    [
        ("gaussian_avatars", {}, 90), ("headgas", {}, 90), ("mono_gaussian_avatar", {"frames_per_step": 1}, 120),
        ("mono_gaussian_avatar", {}, 285),
    ],
)  # fmt: skip
def test_a_step_of_a_paper_has_few_launches(method: str, changes: dict[str, int], most: int) -> None:
    """MonoGaussianAvatar has eight pictures a step until it has many points, and then one."""
    config = replace(without_features(PRESETS["paper"].config(method)), **changes)
    settings = replace(PRESETS["paper"].settings_of(method), **LONG)
    counts = [count for _, count in steps(config, settings, 3)]
    assert max(counts[1:]) <= most, counts


def default() -> tuple[MethodConfig, TrainSettings]:
    """Sides that are filled, limits, hair that moves, features, and a mouth that hides what is in it."""
    return GaussianAvatarsConfig(), TrainSettings(unseen="filled", mesh="fitted", **LONG)


@pytest.mark.unchecked
def test_the_default_has_few_launches_and_side_views_at_most_twice_as_many() -> None:
    """A step has two pictures, and every second one a side view as well."""
    config, settings = default()
    counts = [count for _, count in steps(without_features(config), settings, 9)]
    plain, with_views = counts[1::2], counts[2::2]
    assert max(plain) <= 130, counts
    assert max(with_views) <= 225, counts
    assert min(with_views) > max(plain), "side views are among them"


@pytest.mark.unchecked
def test_aligning_frames_waits_for_nothing() -> None:
    """Eight steps of a frame to a fixed avatar: poses, pictures, losses and the descent stay on the GPU."""
    face_model, sequence = toy_sequence(timesteps=3, size=32)
    settings = plain_run(**LONG)
    avatar = trainer.start([sequence], face_model, GaussianAvatarsConfig(), settings, META).avatar
    waits: list[list[str]] = []

    @contextmanager
    def counted(*_: object) -> Iterator[Advance]:
        with Constants() as constants, Launches() as launches:
            yield lambda amount=1, status="": waits.append([*launches.waits, *constants.waits])

    known = training_frames([sequence], settings)
    with pytest.raises(NotImplementedError, match="meta"):  # where the faces are copied to the CPU
        align_faces(
            avatar, [sequence], [sequence.tracking.face], known, AlignmentSettings(), progress=counted, like=META
        )
    # What stays on a GPU is moved there with the first frame.
    assert [own[len(waits[0]) :] for own in waits] == [[], [], []]


def test_a_copy_that_waits_is_found() -> None:
    with Constants() as constants, Launches() as launches:
        torch.zeros(3).to("meta")
        torch.zeros(3).pin_memory().to("meta", non_blocking=True)
        torch.empty(5, device="meta")[torch.zeros(2, dtype=torch.long)]
        META.new_tensor([1.0, 2.0])
    assert [wait.rpartition(" ")[2] for wait in launches.waits] == ["_to_copy", "index"]
    assert len(constants.waits) == 1
    assert launches.count == 3
