"""Signatures of drawn scenes: numbers that are nearly the same on every processor, and differ between recipes.

Pixels differ between processors by a grey level here and there, since `exp`, `sin` and OpenCV's filters may round their
last bit differently. So a capture is identified by its key, and the signature checks that two machines draw the same.

`python tests/reference_signatures.py` rewrites the file with those of tiny versions of the reference captures."""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mien.lab.synthetic.references import REFERENCES, ReferenceCapture
from mien.lab.synthetic.scene import SyntheticScene
from mien.lab.synthetic.truth import surface_of

_FILE = Path(__file__).with_suffix(".json")
_BLOCKS = 4
"""Blocks along each side of a picture."""
_LANDMARKS = (1, 10, 33, 61, 133, 152, 234, 263, 291, 362, 454, 468, 473)
"""Landmarks in the signature: nose, forehead, eyes, mouth, chin, sides, irises."""
_VERTICES = 24
"""Number of vertices in the signature, evenly spread over the indices of the face region."""
TOLERANCES: Mapping[str, float] = {"means": 0.05, "spreads": 0.05, "mattes": 0.05, "landmarks": 0.07, "vertices": 0.015}
"""Largest allowed difference of a number: grey levels (0..255) for pictures and mattes, pixels, millimetres.

docs/reference_captures.md has the measurements behind them. The truth is rounded to a sixteenth of a pixel and to 0.01
mm; one such step is allowed."""


def signature_of(scene: SyntheticScene) -> dict[str, list[float]]:
    """Return the means and standard deviations of picture blocks, the means of matte blocks, landmarks and vertices.
    The pictures are those of the first, middle and last timestep from the first and the last camera. The parts are flat
    lists in grey levels, pixels and millimetres."""
    timesteps = sorted({0, scene.timesteps // 2, scene.timesteps - 1})
    cameras = sorted({0, len(scene.cameras) - 1})
    frames = [frame for step in timesteps for frame in scene.timestep_frames(step, cameras)]
    images, mattes = (np.stack([getattr(frame, part) for frame in frames]) for part in ("image", "matte"))
    index, vertices, landmarks = surface_of(scene)
    vertices = vertices[timesteps][:, np.linspace(0, len(index) - 1, _VERTICES).astype(int)]
    parts = {
        "means": _blocks(images).mean((2, 4)), "spreads": _blocks(images).std((2, 4)),
        "mattes": _blocks(mattes[..., None]).mean((2, 4)),
        "landmarks": landmarks[timesteps][:, cameras][:, :, list(_LANDMARKS)], "vertices": 1000 * vertices,
    }  # fmt: skip
    return {name: np.round(values.astype(np.float64), 3).ravel().tolist() for name, values in parts.items()}


def signature_distance(first: Mapping[str, list[float]], second: Mapping[str, list[float]]) -> dict[str, float]:
    """Return the largest difference of each part in units of its tolerance. Above 1, the drawings differ."""
    if {name: len(values) for name, values in first.items()} != {name: len(values) for name, values in second.items()}:
        return dict.fromkeys(TOLERANCES, float("inf"))
    return {
        name: float(np.abs(np.subtract(first[name], second[name])).max()) / tolerance
        for name, tolerance in TOLERANCES.items()
    }


def _blocks(pictures: np.ndarray) -> Float[np.ndarray, "n b y d x c"]:
    """Cut pictures into blocks. Rows and columns beyond the last whole block are dropped."""
    n, height, width, channels = pictures.shape
    y, x = height // _BLOCKS, width // _BLOCKS
    cut = pictures[:, : y * _BLOCKS, : x * _BLOCKS].astype(np.float64)
    return cut.reshape(n, _BLOCKS, y, _BLOCKS, x, channels)


def stored_signatures() -> dict[str, dict[str, dict[str, list[float]]]]:
    """Return the stored signatures by reference, sequence and part."""
    return json.loads(_FILE.read_text(encoding="utf-8"))


def tiny(reference: ReferenceCapture) -> ReferenceCapture:
    """Return the same people and motions in three frames of 64x64 pixels from at most three cameras."""
    size = {"width": 64, "height": 64, "texture_size": 128, "supersample": 1, "ring_size": 3}
    small = [
        replace(recipe, **size, fps=3 / sum(segment.seconds for segment in recipe.script))
        for recipe in reference.sequences
    ]
    views = None if reference.views is None else replace(reference.views, first=1, every=1)
    # Posed faces are drawn by what draws the sequences.
    return replace(reference, sequences=tuple(small), views=views, unfilmed=False)


def drawn_signatures(reference: ReferenceCapture) -> dict[str, dict[str, list[float]]]:
    """Return the signatures by sequence and part, as this machine draws them."""
    return {scene.recipe.name: signature_of(scene) for scene in tiny(reference).scenes()}


if __name__ == "__main__":
    drawn = {name: drawn_signatures(reference) for name, reference in REFERENCES.items()}
    _FILE.write_text(json.dumps(drawn, separators=(",", ":")).replace('},"', '},\n"') + "\n", encoding="utf-8")
