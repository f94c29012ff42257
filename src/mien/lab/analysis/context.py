"""Give the parts of an analysis what they use: the run, the options, and measurements kept between commands."""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from jaxtyping import Bool
from torch import Tensor

import mien
from mien import _native
from mien.avatar.avatar import Avatar
from mien.avatar.files import load_avatar
from mien.avatar.settings import MethodConfig
from mien.camera import Camera
from mien.disk.config import decode, encode
from mien.disk.files import read_json, write_json
from mien.errors import UserError
from mien.evaluation.experiment import Experiment, avatar_image, target_image
from mien.evaluation.load import load_experiments
from mien.evaluation.metrics import psnr
from mien.face.model import FaceModel
from mien.lab.analysis.spec import AnalysisOptions
from mien.machine.progress import say
from mien.training.footage.sequence import Sequence as TrainedSequence
from mien.training.footage.sequence import read_sequence
from mien.training.run import check_data, read_curves, read_run_config, read_training_summary, run_camera
from mien.training.settings import TrainSettings
from mien.training.trainer import train

_KEPT, _VERSION = "mien.analysis.kept", 1
_MAX_NUMBER = 1e12
"""Bound of the numbers in a kept measurement that are read."""
_CHECKPOINT_STEPS = 250
"""Steps between checkpoints of short trainings."""


@dataclass(frozen=True, eq=False)
class Variant:
    """A short training with something changed."""

    run_dir: Path
    avatar: Avatar
    curves: dict[str, Any]
    summary: dict[str, Any]


@dataclass(frozen=True, eq=False)
class Context:
    """A finished run, the options, and the folder of its analysis. Everything is read at its first use."""

    run_dir: Path
    sequence_dirs: tuple[Path, ...]
    """The folders of the run's sequences, in its order. They may be missing; growth and speed do not need them."""
    folder: Path
    """The folder of the analysis: pictures and films are written here, short trainings below `runs/`."""
    options: AnalysisOptions

    @cached_property
    def config(self) -> dict[str, Any]:
        """The content of the run's config.json."""
        return read_run_config(self.run_dir)

    @cached_property
    def settings(self) -> TrainSettings:
        """The settings that the run was trained with."""
        path = str(self.run_dir / "config.json")
        return decode(TrainSettings, self.config["settings"], path, "train it again")

    @cached_property
    def summary(self) -> dict[str, Any]:
        """`steps, seconds, gaussians, step_ms_median, peak_memory_mb` of the run."""
        return read_training_summary(self.run_dir)

    @cached_property
    def curves(self) -> dict[str, Any]:
        """The run's curves: step, gaussians, step_ms and others, each a numpy array."""
        return read_curves(self.run_dir)

    @cached_property
    def avatar(self) -> Avatar:
        """The run's avatar."""
        return load_avatar(self.run_dir)

    @cached_property
    def camera(self) -> Camera:
        """The first camera that the run was trained with."""
        return run_camera(self.run_dir)

    @cached_property
    def sequences(self) -> list[TrainedSequence]:
        """The sequences of the run."""
        sequences = [read_sequence(folder) for folder in self.sequence_dirs]
        check_data(self.run_dir, {sequence.name: sequence.tracking for sequence in sequences})
        return sequences

    def experiment(self, run_dir: Path | None = None) -> Experiment | None:
        """The first protocol with held-out frames of this run, or of a short training; None if nothing was held out."""
        return next(iter(load_experiments(run_dir or self.run_dir, self.sequence_dirs).values()), None)

    def kept(self, name: str, key: Any, measure: Callable[[], Mapping[str, float | int]]) -> dict[str, Any]:
        """Return the kept result of `measure` for this key, or run it and keep its result.

        Args:
            name: Name of the measurement; a file of that name keeps it.
            key: Everything that the result depends on, as json can hold it.
            measure: Returns numbers by name.
        """
        path, digest = self.folder / "kept" / f"{name}.json", digest_of(key)
        if path.is_file():
            try:
                content = read_json(path, _KEPT, _VERSION)
            except UserError:
                content = {}
            if content.get("key") == digest and _are_numbers(content.get("result")):
                return content["result"]
        result = dict(measure())
        write_json(path, _KEPT, _VERSION, {"key": digest, "result": result})
        return result

    def train(
        self,
        name: str,
        config: MethodConfig,
        face_model: FaceModel | None = None,
        resolution: int | None = None,
        timesteps: Sequence[Bool[Tensor, " t"]] | None = None,
    ) -> Variant:
        """Train the run's sequences again for `options.steps` steps, with something changed.

        A stopped training continues, and a finished one is only read.

        Args:
            name: Name of the variant, which begins the name of its folder.
            config: The method's settings.
            face_model: A face model with the vertices of the run's; None for that one.
            resolution: Longer side of the training pictures, in pixels; None for that of the run.
            timesteps: Which timesteps of each sequence may be trained on; None for all.
        """
        model = face_model or self.avatar.face_model
        settings = replace(self.settings, steps=self.options.steps, checkpoint_every=_CHECKPOINT_STEPS)
        if resolution is not None:
            settings = replace(settings, resolution=resolution)
        key = [encode(config), encode(settings), self.config["data"], model.content_hash]
        key += [] if timesteps is None else [[one.nonzero()[:, 0].tolist() for one in timesteps]]
        run_dir = self.folder / "runs" / f"{name}-{self.options.steps}-{digest_of(key)[:8]}"
        sequences = [
            replace(one, tracking=replace(one.tracking, face_model=model.name, face_model_hash=model.content_hash))
            for one in self.sequences
        ]
        if timesteps is not None:
            sequences = [
                replace(one, tracking=replace(one.tracking, valid=one.tracking.valid & some))
                for one, some in zip(sequences, timesteps, strict=True)
            ]
        avatar = train(sequences, model, config, settings, run_dir)
        return Variant(run_dir, avatar, read_curves(run_dir), read_training_summary(run_dir))

    def say_how_long(self, part: str, trainings: int) -> None:
        """Report beforehand how long the short trainings of a part take, from the pace of the run."""
        _ = self.sequences
        pace = self.summary["seconds"] / max(self.summary["steps"], 1)
        minutes = trainings * self.options.steps * pace / 60
        about = f"{minutes:.0f} min" if minutes >= 2 else f"{60 * minutes:.0f} s"
        say(
            f"{part}: {trainings} trainings of {self.options.steps:,} steps each, about {about} in all at the pace "
            "of this run; a stopped command continues, and what is trained is not trained again"
        )


def digest_of(key: Any) -> str:
    """A hash of json, of this version of mien and of the instruction set, as hex digits."""
    text = json.dumps([key, mien.__version__, _native.rasterize_isa()], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _are_numbers(result: Any) -> bool:
    """Whether it holds only numbers that a measurement can give."""
    values = result.values() if isinstance(result, dict) else [None]
    return all(isinstance(value, int | float) and 0 <= value < _MAX_NUMBER for value in values)


def mean_psnr(experiment: Experiment, frames: Sequence[Any]) -> float:
    """The mean PSNR of the head crop over some frames, in dB."""
    values = [
        psnr(avatar_image(experiment, frame), target_image(experiment, frame), experiment.crop(frame))
        for frame in frames
    ]
    return sum(values) / len(values)
