"""A run's folder: config.json, avatar/, checkpoints/, curves, coverage and face_track (safetensors), training.json."""

import hashlib
import json
import re
import sys
from collections.abc import Mapping
from collections.abc import Sequence as Items
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

import mien
from mien.avatar.avatar import Avatar
from mien.avatar.baking import measure_filmed
from mien.avatar.files import write_avatar
from mien.avatar.methods import method_of
from mien.avatar.settings import MethodConfig
from mien.camera import Camera
from mien.disk.config import encode
from mien.disk.files import read_json, read_tensors, write_json, write_tensors
from mien.disk.locks import WAIT, check_free
from mien.disk.reading import check_tree, expect_whole, is_plain_name
from mien.errors import UserError
from mien.face.checks import check_face_params
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.training.checkpoint import CURVES, TrainingState
from mien.training.colors import GAINS
from mien.training.footage.coverage import Coverage
from mien.training.footage.filmed import write_coverage
from mien.training.footage.sequence import Sequence
from mien.training.settings import PRESETS, TrainSettings

if TYPE_CHECKING:
    from mien.runtime.baked import Filmed
    from mien.tracking.tracking import Tracking

_FORMAT, _VERSION = "mien.run", 1
_SUMMARY = "mien.training"
_REMEDY = "put a copy back, or train again under another name (--run NAME); the run's folder holds the trained avatar"
_AGAIN = "delete the run's training.json and run the same `mien train` again, which continues from the last checkpoint"
BUSY_REMEDY = f"{WAIT}, or give this run another name (--run NAME)"
"""Remedy if another process is training the run."""
_TRACK = "face_track.safetensors"
_IMPORTED = "imported"
"""Name, in config.json, of the frames that another program trained on."""
_OTHER_NAME = "give this run another name (--run NAME) or delete it"
_FREE_TO_CHANGE = ("device", "checkpoint_every")
"""Settings that say how a run is computed, not what it computes. They may change when the run continues."""


def claim_run(run_dir: Path, sequences: Items[Sequence], method_config: MethodConfig, settings: TrainSettings) -> None:
    """Write config.json, or check that the existing one asks for the same run."""
    check_tree(run_dir)
    names = [sequence.name for sequence in sequences]
    if check_run(run_dir, method_config, settings, names):
        check_data(run_dir, {sequence.name: sequence.tracking for sequence in sequences})
        return
    content = {
        **_choices(method_config, settings),
        "data": [_fingerprint(sequence) for sequence in sequences],
        "mien": mien.__version__,
        "command_line": sys.argv,
    }
    write_json(run_dir / "config.json", _FORMAT, _VERSION, content)


def check_run(
    run_dir: Path, method_config: MethodConfig, settings: TrainSettings, names: Items[str] | None = None
) -> bool:
    """Whether the folder already holds a run. If so, check that it has these choices (and sequences)."""
    if not (run_dir / "config.json").is_file():
        return False
    found = read_run_config(run_dir)
    choices = json.loads(json.dumps(_choices(method_config, settings)))
    different = sorted(_differences({name: found[name] for name in choices}, choices))
    if different:
        raise UserError(f"{run_dir}: holds a run with other {', '.join(different[:5])}; {_OTHER_NAME}")
    trained = [entry["sequence"] for entry in found["data"]]
    if names is not None and trained != list(names):
        raise _of_others(run_dir, trained, names)
    return True


def check_videos(run_dir: Path, names: Items[str], known: Items[str]) -> None:
    """Check that a run was trained on the captures of these videos, before they are captured.

    A video with cuts becomes NAME-1, NAME-2, ... Sequences of the workspace that are `known` may be left out of a run.
    """
    if not (run_dir / "config.json").is_file():
        return
    trained = [entry["sequence"] for entry in read_run_config(run_dir)["data"]]
    of = {sequence: name for name in names for sequence in (*trained, *known) if is_part_of(sequence, name)}
    if not all(sequence in of for sequence in trained) or not set(names) <= set(of.values()):
        raise _of_others(run_dir, trained, names)


def _of_others(run_dir: Path, trained: Items[str], names: Items[str]) -> UserError:
    return UserError(f"{run_dir}: was trained on {', '.join(trained)}, not on {', '.join(names)}; {_OTHER_NAME}")


def is_part_of(sequence: str, name: str) -> bool:
    """Whether a sequence is called as a video, or as one of its parts NAME-1, NAME-2, ..."""
    return sequence == name or re.fullmatch(re.escape(name) + r"-\d+", sequence) is not None


def check_data(run_dir: Path, trackings: "Mapping[str, Tracking]") -> None:
    """Check that sequences were not tracked again since a run was trained on them."""
    outdated = outdated_sequences(run_dir, trackings)
    if outdated:
        raise UserError(
            f"{run_dir}: {', '.join(outdated)} was tracked again after this run was trained; train a new one "
            "(`mien train DIR --run NAME`), or delete this one first"
        )


def outdated_sequences(run_dir: Path, trackings: "Mapping[str, Tracking]") -> list[str]:
    """Names of the sequences among `trackings` (by name) whose tracking is not the one that the run was trained on."""
    data = read_run_config(run_dir)["data"]
    known = [entry for entry in data if entry["sequence"] in trackings]
    return [e["sequence"] for e in known if e.get("tracking") != _tracking_digest(trackings[e["sequence"]])]


def read_run_config(run_dir: Path) -> dict[str, Any]:
    """The content of config.json: method, settings, data, mien (version) and command_line."""
    path = run_dir / "config.json"
    content = read_json(path, _FORMAT, _VERSION, remedy=_REMEDY)
    with expect_whole(path, _REMEDY):
        if not all(is_plain_name(entry["sequence"]) for entry in content["data"]):
            raise ValueError("the name of a sequence is not a plain one")
    return content


def run_camera(run_dir: Path) -> Camera:
    """The first camera that the run was trained with."""
    config = read_run_config(run_dir)
    with expect_whole(run_dir / "config.json", _REMEDY):
        stored = config["data"][0]["camera"]
        K, viewmat = (torch.tensor(stored[name], dtype=torch.float32) for name in ("K", "viewmat"))
        if (K.shape, viewmat.shape) != ((3, 3), (4, 4)):
            raise ValueError("the camera's K and viewmat are not 3x3 and 4x4")
        return Camera(K, viewmat, stored["width"], stored["height"])


def read_face_track(run_dir: Path, face_model: FaceModel) -> FaceParams:
    """The face parameters at the end of training: all timesteps of all sequences, one sequence after the other."""
    path = run_dir / _TRACK
    tensors = read_tensors(path, "`mien train`")
    with expect_whole(path, "train it again"):
        face = FaceParams(**tensors)
    check_face_params(face_model, face, str(path), "train it again")
    return face


def filmed_range(run_dir: Path, avatar: Avatar) -> "Filmed":
    """What training saw of the face. If an avatar does not say: all timesteps of the run, seen by its first camera."""
    if avatar.filmed is not None:
        return avatar.filmed
    face = read_face_track(run_dir, avatar.face_model)
    return measure_filmed(face, run_camera(run_dir).position.expand(len(face), 3))


def write_imported_run(run_dir: Path, avatar: Avatar, face: FaceParams, camera: Camera, source: Path) -> None:
    """Write a run around an avatar that another program trained. It can be rendered, driven and exported."""
    content = {
        **_choices(avatar.config, replace(PRESETS["paper"].settings, steps=0)),
        "data": [{"sequence": _IMPORTED, "timesteps": len(face), "camera": _camera_entry(camera)}],
        "imported_from": str(source.absolute()),
        "mien": mien.__version__,
        "command_line": sys.argv,
    }
    write_avatar(run_dir / "avatar", avatar)
    write_tensors(run_dir / _TRACK, face.tensors())
    write_json(run_dir / "config.json", _FORMAT, _VERSION, content)


def is_finished(run_dir: Path) -> bool:
    """Whether the run was trained to its end."""
    return (run_dir / "training.json").is_file()


def check_untouched(run_dir: Path) -> None:
    """Check before any work that no other process is training this run, or raise `BeingWrittenError`."""
    if not is_finished(run_dir):
        check_free(run_dir, BUSY_REMEDY)


def write_results(run_dir: Path, state: TrainingState, covered: Coverage) -> None:
    """Write everything that is kept after training. training.json is last and marks the run as finished."""
    write_avatar(run_dir / "avatar", state.avatar)
    write_tensors(run_dir / _TRACK, state.track.params().tensors())
    if state.gains is not None:
        write_tensors(run_dir / GAINS, {"gains": state.gains.gains().detach()})
    write_coverage(run_dir, covered)
    curves = {name: torch.tensor(curve, dtype=torch.float64) for name, curve in state.curves.items()}
    write_tensors(run_dir / "curves.safetensors", curves)
    state.measure_memory()
    summary = {
        "steps": state.step,
        "seconds": round(state.seconds, 1),
        "gaussians": len(state.avatar.store),
        "step_ms_median": round(float(np.median(state.curves["step_ms"])), 3),
        "peak_memory_mb": round(state.peak_memory_mb, 1),
        **({"gpu_memory_mb": round(state.gpu_memory_mb, 1)} if state.gpu_memory_mb else {}),
    }
    write_json(run_dir / "training.json", _SUMMARY, _VERSION, summary)


def read_training_summary(run_dir: Path) -> dict[str, Any]:
    """`steps, seconds, gaussians, step_ms_median, peak_memory_mb` of a finished run; on a GPU also `gpu_memory_mb`."""
    if (run_dir / "config.json").is_file() and not is_finished(run_dir):
        raise UserError(
            f"{run_dir}: its training was not finished; run the same `mien train` or `mien create` again, which goes "
            "on from its last checkpoint"
        )
    content = read_json(run_dir / "training.json", _SUMMARY, _VERSION, "`mien train`", _AGAIN)
    return {name: value for name, value in content.items() if name not in ("format", "version")}


def read_curves(run_dir: Path) -> dict[str, np.ndarray]:
    """The curves of a finished run, all of one length: step, loss, psnr, gaussians, step_ms, and each loss by name."""
    path = run_dir / "curves.safetensors"
    curves = {name: curve.numpy() for name, curve in read_tensors(path, remedy=_AGAIN).items()}
    with expect_whole(path, _AGAIN):
        np.stack([curves[name] for name in (*CURVES, *curves)])  # of one length, and complete
    return curves


def _choices(method_config: MethodConfig, settings: TrainSettings) -> dict[str, Any]:
    return {
        "method": {**encode(method_config), "kind": method_of(method_config)},
        "settings": encode(settings),
    }


def _fingerprint(sequence: Sequence) -> dict[str, Any]:
    """The source and the tracking of a sequence, which distinguish it from others."""
    return {
        "sequence": sequence.name,
        "timesteps": sequence.capture.timesteps,
        "camera_ids": list(sequence.capture.camera_ids),
        "source": encode(sequence.capture.source),
        "tracking": _tracking_digest(sequence.tracking),
        "camera": _camera_entry(sequence.tracking.cameras[0]),
    }


def _camera_entry(camera: Camera) -> dict[str, Any]:
    K, viewmat = camera.K.tolist(), camera.viewmat.tolist()
    return {"K": K, "viewmat": viewmat, "width": camera.width, "height": camera.height}


def _tracking_digest(tracking: "Tracking") -> str:
    digest = hashlib.sha256()
    for name, tensor in sorted(tracking.face.tensors().items()):
        digest.update(name.encode() + tensor.detach().numpy().tobytes())
    for camera in tracking.cameras:
        digest.update(camera.K.numpy().tobytes() + camera.viewmat.numpy().tobytes())
    return digest.hexdigest()[:16]


def _differences(found: Any, wanted: Any, name: str = "") -> set[str]:
    """Dotted names of the entries in which two json values differ, apart from those that are free to change."""
    if isinstance(found, dict) and isinstance(wanted, dict):
        names = (set(found) | set(wanted)) - set(_FREE_TO_CHANGE)
        return set().union(*(_differences(found.get(n), wanted.get(n), f"{name}.{n}".lstrip(".")) for n in names))
    return set() if found == wanted else {name}
