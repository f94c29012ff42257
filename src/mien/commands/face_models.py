"""`mien face-models`: the list of face models."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mien.errors import UserError
from mien.machine.terminal import show
from mien.pipeline.names import no_model_file

_ICT_MEAN = "generic_neutral_mesh.obj"
"""A file by which ICT-FaceKit's folder is recognised (`mien.face.models.ict.NEUTRAL`, without its imports)."""


@dataclass(frozen=True)
class Command:
    """List the face models. --add adds a model of your own; --bake prepares a model before its first use."""

    add: Path | None = None
    """A head model to add: in FLAME's schema (FLAME's own .pkl, or a .npz), gnm_head.npz, or ICT-FaceKit's folder
    FaceXModel. It is checked and kept with your other models, its landmarks are placed (some minutes, once), and
    --face-model accepts its name. Reading a pickle runs no code from it."""
    name: str | None = None
    """Name of the added model (default: the file's name)."""
    shareable: bool = False
    """State that the added model's licence allows avatars to carry a copy of it (FLAME's does not, FLAME Open's
    does)."""
    teeth: bool = False
    """Add the teeth of VHAP and GaussianAvatars to FLAME, which their trackings and avatars need."""
    bake: str | None = None
    """Name of a model to prepare now."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print a json list of objects, for programs."""

    def check(self) -> None:
        """Check the options without heavy libraries."""
        if self.add is None and (self.name is not None or self.shareable or self.teeth):
            raise UserError(
                "--name, --shareable and --teeth belong to a model that is added: give its file with --add FILE"
            )
        if self.add is not None and not self.add.is_file() and not (self.add / _ICT_MEAN).is_file():
            raise UserError(no_model_file(self.add))

    def run(self) -> None:
        """Add or bake a model if asked for, then print the table."""
        from mien.face.listing import OBTAINABLE, available_face_models

        if self.add is not None:
            from mien.face.cache import cache_is_kept
            from mien.pipeline.face_models import add_face_model_file

            if not cache_is_kept():
                raise UserError(
                    f"--add {self.add}: there is no folder to keep it in (no home folder, or it cannot be written to); "
                    "set MIEN_CACHE to a folder"
                )
            add_face_model_file(self.add, self.name, self.shareable, self.teeth)
        if self.bake is not None:
            from mien.face.loading import load_face_model

            load_face_model(self.bake)
        rows = [asdict(info) for info in available_face_models()]
        if self.as_json:
            show(json.dumps(rows, indent=1, default=str))
            return
        for row in rows:
            show("  ".join(f"{key}: {value}" for key, value in row.items()))
        for model in OBTAINABLE:
            if all(row["name"] != model.name for row in rows):
                show(f"not installed: {model.file}, for {model.use}; licence: {model.licence}; from {model.where}; "
                     f"add it with mien face-models --add FILE --name {model.name}{model.options}")  # fmt: skip
