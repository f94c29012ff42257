"""The analysis of HeadGaS (Dhamo et al., ECCV 2024): the figures and the ablation table of the paper's supplement.

Needs no torch: the parts' functions are imported when they run.
"""

from mien.lab.analysis.spec import Analysis, Part

_ROOM = "mien.lab.analysis.headgas"
ANALYSIS = Analysis(
    method="headgas",
    paper="HeadGaS (Dhamo et al., ECCV 2024), supplement",
    parts=(
        Part(
            "basis",
            "What the bases learned: one expression at a time, beside the mesh (Fig. 1)",
            f"{_ROOM}.basis:basis",
        ),
        Part("layers", "Gaussians removed from near to far (Fig. 2)", f"{_ROOM}.layers:layers"),
        Part("beyond", "Beyond the expressions and the views of training (Fig. 3)", f"{_ROOM}.beyond:beyond"),
        Part(
            "sizes",
            "Time of a frame against the size of the picture (Fig. 4)",
            f"{_ROOM}.sizes:sizes",
            ("seconds",),
            timed=True,
        ),
        Part(
            "ablations",
            "The ablations, trained alike (Table 1)",
            f"{_ROOM}.ablations:ablations",
            ("steps", "seconds"),
            timed=True,
            trainings=6,
        ),
    ),
    about_parts="basis (one expression at a time, beside the mesh), layers (Gaussians removed from near to far), "
    "beyond (an expression to 1.4 times its training maximum, and views beyond those of training), sizes (time of a "
    "frame against the size of the picture), ablations (a short training for each variant of the paper)",
)
"""The parts, in the order of the page."""
