"""Synthetic captures with exact ground truth: heads that are drawn, not filmed."""

from mien.synthetic.recipe import RECIPES, SyntheticRecipe
from mien.synthetic.scene import SyntheticFrame, SyntheticScene
from mien.synthetic.synthesize import synthesize, write_synthetic_video

__all__ = ["RECIPES", "SyntheticFrame", "SyntheticRecipe", "SyntheticScene", "synthesize", "write_synthetic_video"]
