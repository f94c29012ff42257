from .captures import synthesize as synthesize
from .captures import write_synthetic_capture as write_synthetic_capture
from .recipe import RECIPES as RECIPES
from .references import reference_named as reference_named
from .truth import read_truth as read_truth
