"""The list of analyses, by the name that the command line takes. A new one adds one line here. Needs no torch."""

from mien.lab.analysis.gaussian_avatars import ANALYSIS as GAUSSIAN_AVATARS
from mien.lab.analysis.headgas import ANALYSIS as HEADGAS
from mien.lab.analysis.mono_gaussian_avatar import ANALYSIS as MONO_GAUSSIAN_AVATAR

ANALYSES = {one.method.replace("_", "-"): one for one in (GAUSSIAN_AVATARS, HEADGAS, MONO_GAUSSIAN_AVATAR)}
"""All analyses by the names of their methods, as `mien analyze` takes them."""
