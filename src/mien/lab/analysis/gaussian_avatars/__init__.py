"""The analysis of GaussianAvatars (Qian et al., CVPR 2024): the figures and tables of the paper's supplement.

Needs no torch: the parts' functions are imported when they run.
"""

from mien.lab.analysis.spec import Analysis, Part

_ROOM = "mien.lab.analysis.gaussian_avatars"
ANALYSIS = Analysis(
    method="gaussian_avatars",
    paper="GaussianAvatars (Qian et al., CVPR 2024), supplement",
    parts=(
        Part("growth", "Gaussians and step time over training (Fig. 3)", f"{_ROOM}.growth:growth"),
        Part("speed", "Drawing speed and memory (Table 3)", f"{_ROOM}.speed:speed", ("seconds",), timed=True),
        Part("teeth", "Teeth: the Gaussians on the teeth's triangles (Fig. 1)", f"{_ROOM}.teeth:teeth"),
        Part(
            "teeth-trained",
            "Teeth: trained with and without the teeth's triangles (Fig. 1)",
            f"{_ROOM}.teeth:teeth_trained",
            ("steps",),
            trainings=2,
        ),
        Part(
            "scale",
            "The threshold of the scale loss (section C)",
            f"{_ROOM}.scale:scale",
            ("steps", "seconds"),
            timed=True,
            trainings=2,
        ),
    ),
    about_parts="growth (Gaussians and step time over training), speed (drawing at five sizes, and memory), teeth "
    "(with and without the Gaussians on teeth), teeth-trained and scale (two short trainings each: without the "
    "triangles of teeth, and without the threshold of the scale loss)",
)
"""The parts, in the order of the page."""
