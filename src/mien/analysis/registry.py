"""The list of analyses, by the name that the command line takes. A new one adds one line here. Needs no torch."""

from mien.analysis.gaussian_avatars import ANALYSIS as GAUSSIAN_AVATARS

ANALYSES = {"gaussian-avatars": GAUSSIAN_AVATARS}
"""All analyses by name."""
