"""Analyses: what a method's paper measures on a trained run, beside the paper's own figures.

`spec` says what an analysis is, `registry` lists them by method, `result` holds what a part gives, and `running` runs
the parts and writes analysis.json, plots and one page. Only the package of a method knows that method.
"""

from typing import TYPE_CHECKING

from mien.lazy import lazy_names

if TYPE_CHECKING:
    from mien.lab.analysis.registry import ANALYSES
    from mien.lab.analysis.result import Chart, Film, PartResult, Picture, Table
    from mien.lab.analysis.running import run_analysis
    from mien.lab.analysis.spec import Analysis, AnalysisOptions, Part, chosen_parts
else:
    __getattr__, __dir__ = lazy_names(__name__, __file__)

__all__ = [
    "ANALYSES",
    "Analysis",
    "AnalysisOptions",
    "Chart",
    "Film",
    "Part",
    "PartResult",
    "Picture",
    "Table",
    "chosen_parts",
    "run_analysis",
]
