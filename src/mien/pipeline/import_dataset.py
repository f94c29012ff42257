"""From the files of other programs to runs and sequences of a workspace."""

import json
import math
import shlex
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from mien.avatar.avatar import Avatar
from mien.camera import Camera, camera_from_fov, look_at
from mien.capture.from_cameras import capture_cameras
from mien.capture.from_video import capture_video
from mien.capture.settings import CaptureSettings
from mien.datasets.dataset import Dataset, Findings, Footage, ReadSequence, TrackedSequence, TrainedAvatar
from mien.datasets.writing import OVERLAY, write_sequence
from mien.disk.files import write_atomically
from mien.disk.locks import check_free, hold
from mien.disk.reading import inside, remove_tree
from mien.disk.workspace import Workspace
from mien.errors import UserError
from mien.machine.progress import say
from mien.machine.terminal import counted
from mien.media.color_correction import NAME as COLOR_CORRECTION
from mien.pipeline.face_models import face_model_of
from mien.pipeline.names import check_new_run, check_new_sequence
from mien.pipeline.track import run_tracking_stage
from mien.tracking.settings import TrackingSettings
from mien.training.run import BUSY_REMEDY, write_imported_run
from mien.training.settings.splits import write_own_split


def run_import_stage(
    dataset: Dataset, path: Path, workspace: Workspace, run: str, face_model: str | None, retrack: bool = False,
    resume: bool = False, corrects_colors: bool = True,
) -> None:  # fmt: skip
    """Read a dataset, and write its avatar as the run `run`, or its sequences.

    `face_model` is the name or file of the model that the files belong to. With `retrack`, the tracking of the authors
    is left out, and mien tracks the pictures. With `resume`, sequences that are there already stay as they are.
    Without `corrects_colors`, colours of videos stay as filmed.
    """
    run_dir = workspace.run_dir(run)
    if dataset.holds == "avatar":
        check_free(run_dir, BUSY_REMEDY)
    if retrack:
        assert dataset.read_pictures is not None  # the command checks it
        content: Iterable[ReadSequence] | TrainedAvatar = dataset.read_pictures(path)
    else:
        content = dataset.read(path, None if face_model is None else face_model_of(face_model))
    if isinstance(content, TrainedAvatar):
        avatar, face = content.avatar, content.face
        with hold(run_dir, remedy=BUSY_REMEDY):
            check_new_run(run_dir)  # another process may have written it meanwhile
            try:
                write_imported_run(run_dir, avatar, face, front_camera(avatar), path)
            except BaseException:
                remove_tree(run_dir)
                raise
        count = counted(len(avatar.store), "Gaussian")
        say(f"{run_dir}: {count} on {avatar.face_model.name}, {counted(len(face), 'timestep')}")
        return
    if not corrects_colors:
        content = (replace(one, color_corrections=None) if isinstance(one, Footage) else one for one in content)
    untracked = _write_sequences(content, workspace, dataset, path, resume)
    if retrack:
        run_tracking_stage(workspace, "anny", TrackingSettings())
    elif untracked:
        say(f"{', '.join(untracked)}: without a tracking; run `mien track {shlex.quote(str(workspace.root))}`")


def _write_sequences(
    sequences: Iterable[ReadSequence], workspace: Workspace, dataset: Dataset, source: Path, resume: bool
) -> list[str]:
    """Write the sequences, and return the names of those without a tracking."""
    untracked, overlays = [], []
    for sequence in sequences:
        name = sequence.name if isinstance(sequence, Footage) else sequence.capture.name
        folder = workspace.sequence_dir(name)
        with hold(folder):
            is_there = resume and folder.exists()
            if not is_there:
                check_new_sequence(folder)
                if isinstance(sequence, Footage):
                    write_footage(folder, sequence, dataset, source)
                else:
                    write_sequence(folder, sequence, dataset, source)
        if isinstance(sequence, Footage):
            untracked.append(name)
        if is_there or isinstance(sequence, Footage):
            continue
        capture = sequence.capture
        tracked = f", tracked on {sequence.face_model.name}" if isinstance(sequence, TrackedSequence) else ""
        cameras = counted(len(capture.camera_ids), "camera")
        say(f"{folder}: {counted(capture.timesteps, 'timestep')}, {cameras}{tracked}")
        if tracked:
            overlays.append(folder / OVERLAY)
        else:
            untracked.append(name)
    if overlays:
        more = f", and {len(overlays) - 1} more" * (len(overlays) > 1)
        say(f"the imported mesh over some pictures: {overlays[0]}{more}; look at it before you train")
    return untracked


@torch.no_grad()
def front_camera(avatar: Avatar) -> Camera:
    """A camera 1.2 m in front of the person at rest that shows the whole mesh."""
    subject, distance, side = avatar.subject, 1.2, 512
    vertices = avatar.face_model.head_vertices(subject)[0]
    middle, pose = (vertices.amin(0) + vertices.amax(0)) / 2, subject.T_world_head[0]
    in_front = middle + torch.tensor([0.0, 0.0, distance])
    position, target = (pose[:3, :3] @ point + pose[:3, 3] for point in (in_front, middle))
    extent = 1.15 * float((vertices.amax(0) - vertices.amin(0)).max())  # with a margin
    view = look_at(position, target, pose[:3, 1])
    return camera_from_fov(2 * math.atan(0.5 * extent / distance), side, side, view)


def write_footage(folder: Path, footage: Footage, dataset: Dataset, source: Path) -> None:
    """Capture the videos of a sequence into its missing folder, and write what else the dataset has beside it."""
    settings = CaptureSettings(stride=footage.stride)
    try:
        if footage.cameras is None:
            capture_video(footage.videos[0], folder / "capture", settings, footage.name)
        else:
            _capture_rig(folder / "capture", footage, footage.cameras, source)
        imported = {"dataset": dataset.name, "from": str(source.absolute())}
        write_own_split(folder, footage.own_split, {"imported": imported})
        for name, content in footage.files.items():
            write_atomically(inside(folder, name), lambda place, content=content: place.write_bytes(content))
    except BaseException:
        remove_tree(folder)
        raise


def _capture_rig(out: Path, footage: Footage, cameras: Mapping[str, Camera], source: Path) -> None:
    """Capture calibrated videos. They get the names of their cameras by links, which the capture expects.

    Complaints about a link or the calibration name what the user knows instead.
    """
    corrections = None if footage.color_corrections is None else footage.color_corrections()
    with tempfile.TemporaryDirectory(prefix="mien-import-") as name:
        place = Path(name)
        videos, known = [], {}
        for camera_id, video in zip(cameras, footage.videos, strict=True):
            videos.append(place / f"{camera_id}{video.suffix}")
            videos[-1].symlink_to(video.resolve())
            known[str(videos[-1])] = str(video)
        plates = None
        if footage.clean_plates is not None:
            plates = place / "plates"
            plates.mkdir()
            for camera_id, plate in footage.clean_plates.items():
                link = plates / f"{camera_id}{plate.suffix}"
                link.symlink_to(plate.resolve())
                known[f"--capture.clean-plate {link}"] = known[str(link)] = str(plate)
        calibration = place / "cameras.json"
        entries: list[dict[str, Any]] = [
            {"id": camera_id, "K": camera.K.double().tolist(), "viewmat": camera.viewmat.double().tolist(),
             "width": camera.width, "height": camera.height}
            for camera_id, camera in cameras.items()
        ]  # fmt: skip
        for entry, (camera_id, matrix) in zip(entries, corrections.items(), strict=True) if corrections else ():
            assert entry["id"] == camera_id
            entry[COLOR_CORRECTION] = matrix.tolist()
        calibration.write_text(json.dumps({"format": "mien.cameras", "version": 1, "cameras": entries}))
        settings = CaptureSettings(stride=footage.stride, clean_plate=plates)
        try:
            capture_cameras(videos, calibration, out, footage.name, settings)
        except UserError as error:
            if str(place) not in str(error):
                raise
            told = str(error)
            for link, file in {**known, str(calibration): f"{source} (its cameras)"}.items():
                told = told.replace(link, file)
            raise UserError(told) from None


def findings_lines(findings: Findings, face_model_is_given: bool = True, corrects_colors: bool = True) -> list[str]:
    """Return the sequences, the face model, the split, the colours and what is missing, a line each."""
    clips, most = findings.clips, 12
    lines = [f"  one person, {counted(len(clips), 'sequence')}"]
    for clip in clips[:most]:
        frames = "as many frames as its videos" if clip.frames is None else counted(clip.frames, "frame")
        lines.append(f"  {clip.name}: {frames}, {counted(clip.cameras, 'camera')}")
    if len(clips) > most:
        lines.append(f"  and {counted(len(clips) - most, 'more sequence')}")
    remedy = "" if face_model_is_given or findings.face_model is None else "; give yours with --face-model"
    lines.append(f"  face model: {findings.face_model or 'none, or none that can be used'}{remedy}")
    lines.append(f"  split: {findings.split or 'none'}")
    if findings.color_correction is not None:
        told = findings.color_correction if corrects_colors else "left out (--no-color-correction)"
        lines.append(f"  colour correction: {told}")
    return lines + [f"  missing or not used: {each}" for each in findings.missing]
