"""Synthetic captures with exact ground truth: heads that are drawn instead of filmed."""

from mien.synthetic.recipe import RECIPES, Detail, Segment, SyntheticRecipe
from mien.synthetic.references import REFERENCES, ReferenceCapture, reference_named
from mien.synthetic.scene import SyntheticFrame, SyntheticScene
from mien.synthetic.synthesize import synthesize, write_synthetic_video
from mien.synthetic.truth import Truth, read_truth, truth_of, write_truth
from mien.synthetic.writing import read_synthetic_hash, write_synthetic_capture

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
    "read_synthetic_hash",
    "read_truth",
    "reference_named",
    "synthesize",
    "truth_of",
    "write_synthetic_capture",
    "write_synthetic_video",
    "write_truth",
]
