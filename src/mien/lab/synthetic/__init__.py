"""Synthetic captures with exact ground truth: heads that are drawn instead of filmed.

The order of the files:

- `recipe` says what a capture shows; `references` are the fixed recipes that figures are measured on.
- `motion` makes the face parameters of every timestep from the recipe's script; `posing` turns them into vertices.
- `subject` builds the person on the face model: `anatomy` measures the head; `skin`, `hair`, `facial_hair` and
  `accessories` cover it; `off_model` bends it beyond the face model.
- `painter` draws the posed person with the materials of `shading` in the light of `light`. `arithmetic` has the noise
  and the ramps of all of these.
- `scene` joins them into frames; `captures` writes whole captures; `truth` stores what is known exactly.
- `detector_calibration` measures a landmark detector on drawn people.
"""

from mien.lab.synthetic.captures import (
    synthesize,
    write_synthetic_capture,
    write_synthetic_video,
)
from mien.lab.synthetic.recipe import RECIPES, Detail, Segment, SyntheticRecipe
from mien.lab.synthetic.references import REFERENCES, ReferenceCapture, reference_named
from mien.lab.synthetic.scene import SyntheticFrame, SyntheticScene
from mien.lab.synthetic.truth import Truth, read_truth, truth_of, write_truth

__all__ = [
    "RECIPES",
    "REFERENCES",
    "Detail",
    "ReferenceCapture",
    "Segment",
    "SyntheticFrame",
    "SyntheticRecipe",
    "SyntheticScene",
    "Truth",
    "read_truth",
    "reference_named",
    "synthesize",
    "truth_of",
    "write_synthetic_capture",
    "write_synthetic_video",
    "write_truth",
]
