"""Evaluation: figures, videos and a report for a trained run, and comparisons of runs."""

from mien.evaluation.evaluate import evaluate

__all__ = ["evaluate"]
