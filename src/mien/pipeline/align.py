"""From trackings to aligned trackings. What is aligned stays as it is."""

import hashlib
import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from mien.capture.store import read_capture
from mien.disk.files import read_tensors, write_tensors
from mien.disk.locks import hold
from mien.disk.reading import expect_whole, remove_tree
from mien.disk.workspace import Workspace
from mien.errors import UserError
from mien.face.params import FaceParams
from mien.machine.progress import say
from mien.pipeline.track import tell_outdated_runs
from mien.pipeline.train import read_together
from mien.rotation import axis_angle_from_matrix
from mien.tracking.files import read_tracking, write_tracking
from mien.tracking.tracking import Tracking
from mien.training.alignment import align
from mien.training.run import outdated_sequences
from mien.training.settings import AlignmentSettings, TrainSettings

_RECIPE = 3
"""Version of the alignment. It is raised whenever the same tracking would be aligned differently."""
_KEY = "aligned"
"""Entry of a tracking's settings that says how it was aligned."""
_BEFORE = "before_alignment.safetensors"
"""Face parameters as `mien track` left them, beside the tracking."""
_HELD_OUT = ("split", "held_out_sequences", "held_out_cameras")
"""Settings of a run that say what the template does not see."""


def run_alignment_stage(
    workspace: Workspace, names: list[str], settings: AlignmentSettings, training: TrainSettings, *, keep: bool = False
) -> None:
    """Align the tracked faces of some sequences to a quick avatar, and write the trackings again.

    What `mien track` left stays beside them, and every alignment starts from it. Trackings that are aligned with these
    settings stay as they are; with `keep`, others that are aligned stay, too, so that older runs can still be scored.
    `training` says what the run that follows holds out.
    """
    loaded, face_model = read_together(workspace, names)
    # What the result depends on beside the tracking.
    choices = {name: value for name, value in asdict(settings).items() if name != "when"} | {"seed": training.seed}
    choices |= json.loads(json.dumps({name: getattr(training, name) for name in _HELD_OUT}))
    tracked = [[sequence.name, sequence.tracking.settings.get("fingerprint")] for sequence in loaded]
    content = json.dumps([_RECIPE, tracked, choices], sort_keys=True)
    fingerprint = hashlib.sha256(content.encode()).hexdigest()[:16]
    earlier = [_aligned(sequence.tracking) for sequence in loaded]
    if all(one.get("fingerprint") == fingerprint for one in earlier):
        say(f"{', '.join(names)}: the tracking is aligned, nothing to do")
        return
    if keep and all(earlier):
        if any(one.get(name) != choices[name] for one in earlier for name in _HELD_OUT):
            say(
                f"warning: {', '.join(names)}: aligned to an avatar that held out other frames than this run; `mien "
                f"align {workspace.root}` with this --split and --hold-out aligns again"
            )
        return
    places = [workspace.sequence_dir(name) / "tracking" for name in names]
    before = [replace(one, tracking=_before(one.tracking, place)) for one, place in zip(loaded, places, strict=True)]
    folder = workspace.root / "sequences" / f".alignment-{fingerprint}"
    with hold(*(workspace.sequence_dir(name) for name in names)):
        for sequence, place in zip(loaded, places, strict=True):
            now = read_tracking(place).face.tensors()
            if not all(now[name].equal(tensor) for name, tensor in sequence.tracking.face.tensors().items()):
                raise UserError(f"{place}: was tracked again in this moment; run the same command again")
        for other in workspace.root.glob("sequences/.alignment-*"):
            if other != folder and other.is_dir():
                remove_tree(other)  # kept for another tracking or other settings
        say(f"{', '.join(names)}: frames are aligned to a quick avatar, which is trained first")
        faces = align(before, face_model, settings, training, folder)
        for sequence, place, face in zip(before, places, faces, strict=True):
            tracking = sequence.tracking
            write_tensors(place / _BEFORE, tracking.face.tensors())
            aligned = {**tracking.settings, _KEY: {"fingerprint": fingerprint, **choices}}
            write_tracking(place, replace(tracking, face=face, settings=aligned))
            turn, shift = _moved(tracking.face, face)
            say(f"{sequence.name}: aligned; heads turned by {turn:.2f} degrees and moved by {shift:.1f} mm (medians)")
        remove_tree(folder)
    tell_outdated_runs(workspace, _read_trackings(workspace, names), "the tracking before its alignment")


def one_camera(workspace: Workspace, names: list[str]) -> bool:
    """Whether each of some sequences was filmed by one camera."""
    return all(len(read_capture(workspace.sequence_dir(name) / "capture").camera_ids) == 1 for name in names)


def is_trained_on(workspace: Workspace, run: str, names: list[str]) -> bool:
    """Whether a run exists that was trained on the present trackings of some sequences."""
    run_dir = workspace.run_dir(run)
    return (run_dir / "config.json").is_file() and not outdated_sequences(run_dir, _read_trackings(workspace, names))


def _read_trackings(workspace: Workspace, names: list[str]) -> dict[str, Tracking]:
    return {name: read_tracking(workspace.sequence_dir(name) / "tracking") for name in names}


def _aligned(tracking: Tracking) -> dict[str, Any]:
    """How a tracking was aligned. It is empty if it was not."""
    aligned = tracking.settings.get(_KEY)
    return aligned if isinstance(aligned, dict) else {}


def _before(tracking: Tracking, place: Path) -> Tracking:
    """The tracking before any alignment."""
    if not _aligned(tracking):
        return tracking
    path, remedy = place / _BEFORE, "`mien track --again`"
    tensors, now = read_tensors(path, remedy), tracking.face.tensors()
    with expect_whole(path, f"run {remedy}"):
        if {name: tensor.shape for name, tensor in tensors.items()} != {name: now[name].shape for name in now}:
            raise ValueError("it does not belong to the tracking beside it")
        face = FaceParams(**tensors)
    return replace(tracking, face=face, settings={k: v for k, v in tracking.settings.items() if k != _KEY})


def _moved(before: FaceParams, after: FaceParams) -> tuple[float, float]:
    """The medians by which heads were turned, in degrees, and moved, in millimetres."""
    turned = axis_angle_from_matrix(before.T_world_head[:, :3, :3].mT @ after.T_world_head[:, :3, :3])
    shift = after.head_translation - before.head_translation
    return float(turned.norm(dim=-1).median()) * 180 / torch.pi, float(shift.norm(dim=-1).median()) * 1000
