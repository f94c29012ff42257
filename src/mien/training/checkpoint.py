"""Checkpoints: everything that the rest of a run depends on. Each is one file, written atomically."""

from dataclasses import dataclass, fields
from pathlib import Path

import torch
from torch import Tensor

from mien.adam import FactoredMoments
from mien.avatar.avatar import Avatar
from mien.avatar.files import overwrite
from mien.avatar.store import Moments
from mien.disk.files import expect_whole, read_tensors, write_tensors
from mien.errors import UserError
from mien.machine.progress import say
from mien.machine.system import peak_memory_mb
from mien.training.adam import Adam
from mien.training.density_control.strategy import DensityStrategy
from mien.training.face_track import FaceTrack
from mien.training.footage.coverage import Coverage
from mien.training.parts import TrainingPart

_KEPT_CHECKPOINTS = 2
CURVES = {"step", "loss", "psnr", "gaussians", "step_ms"}
"""Curves that every run has."""


@dataclass(eq=False)
class TrainingState:
    """Everything that training changes. Random numbers depend only on seed and step, so there is no generator."""

    avatar: Avatar
    adam: Adam
    density: DensityStrategy
    track: FaceTrack
    curves: dict[str, list[float]]
    parts: tuple[TrainingPart, ...] = ()
    """What joins this training."""
    covered: Coverage | None = None
    """The part of the head that the training pictures show, if a part has asked for it."""
    step: int = 0
    """Number of steps done."""
    seconds: float = 0.0
    """Time spent on these steps, in seconds, by all processes that have trained the run."""
    peak_memory_mb: float = 0.0
    """Most memory that one of these processes has taken, in MB, when it was last measured."""

    def measure_memory(self) -> None:
        """Bring `peak_memory_mb` up to date."""
        self.peak_memory_mb = max(self.peak_memory_mb, peak_memory_mb())


def write_checkpoint(folder: Path, state: TrainingState) -> None:
    """Write a checkpoint into `folder` and delete all but the newest two."""
    state.measure_memory()
    tensors = {f"avatar.{name}": tensor for name, tensor in state.avatar.state_dict().items()}
    tensors |= {f"density.{name}": tensor for name, tensor in state.density.state().items()}
    tensors |= {f"track.{name}": tensor for name, tensor in state.track.state().items()}
    for part in state.parts:
        tensors |= {f"{part.name}.{name}": tensor for name, tensor in part.state().items()}
    tensors |= {f"curves.{name}": torch.tensor(curve, dtype=torch.float64) for name, curve in state.curves.items()}
    for owner, moments in (("store", state.avatar.gaussian_store().moments), ("adam", state.adam.state())):
        for name, own in moments.items():
            tensors |= {f"{owner}.{name}:{field.name}": getattr(own, field.name) for field in fields(own)}
    tensors |= {
        "step": torch.tensor(state.step),
        "seconds": torch.tensor(state.seconds, dtype=torch.float64),
        "peak_memory_mb": torch.tensor(state.peak_memory_mb, dtype=torch.float64),
        "gaussians": torch.tensor(len(state.avatar.gaussian_store())),
    }
    write_tensors(folder / f"step_{state.step:07d}.safetensors", tensors, {"format": "mien.checkpoint", "version": "1"})
    # Also delete unfinished files of a process that was killed while it wrote.
    for old in (*checkpoint_files(folder)[:-_KEPT_CHECKPOINTS], *folder.glob(".step_*")):
        old.unlink()


def checkpoint_files(folder: Path) -> list[Path]:
    """The checkpoints, oldest first."""
    return sorted(folder.glob("step_*.safetensors"))


def resume(folder: Path, state: TrainingState, first_record: int) -> None:
    """Restore the newest readable checkpoint into `state`, which is that of the run's start. There may be none.

    Reports damaged checkpoints, and where training continues instead. Curves are empty before step `first_record`.
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
            _restore(path, state, tensors, first_record)
        older = f" from the older checkpoint {path.name}" if damaged else ""
        say(f"training continues{older} at step {state.step:,}")
        return
    if damaged:
        say(f"{folder}: no checkpoint can be read; training starts again from the first step")


def _restore(path: Path, state: TrainingState, tensors: dict[str, Tensor], first_record: int) -> None:
    def part(prefix: str) -> dict[str, Tensor]:
        return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}

    for name, tensor in tensors.items():
        if not name.startswith("curves.") and not bool(tensor.isfinite().all()):
            raise ValueError(f"{name} is not finite")
    overwrite(state.avatar, part("avatar."), int(tensors["gaussians"]), path)
    store = state.avatar.gaussian_store()
    like = store[store.names()[0]]
    store.moments.update(_moments(part("store."), like, {name: store[name] for name in store.names()}))
    groups = {
        f"{group.name}/{name}": tensor
        for group in state.avatar.parameter_groups()
        if group.moments is None
        for name, tensor in group.tensors.items()
    }
    state.adam.load_state(_moments(part("adam."), like, groups))
    _check_like(part("density."), state.density.state(), len(store))
    state.density.load_state(part("density."))
    _check_like(part("track."), state.track.state(), None)
    state.track.load_state(part("track."))
    for joined in state.parts:
        own, stored = joined.state(), part(f"{joined.name}.")
        if own:
            _check_like(stored, own, None)
            joined.load_state(stored)
    state.step, state.seconds = int(tensors["step"]), float(tensors["seconds"])
    state.peak_memory_mb = float(tensors["peak_memory_mb"])
    curves = part("curves.")
    if state.step < 0 or state.seconds < 0 or any(curve.ndim != 1 for curve in curves.values()):
        raise ValueError("its step, its time or a curve is not valid")
    empty = not curves and state.step < first_record
    if len({len(curve) for curve in curves.values()}) > 1 or not (curves.keys() >= CURVES or empty):
        raise ValueError("its curves are incomplete")
    state.curves = {name: curve.tolist() for name, curve in curves.items()}


def _check_like(found: dict[str, Tensor], own: dict[str, Tensor], gaussians: int | None) -> None:
    """Check names, types and shapes against `own`. If `gaussians` is given, every first axis must have that length."""
    for name, tensor in own.items():
        shape = tensor.shape if gaussians is None else (gaussians, *tensor.shape[1:])
        if found[name].dtype != tensor.dtype or found[name].shape != shape:
            raise ValueError(f"{name} is of type {found[name].dtype} and shape {list(found[name].shape)}")


def _moments(
    tensors: dict[str, Tensor], like: Tensor, owners: dict[str, Tensor]
) -> dict[str, Moments | FactoredMoments]:
    """The moments by name, on the device of `like`, except for the step counts, which stay on the CPU."""
    moments = {}
    for name in dict.fromkeys(key.rpartition(":")[0] for key in tensors):
        factored = f"{name}:weights" in tensors
        moments[name] = (_factored_moments if factored else _full_moments)(name, tensors, like, owners[name])
    return moments


def _full_moments(name: str, tensors: dict[str, Tensor], like: Tensor, owner: Tensor) -> Moments:
    first, second = (tensors[f"{name}:{field}"].to(like.device) for field in ("first", "second"))
    step = tensors[f"{name}:step"]
    if not first.shape == second.shape == owner.shape or step.ndim:
        raise ValueError(f"the moments of {name} have another shape")
    if not (first.dtype == second.dtype == owner.dtype and step.dtype in (torch.float32, torch.int64)):
        raise ValueError(f"the moments of {name} have another type")
    return Moments(first, second, step)


def _factored_moments(name: str, tensors: dict[str, Tensor], like: Tensor, owner: Tensor) -> FactoredMoments:
    second, weights = (tensors[f"{name}:{field}"].to(like.device) for field in ("second", "weights"))
    if owner.ndim != 3 or second.shape != owner[:, 0].shape or weights.shape != owner.shape[:1]:
        raise ValueError(f"the moments of {name} have another shape")
    if not second.dtype == weights.dtype == owner.dtype:
        raise ValueError(f"the moments of {name} have another type")
    return FactoredMoments(second, weights)
