"""Evaluation: figures, videos and a report for a trained run, and comparisons of runs."""

from mien.evaluation.compare import compare_runs
from mien.evaluation.evaluate import evaluate
from mien.evaluation.image_folders import ImageFolders, score_folders
from mien.evaluation.metrics_file import read_metrics
from mien.evaluation.protocols import EvaluationSettings

__all__ = [
    "EvaluationSettings",
    "ImageFolders",
    "compare_runs",
    "evaluate",
    "read_metrics",
    "score_folders",
]
