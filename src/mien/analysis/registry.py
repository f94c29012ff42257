"""The list of analyses, by the name that the command line takes. A new one adds one line here. Needs no torch."""

from mien.analysis.gaussian_avatars import ANALYSIS as GAUSSIAN_AVATARS
from mien.analysis.headgas import ANALYSIS as HEADGAS

ANALYSES = {"gaussian-avatars": GAUSSIAN_AVATARS, "headgas": HEADGAS}
"""All analyses by name."""
