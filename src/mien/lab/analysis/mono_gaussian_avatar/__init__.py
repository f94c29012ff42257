"""The analysis of MonoGaussianAvatar (Chen et al., SIGGRAPH 2024): experiments of the paper and of its supplement.

Needs no torch: the parts' functions are imported when they run.
"""

from mien.lab.analysis.spec import Analysis, Part

_ROOM = "mien.lab.analysis.mono_gaussian_avatar"
ANALYSIS = Analysis(
    method="mono_gaussian_avatar",
    paper="MonoGaussianAvatar (Chen et al., SIGGRAPH 2024), supplement",
    parts=(
        Part("times", "Time of training and of a frame (Table 4)", f"{_ROOM}.times:times", ("seconds",), timed=True),
        Part(
            "convergence",
            "Held-out pictures during a training (Fig. 13)",
            f"{_ROOM}.convergence:convergence",
            ("steps",),
            trainings=1,
        ),
        Part(
            "resolutions",
            "Training at two resolutions (A.1)",
            f"{_ROOM}.compared:resolutions",
            ("steps",),
            trainings=2,
        ),
        Part(
            "diversity",
            "Fewer and less varied frames (A.4)",
            f"{_ROOM}.compared:diversity",
            ("steps",),
            trainings=3,
        ),
    ),
    about_parts="times (of the training, and of a frame with networks and baked), convergence (held-out pictures "
    "during a short training), resolutions (short trainings at full and at half resolution), diversity (short "
    "trainings on all frames, on a frontal quarter and on a mixed half)",
)
"""The parts, in the order of the page."""
