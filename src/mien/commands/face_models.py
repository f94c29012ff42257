"""`mien face-models`."""

import json
from dataclasses import asdict, dataclass
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Command:
    """List the face models; with --bake, make one ready (otherwise that happens at its first use)."""

    bake: str | None = None
    """Name of a model to bake now."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print a list of objects for programs."""

    def run(self) -> None:
        """Print the table."""
        from mien.face import available_face_models, load_face_model

        if self.bake is not None:
            load_face_model(self.bake)
        rows = [asdict(info) for info in available_face_models()]
        if self.as_json:
            print(json.dumps(rows, indent=1, default=str))
            return
        for row in rows:
            print("  ".join(f"{key}: {value}" for key, value in row.items()))
