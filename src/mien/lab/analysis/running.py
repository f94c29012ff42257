"""A trained run, short trainings of the same with something changed, and how the parts of an analysis are run.

`run_analysis` writes analysis.json, a file for each chart and picture, and the page.
"""

import hashlib
import json
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from jaxtyping import Bool
from torch import Tensor

import mien
from mien import _native
from mien.avatar.avatar import Avatar, move_avatar
from mien.avatar.files import load_avatar
from mien.avatar.settings import MethodConfig
from mien.camera import Camera
from mien.disk.config import decode, encode
from mien.disk.files import file_digest, read_json, write_atomically, write_json
from mien.disk.locks import hold
from mien.disk.reading import check_tree, expect_whole, inside
from mien.errors import UserError
from mien.evaluation.experiment import Experiment
from mien.evaluation.load import load_experiments
from mien.face.model import FaceModel
from mien.lab.analysis.registry import Analysis, AnalysisOptions, Part
from mien.lab.analysis.result import section_html
from mien.machine.devices import DeviceName, choose_device, like_on
from mien.machine.progress import say
from mien.pages.pages import render
from mien.plugins import named
from mien.training.footage.sequence import Sequence as TrainedSequence
from mien.training.footage.sequence import read_sequence
from mien.training.run import check_data, read_curves, read_run_config, read_training_summary, run_camera
from mien.training.settings import TrainSettings
from mien.training.trainer import train

_FORMAT, _VERSION = "mien.analysis", 1
_REMEDY = "delete it and run the same `mien analyze` again"


@dataclass(frozen=True, eq=False)
class Run:
    """A finished run. Everything is read at its first use."""

    run_dir: Path
    sequence_dirs: tuple[Path, ...]
    """The folders of the run's sequences, in its order. They may be missing; not every part needs them."""
    like: Tensor
    """A number on the device of short trainings and of timed drawing."""

    @cached_property
    def config(self) -> dict[str, Any]:
        """The content of config.json."""
        return read_run_config(self.run_dir)

    @cached_property
    def settings(self) -> TrainSettings:
        """The settings that the run was trained with."""
        return decode(TrainSettings, self.config["settings"], str(self.run_dir / "config.json"), "train it again")

    @cached_property
    def summary(self) -> dict[str, Any]:
        """`steps, seconds, gaussians, step_ms_median, peak_memory_mb`."""
        return read_training_summary(self.run_dir)

    @cached_property
    def curves(self) -> dict[str, Any]:
        """Step, gaussians, step_ms and others over the training, each a numpy array."""
        return read_curves(self.run_dir)

    @cached_property
    def avatar(self) -> Avatar:
        """The trained avatar, on the CPU."""
        return load_avatar(self.run_dir)

    @cached_property
    def timed_avatar(self) -> Avatar:
        """The trained avatar once more, on the device where drawing is timed."""
        move_avatar(avatar := load_avatar(self.run_dir), self.like)
        return avatar

    @cached_property
    def camera(self) -> Camera:
        """The first camera of the training."""
        return run_camera(self.run_dir)

    @cached_property
    def sequences(self) -> list[TrainedSequence]:
        """The sequences of the training."""
        sequences = [read_sequence(folder) for folder in self.sequence_dirs]
        check_data(self.run_dir, {sequence.name: sequence.tracking for sequence in sequences})
        return sequences

    @cached_property
    def experiment(self) -> Experiment | None:
        """The first protocol with held-out frames; None if nothing was held out."""
        return next(iter(load_experiments(self.run_dir, self.sequence_dirs).values()), None)


@dataclass(frozen=True, eq=False)
class Context(Run):
    """The run that is analysed, the options, and the folder of the analysis."""

    folder: Path
    """Pictures and films are written here, short trainings below `runs/`."""
    options: AnalysisOptions

    @cached_property
    def short_settings(self) -> TrainSettings:
        """The run's settings for `options.steps` steps on the chosen device."""
        device: DeviceName = "cuda" if self.like.is_cuda else "cpu"
        return replace(self.settings, steps=self.options.steps, device=device)

    def train(
        self, name: str, config: MethodConfig, face_model: FaceModel | None = None, resolution: int | None = None,
        timesteps: Sequence[Bool[Tensor, " t"]] | None = None,
    ) -> Run:  # fmt: skip
        """Train the run's sequences again for `options.steps` steps, with something changed.

        A stopped training continues, and a finished one is only read. `resolution` is the longer side of the training
        pictures, in pixels, and `timesteps` are those of each sequence that may be trained on; None is all.
        """
        model = face_model or self.avatar.face_model
        settings = replace(self.short_settings, checkpoint_every=250)
        if resolution is not None:
            settings = replace(settings, resolution=resolution)
        key = [encode(config), encode(settings), self.config["data"], model.content_hash]
        key += [] if timesteps is None else [[one.nonzero()[:, 0].tolist() for one in timesteps]]
        run_dir = self.folder / "runs" / f"{name}-{self.options.steps}-{_digest_of(key)[:8]}"
        trackings = [
            replace(one.tracking, face_model=model.name, face_model_hash=model.content_hash) for one in self.sequences
        ]
        if timesteps is not None:
            trackings = [replace(one, valid=one.valid & some) for one, some in zip(trackings, timesteps, strict=True)]
        sequences = [replace(one, tracking=own) for one, own in zip(self.sequences, trackings, strict=True)]
        train(sequences, model, config, settings, run_dir)
        return Run(run_dir, self.sequence_dirs, self.like)

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


def run_analysis(
    analysis: Analysis, parts: Sequence[Part], run_dir: Path, sequence_dirs: Sequence[Path], folder: Path,
    options: AnalysisOptions,
) -> dict[str, Any]:  # fmt: skip
    """Run some parts of an analysis on a finished run, and return the content of analysis.json.

    A part that was computed before, for the same avatar and options, is kept. Each part is written once it is done.
    """
    options.check()
    method = read_run_config(run_dir)["method"]["kind"]
    if method != analysis.method:
        raise UserError(
            f"{run_dir}: is a run of {method}, not of {analysis.method}; choose a run of {analysis.method} with "
            f"--run NAME, or train one with `mien train --method {analysis.method}`"
        )
    read_training_summary(run_dir)
    check_tree(run_dir)
    check_tree(folder)
    record = folder / "analysis.json"
    with hold(folder):
        folder.mkdir(parents=True, exist_ok=True)
        avatar = file_digest(run_dir / "avatar" / "avatar.safetensors")
        content = {
            "run": run_dir.name, "method": analysis.method, "paper": analysis.paper, "avatar": avatar,
            "parts": _known(record, analysis, avatar), "mien": mien.__version__, "command_line": sys.argv,
        }  # fmt: skip
        context = Context(run_dir, tuple(sequence_dirs), like_on(choose_device(options.device)), folder, options)
        for part in parts:
            timed = [options.seconds, _native.thread_count()] if part.timed else None
            device = context.like.device.type if part.timed or part.trains else None
            trained = [options.steps, options.widen] if part.trains else None
            key = _digest_of([part.name, avatar, trained, timed, device])
            if content["parts"].get(part.name, {}).get("key") == key:
                say(f"{part.name}: measured before")
            else:
                run = named(f"mien.lab.analysis.{analysis.method}:{part.name.replace('-', '_')}")
                content["parts"][part.name] = {"key": key, **json.loads(json.dumps(run(context).write(folder)))}
                write_json(record, _FORMAT, _VERSION, content)
            for finding in content["parts"][part.name]["findings"]:
                say(f"{part.name}: {finding}")
        shown = [one for one in analysis.parts if one.name in content["parts"]]
        page = render(
            "lab/analysis/templates/analysis.html", title=f"{run_dir.name} · {analysis.method}", paper=analysis.paper,
            version=mien.__version__, command=shlex.join(["mien", *sys.argv[1:]]),
            sections=[section_html(one.title, content["parts"][one.name], folder) for one in shown],
        )  # fmt: skip
        write_json(record, _FORMAT, _VERSION, content)
        write_atomically(folder / "analysis.html", lambda aside: aside.write_text(page, encoding="utf-8"))
    return content


def _known(record: Path, analysis: Analysis, avatar: str) -> dict[str, Any]:
    """The parts of this avatar that were computed before, and whose files are all there."""
    if not record.is_file():
        return {}
    content, folder, found = read_json(record, _FORMAT, _VERSION, remedy=_REMEDY), record.parent, {}
    with expect_whole(record, _REMEDY):
        if (content["method"], content["avatar"]) != (analysis.method, avatar):
            return {}
        for part in (one.name for one in analysis.parts if one.name in content["parts"]):
            own = content["parts"][part]
            files = [entry["file"] for kind in ("charts", "pictures", "films") for entry in own[kind]]
            if all(inside(folder, file).is_file() for file in files):
                section_html(part, own, folder)  # stumbles over whatever is damaged
                found[part] = own
    return found


def _digest_of(key: Any) -> str:
    """A hash of json, of this version of mien and of the instruction set, as hex digits."""
    text = json.dumps([key, mien.__version__, _native.rasterize_isa()], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
