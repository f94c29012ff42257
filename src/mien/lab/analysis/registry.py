"""The list of analyses, by the name that the command line takes. A new one adds one line here. Needs no torch."""

from mien.lab.analysis.gaussian_avatars import ANALYSIS as GAUSSIAN_AVATARS
from mien.lab.analysis.headgas import ANALYSIS as HEADGAS
from mien.lab.analysis.mono_gaussian_avatar import ANALYSIS as MONO_GAUSSIAN_AVATAR

ANALYSES = {"gaussian-avatars": GAUSSIAN_AVATARS, "headgas": HEADGAS, "mono-gaussian-avatar": MONO_GAUSSIAN_AVATAR}
"""All analyses by name."""
