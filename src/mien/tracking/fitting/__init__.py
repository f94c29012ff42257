"""What every fit shares: its input, parameters, solver, state and stored pieces."""

from mien.tracking.fitting.fit import (
    HIDING_REGIONS,
    Course,
    Fit,
    SequenceFit,
    Subject,
    Watch,
    choose_keyframes,
    fit_of,
    ignore_progress,
    smoothness_of,
    widen,
)
from mien.tracking.fitting.parameters import ParameterLayout, layout_of, pose_only
from mien.tracking.fitting.resume import StageCache
from mien.tracking.fitting.shot import Shot, explaining_singular, has_enough_faces, lenses_of, shot_of
from mien.tracking.fitting.solver import (
    Bounds,
    NormalEquations,
    SharedEquations,
    Smoothness,
    join_frames,
    join_shared,
    minimize_frames,
    place_shared,
    solve_arrow,
    solve_chain,
)
from mien.tracking.fitting.views import CameraBatch, Views, batch_of

__all__ = [
    "Bounds",
    "CameraBatch",
    "Course",
    "Fit",
    "HIDING_REGIONS",
    "NormalEquations",
    "ParameterLayout",
    "SequenceFit",
    "SharedEquations",
    "Shot",
    "Smoothness",
    "StageCache",
    "Subject",
    "Views",
    "Watch",
    "batch_of",
    "choose_keyframes",
    "explaining_singular",
    "fit_of",
    "has_enough_faces",
    "ignore_progress",
    "join_frames",
    "join_shared",
    "layout_of",
    "lenses_of",
    "minimize_frames",
    "place_shared",
    "pose_only",
    "shot_of",
    "smoothness_of",
    "solve_arrow",
    "solve_chain",
    "widen",
]
