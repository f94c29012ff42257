"""From what a dataset's reader returns to a folder of a workspace, with scoring masks and fingerprints."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path

from mien.capture.store import read_capture, write_capture
from mien.datasets.content import REMEDY
from mien.datasets.dataset import Dataset, FilmedSequence, TrackedSequence
from mien.disk.files import replace_folder, write_arrays
from mien.disk.reading import remove_tree
from mien.errors import UserError
from mien.face.checks import check_face_params
from mien.tracking.files import write_tracking
from mien.tracking.report.contact_sheet import write_overlay_sheet
from mien.tracking.scoring import make_scoring
from mien.tracking.scoring_files import write_scoring
from mien.training.footage.clothes import FOREIGN
from mien.training.footage.sequence import read_sequence
from mien.training.settings.splits import write_own_split

OVERLAY = "tracking/overlay.png"
"""File in a sequence's folder: the imported mesh over some of its pictures."""


def write_sequence(folder: Path, sequence: TrackedSequence | FilmedSequence, dataset: Dataset, source: Path) -> None:
    """Write a sequence as `mien capture` leaves one, and if it is tracked, as `mien track` leaves one.

    Beside them are dataset.json, with the split of the authors, and foreign.safetensors, if there is anything for it. A
    tracked sequence has a picture of its mesh (`OVERLAY`).

    The folder appears as a whole, after its files were read back.

    `source` is the place that it was read from.
    """
    aside = folder.with_name(f".{folder.name}.partial")
    partial = aside / folder.name  # one level deeper than sequences, so that a killed import leaves none
    remove_tree(aside)
    try:
        _write_into(partial, sequence, dataset, source)
        try:
            if isinstance(sequence, TrackedSequence):
                read_sequence(partial)
            else:
                read_capture(partial / "capture")
        except UserError as error:
            fault = str(error).partition(": ")[2].split("; ")[0]  # without the path of a file that nobody will find
            raise UserError(f"{source} ({folder.name}): {fault}; {REMEDY}") from None
        replace_folder(folder, partial)
    finally:
        remove_tree(aside)


def _write_into(folder: Path, sequence: TrackedSequence | FilmedSequence, dataset: Dataset, source: Path) -> None:
    capture = sequence.capture
    imported = {"dataset": dataset.name, "from": str(source.absolute())}
    if isinstance(sequence, TrackedSequence):
        check_face_params(sequence.face_model, sequence.tracking.face, f"{source} ({capture.name})", REMEDY)
    capture_hash = write_capture(folder / "capture", capture)
    write_own_split(folder, sequence.own_split, {"imported": imported})
    if sequence.foreign:
        write_arrays(folder / FOREIGN, dict(sequence.foreign))
    if not isinstance(sequence, TrackedSequence):
        return
    tracking, face_model = sequence.tracking, sequence.face_model
    content = json.dumps([dataset.name, capture_hash, face_model.name, face_model.content_hash])
    fingerprint = hashlib.sha256(content.encode()).hexdigest()[:16]
    settings = {**tracking.settings, "imported": imported, "fingerprint": fingerprint}
    write_tracking(folder / "tracking", replace(tracking, settings=settings))
    write_overlay_sheet(folder / OVERLAY, capture, tracking, face_model)
    write_scoring(folder / "scoring", make_scoring(capture, tracking, face_model, scratch=folder), capture_hash)
