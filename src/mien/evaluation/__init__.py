"""Evaluation: figures and a report for a trained run, and driving avatars."""

from mien.evaluation.cameras import orbit, turntable
from mien.evaluation.driving import drive
from mien.evaluation.evaluate import evaluate, read_metrics
from mien.evaluation.protocols import EvaluationSettings

__all__ = ["EvaluationSettings", "drive", "evaluate", "orbit", "read_metrics", "turntable"]
