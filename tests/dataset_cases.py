"""Cases of the fuzzer of datasets: a small dataset of each layout, one fault in it, and what may come of that.
A case is a layout and a number; the number decides the fault and the way in which the dataset is read."""

import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

import dataset_layouts as layouts
import dataset_writers as writers
from capture_helpers import tree_bytes
from dataset_scene import NoDetector, Scene, scene_of, unfound
from flame_like import write_npz
from fuzzing.dataset_faults import faulty_dataset
from fuzzing.faults import Place, faulty_file, faulty_place
from fuzzing.material import tiny_flame
from mien.capture import read_capture
from mien.capture.cameras.calibration import read_calibration
from mien.capture.settings import CaptureSettings
from mien.cli import main
from mien.datasets import overlay, pictures, sequences
from mien.datasets.dataset import Footage
from mien.datasets.registry import datasets
from mien.datasets.writing import write_sequence
from mien.disk.limits import camera_fault
from mien.disk.workspace import Workspace
from mien.errors import UserError
from mien.face import FaceModel
from mien.face.loading import add_face_model, coefficient_head
from mien.face.model import Landmarks
from mien.face.models.flame import flame_face_model, read_flame
from mien.media.video import read_video_frames, write_video
from mien.pipeline import import_dataset as import_footage
from mien.pipeline.import_dataset import run_import_stage
from mien.training import read_sequence
from mien.training.settings.splits import read_own_split
from shared_things import write_toy_workspace

SIDE = 32
_BY_COMMAND, _RETRACKED = 5, 7
"""One of so many cases is run as the command `mien import`, the others as the functions that it calls; and one of so
many leaves the authors' tracking out."""
_MOST_SECONDS = 60
_LONGEST_LINE = 1000
_LARGEST = 1e3
"""Largest distance of a vertex from the middle of an imported head, in metres."""

COEFFICIENTS = "nerf-blendshape, on its coefficients"


def _film(path: Path, _: str = "") -> None:
    write_video(path, iter(np.full((3, SIDE, SIDE, 3), 90, np.uint8)), 25.0)


def _write_avatar(folder: Path, _: Scene) -> Path:
    workspace = folder.with_name("toy")
    write_toy_workspace(workspace)
    assert main(["export", str(workspace), "--out", str(folder), "--format", "gaussian-avatars"]) == 0
    return folder


LAYOUTS: dict[str, Callable[[Path, Scene], Path]] = {
    "insta": partial(writers.write_insta, held_out=2),
    "insta, without checkpoints": partial(writers.write_insta, checkpoints=False),
    "flash-avatar": writers.write_flash_avatar,
    "metrical-tracker": layouts.write_tracker_output,
    "insta, image_mask": layouts.write_masked,
    "insta, images.HQ": layouts.write_larger,
    "imavatar": writers.write_imavatar,
    "vhap": writers.write_vhap,
    "nerface": writers.write_nerface,
    "nerf-blendshape": writers.write_nerf_blendshape,
    COEFFICIENTS: partial(writers.write_nerf_blendshape, scale=7.0, detected=True),
    "nersemble-benchmark": writers.write_benchmark,
    "nersemble-benchmark, novel views": partial(writers.write_benchmark, serials=("7", writers.FRONTAL), tracked=False),
    "nersemble": lambda folder, scene: writers.write_nersemble(
        folder, film=_film, colors=dict.fromkeys(("222200036", writers.FRONTAL), np.eye(3, 11))
    ),
    "live-link-face": lambda folder, scene: writers.write_take(folder, film=_film),
    "gaussian-avatars": _write_avatar,
}


def make_quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(overlay, "LandmarkDetector", NoDetector)
    monkeypatch.setattr(sequences, "detected_landmarks", unfound)
    monkeypatch.setattr(pictures, "fill_mattes", lambda images, mattes, plate=None: mattes.fill(255))
    monkeypatch.setattr(import_footage, "capture_video", _film_is_read)
    monkeypatch.setattr(import_footage, "capture_cameras", _rig_is_read)
    layouts.draw_at(SIDE / writers.SIDE, monkeypatch)


def _film_is_read(video: Path, out: Path, *_: Any) -> None:
    """Read a video in place of the capture, whose own fuzzer is `tests/fuzzing`."""
    assert "canary" not in str(video.resolve()), "a link that leads out of the dataset"
    next(read_video_frames(video))
    out.mkdir(parents=True)


def _rig_is_read(videos: list[Path], calibration: Path, out: Path, name: str, settings: CaptureSettings) -> None:
    assert len(read_calibration(calibration)) == len(videos)
    for plate in [] if settings.clean_plate is None else sorted(settings.clean_plate.iterdir()):
        assert "canary" not in str(plate.resolve()), "a link that leads out of the dataset"
    for video in videos:
        _film_is_read(video, out / video.stem)


def tiny_scene(folder: Path) -> Scene:
    """Return a head of 200 vertices."""
    arrays = tiny_flame()
    model = flame_face_model(read_flame(write_npz(folder / "tiny.npz", arrays)), "tiny")
    marks = Landmarks(torch.arange(478) % len(model.faces), torch.full((478, 3), 1 / 3))
    return scene_of(arrays, replace(model, landmarks={"mediapipe": marks}), 6)


def another_flame(scene: Scene, folder: Path) -> FaceModel:
    """Return a head of another version: as many vertices, with other bases and in another order."""
    arrays = {**scene.arrays, "f": (scene.arrays["f"] + 31) % len(scene.arrays["weights"])}
    arrays |= {name: np.roll(arrays[name], 31, 0) for name in ("shapedirs", "v_template", "weights")}
    arrays["shapedirs"] = 40 * arrays["shapedirs"]
    path = write_npz(folder / "other.npz", arrays)
    return replace(flame_face_model(read_flame(path), "other"), landmarks=scene.model.landmarks)


class Outcome(NamedTuple):
    """The outcome of a case: its fault, the line that refused the dataset, if any, and what the importer did wrong."""

    fault: str
    complaint: str
    wrong: str


class Campaign:
    """A dataset of one layout, and the cases that damage copies of it."""

    def __init__(self, layout: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        """Write the dataset into an empty folder, and import it whole, on its tracking and without."""
        self.layout, self.folder, self.capsys = layout, folder, capsys
        scene = tiny_scene(folder)
        self.models = {model.name: model for model in (scene.model, another_flame(scene, folder))}
        for model in self.models.values():
            add_face_model(model, Path("tiny.npz"), "0")
        if layout == COEFFICIENTS:
            self.models["tiny"] = coefficient_head(scene.model, 46)
        self.material = LAYOUTS[layout](folder / "material", scene)
        for name, retrack in (("whole", False), ("pictures", True)):
            self.use(self.material, "tiny", folder / name, retrack)
            self.check_written(folder / name)

    def run(self, number: int) -> Outcome:
        dice = Random(f"{self.layout} {number}")
        root, out, canary = (self.folder / f"{name}{number}" for name in ("case", "out", "canary"))
        shutil.copytree(self.material, root)
        canary.mkdir()
        (canary / "file").write_text("a secret")
        fault = one_fault(root, canary, dice)
        name = "other" if dice.random() < 0.1 else "tiny"
        retrack = dice.randrange(_RETRACKED) == 0
        # The command would take anny's head for coefficients, and bake it.
        by_command = dice.randrange(_BY_COMMAND) == 0 and self.layout != COEFFICIENTS and not retrack
        before = tree_bytes(canary)  # some faults move the file there
        around = {each.name for each in self.folder.iterdir()}
        complaint, wrong, start = "", "", time.process_time()
        try:
            if by_command:
                options = [] if self.layout == "gaussian-avatars" else ["--face-model", name]
                complaint = self.complaint_of(["import", str(root), "--out", str(out), *options])
            else:
                self.use(root, name, out, retrack)
        except UserError as error:
            complaint = str(error).partition(" (Type-check error")[0]  # tests check types at run time, users do not
        except Exception as error:
            wrong = f"{type(error).__name__}: {error}"
        seconds = time.process_time() - start
        if not wrong:
            wrong = self.fault_of(complaint, out, {*around, out.name}, seconds)
        if tree_bytes(canary) != before:
            wrong = "files outside of the dataset changed"
        for place in (root, self.folder / f"{root.name}-aside", canary, out):
            shutil.rmtree(place, ignore_errors=True)
        return Outcome(fault, complaint, wrong)

    def fault_of(self, complaint: str, out: Path, around: set[str], seconds: float) -> str:
        """Return what must not be about a case that raised nothing else than complaints."""
        if "\n" in complaint or len(complaint) > _LONGEST_LINE:
            return f"a complaint of several lines, or a long one: {complaint[:3000]!r}"
        if seconds > _MOST_SECONDS:
            return f"took {seconds:.0f} s of the processor"
        more = {each.name for each in self.folder.iterdir()} - around
        if more:
            return f"wrote beside the output: {sorted(more)}"
        try:
            self.check_written(out)
        except Exception as error:
            return f"wrote what cannot be used: {type(error).__name__}: {error}"
        return ""

    def complaint_of(self, command: list[str]) -> str:
        """Run a command, and return its complaint without its beginning; nothing if it succeeds."""
        self.capsys.readouterr()
        code = main(command)
        told = self.capsys.readouterr().err
        lines = [line for line in told.splitlines() if line.startswith("mien: ")]
        assert "Traceback" not in told
        assert (code, len(lines)) in ((0, 0), (2, 1)), (code, told)
        return "".join(lines).removeprefix("mien: ")

    def use(self, path: Path, model: str, out: Path, retrack: bool) -> None:
        """Read and write a dataset as `mien import` does.

        Raises:
            UserError: it is damaged."""
        known = [each for each in datasets() if each.recognises(path) is not None]
        if not known:
            raise UserError(f"{path}: is no dataset")
        assert len(known) == 1, [each.name for each in known]
        if known[0].holds == "avatar":
            run_import_stage(known[0], path, Workspace(out), "a", None)
            return
        assert known[0].survey is not None
        known[0].survey(path)
        pictures = known[0].read_pictures if retrack else None
        for sequence in known[0].read(path, self.models[model]) if pictures is None else pictures(path):  # type: ignore[union-attr]
            if isinstance(sequence, Footage):
                import_footage.write_footage(out / "sequences" / sequence.name, sequence, known[0], path)
            else:
                write_sequence(out / "sequences" / sequence.capture.name, sequence, known[0], path)
                read_own_split(out / "sequences" / sequence.capture.name)

    def check_written(self, out: Path) -> None:
        """Check that each sequence of a workspace is whole: cameras, landmarks, and a head of a possible size."""
        left = [place.name for place in out.rglob("*") if place.name.endswith(".partial")]
        assert not left, left
        for folder in sorted(out.glob("sequences/*/")):
            if not (folder / "capture" / "capture.json").exists():
                assert self.layout in ("nersemble", "live-link-face"), "a sequence without a capture"
                continue
            capture = read_capture(folder / "capture")
            tracking = read_sequence(folder).tracking if (folder / "tracking").exists() else None
            for camera in (*(capture.calibration or ()), *(tracking.cameras if tracking else ())):
                assert camera_fault(camera.K.numpy(), camera.viewmat.numpy(), camera.width, camera.height) is None
            assert np.isfinite(capture.landmarks[capture.valid]).all()
            if tracking is None:
                continue
            model = self.models["tiny" if self.layout == COEFFICIENTS else tracking.face_model]
            vertices = model(tracking.face)
            size = (vertices - vertices.mean(1, keepdim=True)).abs().amax()
            assert bool(size < _LARGEST), f"a head of {float(size):g} m"


def one_fault(root: Path, canary: Path, dice: Random) -> str:
    """Damage a file of any kind, or make a fault with a meaning. Return what it is."""
    if dice.random() < 0.3:
        return faulty_dataset(root, canary, dice)
    file = dice.choice(sorted(each for each in root.rglob("*") if each.is_file()))
    fault = dice.choice([faulty_file, faulty_file, faulty_file, faulty_place])
    return f"{fault(Place(root, file, canary, 9), dice)}: {file.relative_to(root)}"
