"""Checkpoints: everything that the rest of a run depends on. Each is one file, written atomically."""

from dataclasses import dataclass, field, fields
from pathlib import Path

import torch
from torch import Tensor

from mien.adam import FactoredMoments
from mien.avatar.avatar import Avatar
from mien.avatar.files import overwrite
from mien.avatar.store import Moments
from mien.disk.files import read_tensors, write_tensors
from mien.disk.reading import expect_whole
from mien.errors import UserError
from mien.machine.devices import gpu_memory_mb
from mien.machine.progress import say
from mien.machine.system import peak_memory_mb
from mien.training.adam import Adam
from mien.training.colors import CameraColors, FrameGains, LearnedColors
from mien.training.density_control.strategy import DensityStrategy
from mien.training.footage.face_track import FaceTrack
from mien.training.graphs import PoseGraph
from mien.training.whole_head.head import WholeHead

_KEPT_CHECKPOINTS = 2
CURVES = {"step", "loss", "psnr", "gaussians", "step_ms"}
"""Curves that every run has."""


@dataclass(eq=False)
class TrainingState:
    """Everything that training changes. Random numbers depend only on seed and step, so there is no generator."""

    avatar: Avatar
    adam: Adam
    density: DensityStrategy | None
    """None if the number of Gaussians never changes."""
    track: FaceTrack
    curves: dict[str, list[float]]
    head: WholeHead | None = None
    """What is done about a surface that Gaussians are bound to."""
    gains: FrameGains | None = None
    camera_colors: CameraColors | None = None
    step: int = 0
    """Number of steps done."""
    seconds: float = 0.0
    """Time spent on these steps, in seconds, by all processes that have trained the run."""
    peak_memory_mb: float = 0.0
    """Most memory of the host that one of these processes has taken, in MB, when it was last measured."""
    gpu_memory_mb: float = 0.0
    """The same for the tensors on the GPU; 0 for a run on the CPU."""
    graph: PoseGraph = field(default_factory=PoseGraph)
    """Poses the avatar. No checkpoint has it."""

    @property
    def colors(self) -> list[FrameGains | CameraColors]:
        """What changes the colours of pictures before they are compared."""
        return [own for own in (self.gains, self.camera_colors) if own is not None]

    def joined(self) -> dict[str, WholeHead | LearnedColors]:
        """What trains beside the avatar and has a state, by the prefix of its tensors."""
        head = {} if self.head is None else {self.head.name: self.head}
        return head | {own.learned.name: own.learned for own in self.colors}

    def measure_memory(self) -> None:
        """Bring `peak_memory_mb` and `gpu_memory_mb` up to date."""
        self.peak_memory_mb = max(self.peak_memory_mb, peak_memory_mb())
        self.gpu_memory_mb = max(self.gpu_memory_mb, gpu_memory_mb(self.avatar.face_model.template.device))


def write_checkpoint(folder: Path, state: TrainingState) -> None:
    """Write a checkpoint into `folder` and delete all but the newest two."""
    state.measure_memory()
    tensors = {f"avatar.{name}": tensor for name, tensor in state.avatar.state_dict().items()}
    if state.density is not None:
        tensors |= {f"density.{name}": tensor for name, tensor in state.density.state().items()}
    tensors |= {f"track.{name}": tensor for name, tensor in state.track.state().items()}
    for prefix, joined in state.joined().items():
        tensors |= {f"{prefix}.{name}": tensor for name, tensor in joined.state().items()}
    tensors |= {f"curves.{name}": torch.tensor(curve, dtype=torch.float64) for name, curve in state.curves.items()}
    for owner, moments in (("store", state.avatar.store.moments), ("adam", state.adam.state())):
        for name, own in moments.items():
            tensors |= {f"{owner}.{name}:{field.name}": getattr(own, field.name) for field in fields(own)}
    tensors |= {
        "step": torch.tensor(state.step),
        "seconds": torch.tensor(state.seconds, dtype=torch.float64),
        "peak_memory_mb": torch.tensor(state.peak_memory_mb, dtype=torch.float64),
        "gaussians": torch.tensor(len(state.avatar.store)),
    }
    if state.gpu_memory_mb:
        tensors["gpu_memory_mb"] = torch.tensor(state.gpu_memory_mb, dtype=torch.float64)
    write_tensors(folder / f"step_{state.step:07d}.safetensors", tensors, {"format": "mien.checkpoint", "version": "1"})
    # Also delete unfinished files of a process that was killed while it wrote.
    for old in (*checkpoint_files(folder)[:-_KEPT_CHECKPOINTS], *folder.glob(".step_*")):
        old.unlink()


def checkpoint_files(folder: Path) -> list[Path]:
    """The checkpoints, oldest first."""
    return sorted(folder.glob("step_*.safetensors"))


def resume(folder: Path, state: TrainingState) -> None:
    """Restore the newest readable checkpoint into `state`, which is that of the run's start. There may be none.

    Reports damaged checkpoints, and where training continues instead.
    """
    damaged = False
    for path in reversed(checkpoint_files(folder)):
        try:
            tensors = read_tensors(path)
        except UserError as error:
            say(f"warning: {str(error).split('; ')[0]}")
            damaged = True
            continue
        with expect_whole(path, "delete it and run the same command again"):
            _restore(path, state, tensors)
        older = f" from the older checkpoint {path.name}" if damaged else ""
        say(f"training continues{older} at step {state.step:,}")
        return
    if damaged:
        say(f"{folder}: no checkpoint can be read; training starts again from the first step")


def _restore(path: Path, state: TrainingState, tensors: dict[str, Tensor]) -> None:
    def part(prefix: str) -> dict[str, Tensor]:
        return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}

    for name, tensor in tensors.items():
        if not name.startswith("curves.") and not bool(tensor.isfinite().all()):
            raise ValueError(f"{name} is not finite")
    overwrite(state.avatar, part("avatar."), int(tensors["gaussians"]), path)
    store = state.avatar.store
    store.moments.update(_moments(part("store."), {name: store[name] for name in store.names()}))
    own = [group for group in state.avatar.parameter_groups() if group.moments is None]
    state.adam.load_state(
        _moments(part("adam."), {f"{group.name}/{name}": each for group in own for name, each in group.tensors.items()})
    )
    if state.density is not None:
        for name, counted in state.density.state().items():
            _check_shape(name, tensors[f"density.{name}"], (len(store), *counted.shape[1:]), counted.dtype)
        state.density.load_state(part("density."))
    state.track.load_state(part("track."))
    for prefix, joined in state.joined().items():
        joined.load_state(part(f"{prefix}."))
    state.step, state.seconds = int(tensors["step"]), float(tensors["seconds"])
    state.peak_memory_mb = float(tensors["peak_memory_mb"])
    state.gpu_memory_mb = float(tensors.get("gpu_memory_mb", 0.0))
    curves = part("curves.")
    if state.step < 0 or len({curve.shape for curve in curves.values()}) > 1 or ("loss" in curves) != bool(curves):
        raise ValueError("its step or its curves are not valid")
    state.curves = {name: curve.tolist() for name, curve in curves.items()}


def _moments(tensors: dict[str, Tensor], owners: dict[str, Tensor]) -> dict[str, Moments | FactoredMoments]:
    """The moments by name, on the device of their owners, except for the step counts, which stay on the CPU."""
    fields_of: dict[str, dict[str, Tensor]] = {}
    for key, tensor in tensors.items():
        name, _, field = key.rpartition(":")
        owner = owners[name]
        if field != "step":
            factored = {"second": owner[:, 0].shape, "weights": owner.shape[:1]} if f"{name}:weights" in tensors else {}
            _check_shape(key, tensor, factored.get(field, owner.shape), owner.dtype)
        fields_of.setdefault(name, {})[field] = tensor if field == "step" else tensor.to(owner.device)
    return {name: (FactoredMoments if "weights" in own else Moments)(**own) for name, own in fields_of.items()}


def _check_shape(name: str, tensor: Tensor, shape: tuple[int, ...], dtype: torch.dtype) -> None:
    if tensor.shape != shape or tensor.dtype != dtype:
        raise ValueError(f"{name} is of type {tensor.dtype} and shape {list(tensor.shape)}")
