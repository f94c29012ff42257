"""Training works without the native core: on a GPU if there is one, and with the same code in PyTorch on the CPU.

Tensors that are not float32 on a CPU use the plain PyTorch twins of all native operations, and the reference rasterizer
instead of gsplat. So training in float64 runs all the code of a GPU except gsplat's kernels."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

import mien.machine.devices
import train_toy
from mien import _native
from mien.avatar import GaussianAvatarsConfig, load_avatar
from mien.cli import main
from mien.commands import render
from mien.face import FaceModel
from mien.machine.devices import choose_device, gpu_memory_mb, like_on
from mien.training import TrainSettings, train
from mien.training.checkpoint import TrainingState
from mien.training.footage.sequence import Sequence
from mien.training.trainer import start, step
from mien.training.whole_head.hair_surface import HairSurface
from refusals import refuses
from shared_things import toy_workspace
from toy_scene import toy_data, toy_sequence
from train_toy import silence, stopped_at

SETTINGS = replace(train_toy.SETTINGS, steps=12, record_every=1)


Scene = tuple[FaceModel, Sequence]


scene = pytest.fixture(scope="module")(lambda: toy_sequence(timesteps=5, size=32))


def train_some(
    scene: Scene, like: Tensor, config=train_toy.CONFIG, settings: TrainSettings = SETTINGS
) -> TrainingState:
    """Return the state after training with this dtype and device."""
    face_model, sequence = scene
    data = toy_data(sequence, settings, like)
    state = start([sequence], face_model, config, settings, like)
    for _ in range(settings.steps):
        step(state, data, settings)
    return state


def assert_alike(one: TrainingState, other: TrainingState) -> None:
    """Check that curves are equal at first. Later, last digits decide which Gaussians grow, so they are only close."""
    for name in ("loss", "photometric", "position", "scale", "psnr"):
        assert one.curves[name][:3] == pytest.approx(other.curves[name][:3], rel=2e-4, abs=1e-6), name
    assert one.curves["loss"] == pytest.approx(other.curves["loss"], rel=2e-2)


@pytest.mark.unchecked
def test_plain_pytorch_trains_as_the_native_core_does(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    native = train_some(scene, torch.zeros(()))

    def refuse(*_: object) -> None:
        raise AssertionError("a native operation away from float32 on a CPU")

    parts = "ride rig_forward pose_face sigmoid head_poses rasterize_views photometric_loss triangle_penalties"
    for name in f"{parts} observe_view adam_update mean_squared_difference absolute_difference".split():
        monkeypatch.setattr(_native, name, refuse)
    plain = train_some(scene, torch.zeros((), dtype=torch.float64))
    assert plain.avatar.store["means"].dtype == torch.float64
    assert plain.curves["gaussians"] == native.curves["gaussians"]
    assert len(set(native.curves["gaussians"])) > 1  # density control has run
    assert_alike(plain, native)
    assert native.curves["loss"][-1] < native.curves["loss"][0]


@pytest.fixture
def no_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)


def test_a_device_is_chosen_or_says_what_to_do(monkeypatch, no_gpu: None, tmp_path: Path, capsys) -> None:
    needs = "needs a CUDA GPU and gsplat.*uv pip install"
    for gsplat, words in ((None, needs), (object(), "torch .*nvidia-smi")):
        monkeypatch.setattr(mien.machine.devices, "find_spec", lambda name, gsplat=gsplat: gsplat)
        refuses(f"--device cuda: {words}", choose_device, "cuda")
    assert choose_device("auto").type == choose_device("cpu").type == "cpu"
    assert "using the processor" in capsys.readouterr().err
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "some GPU")
    monkeypatch.setattr(mien.machine.devices, "find_spec", lambda name: None if name == "gsplat.csrc" else object())
    monkeypatch.setenv("PATH", str(tmp_path))
    refuses("--device cuda: gsplat finds no nvcc .*install the CUDA toolkit .*leave --device", choose_device, "cuda")
    assert choose_device("auto").type == "cpu"
    assert "--device auto: gsplat finds no nvcc to compile its kernels with; using" in capsys.readouterr().err
    (tmp_path / "nvcc").touch(0o755)
    assert choose_device("auto").type == choose_device("cuda").type == "cuda"
    assert "some GPU: gsplat compiles its kernels at first use" in capsys.readouterr().err


def test_memory_of_a_gpu_is_what_its_tensors_took(monkeypatch: pytest.MonkeyPatch) -> None:
    restarted: list[torch.device] = []
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda device: 3 << 30)
    monkeypatch.setattr(torch.cuda, "reset_peak_memory_stats", restarted.append)
    gpu = torch.device("cuda")
    assert (gpu_memory_mb(gpu), gpu_memory_mb(torch.device("cpu")), restarted) == (3072, 0, [])
    assert (gpu_memory_mb(gpu, restart=True), restarted) == (3072, [gpu])


@pytest.mark.unchecked
def test_a_run_goes_on_elsewhere(scene: Scene, tmp_path: Path, no_gpu: None) -> None:
    face_model, sequence = scene
    train([sequence], face_model, train_toy.CONFIG, replace(SETTINGS, device="auto"), tmp_path / "run", silence)
    # The run is finished. On another device it is the same run, and is only loaded.
    again = train([sequence], face_model, train_toy.CONFIG, SETTINGS, tmp_path / "run", silence)
    assert len(again.store) > 0


@pytest.mark.gpu
def test_a_gpu_trains_as_the_native_core_does_and_its_run_goes_on_without_one(scene: Scene, tmp_path: Path) -> None:
    native, on_gpu = train_some(scene, torch.zeros(())), train_some(scene, like_on("cuda"))
    store = on_gpu.avatar.store
    assert all(store[name].is_cuda for name in store.names())
    assert_alike(on_gpu, native)
    face_model, sequence = scene
    often = replace(SETTINGS, device="cuda", checkpoint_every=1)
    with pytest.raises(KeyboardInterrupt):
        train([sequence], face_model, train_toy.CONFIG, often, tmp_path, stopped_at(SETTINGS.steps // 2))
    train([sequence], face_model, train_toy.CONFIG, replace(often, device="cpu"), tmp_path, silence)
    assert load_avatar(tmp_path).store["means"].device.type == "cpu"


@pytest.mark.unchecked
@pytest.mark.parametrize("device", ["float64", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_a_whole_head_is_trained_on_a_device(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """By default, with sides that are filled and features. Steps reach a correction of the hair and a prune."""
    monkeypatch.setattr("mien.training.whole_head.head.HAIR_EVERY", 2)
    corrections, correct = [], HairSurface.correct
    monkeypatch.setattr(HairSurface, "correct", lambda *given: corrections.append(correct(*given)) or corrections[-1])
    like = like_on("cuda") if device == "cuda" else torch.zeros((), dtype=torch.float64)
    settings = TrainSettings(steps=4, split="none", unseen="filled", mesh="fitted", record_every=1)
    state = train_some(toy_sequence(timesteps=5, size=16), like, GaussianAvatarsConfig(), settings)
    assert corrections[0]
    store = state.avatar.store
    assert all(store[name].device.type == like.device.type for name in store.names())
    assert all(torch.isfinite(store[name]).all() for name in store.trained)


def pictures(workspace: Path, out: Path, device: str) -> np.ndarray:
    """Return the pictures that `mien render --device` wrote."""
    options = ["--path", "turntable", "--frames", "2", "--size", "32", "--device", device]
    assert main(["render", str(workspace), "--out", str(out), *options]) == 0
    return np.stack([np.asarray(cv2.imread(str(path)), np.float32) for path in sorted(out.glob("*.png"))])


@pytest.mark.unchecked
@pytest.mark.parametrize("device", ["auto", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_pictures_are_the_same_wherever_they_are_drawn(device: str, made_once, tmp_path, monkeypatch) -> None:
    workspace = toy_workspace(made_once)
    native = pictures(workspace, tmp_path / "native", "cpu")
    if device == "auto":  # in place of a GPU: plain PyTorch in float64
        monkeypatch.setattr(render, "like_on", lambda device: torch.zeros((), dtype=torch.float64))
    assert native.std() > 1
    assert np.abs(native - pictures(workspace, tmp_path / "other", device)).max() <= 1
