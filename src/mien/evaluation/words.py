"""Figures as lines of text for people."""

from collections.abc import Mapping
from typing import Any

NAMES = {"mean_frame": "mean training picture", "mesh": "coloured mesh"}
FACES = {"corrected": "corrected", "as_tracked": "as tracked"}
"""Names for the source of held-out face parameters: tracking with corrections from training, or tracking alone."""


def protocol_line(name: str, entry: Mapping[str, Any]) -> str:
    """A protocol of metrics.json in one line: the PSNR figures of the avatar, then those of the baselines."""
    text = (
        f"{name} ({entry['split']}, {entry['frames']} frames): PSNR {_both(entry)}, faces {FACES[entry['face_params']]}"
    )
    if entry["face_params"] != "as_tracked":
        text += f" ({_both(entry['as_tracked'])}, faces {FACES['as_tracked']})"
    for key, baseline in entry["baselines"].items():
        text += f"; {NAMES[key]} {_both(baseline)}"
    return text


def driven_line(entry: Mapping[str, Any]) -> str:
    """Cross-reenactment in one line, with the figures of an avatar that never moves for comparison."""
    text = f"cross_reenactment ({len(entry['drivers'])} drivers, {entry['frames']} frames): "
    if entry["expression_error"] is None:
        return f"{text}no face is found in any picture of the avatar"
    expression, rotation = "expression_error", "head_rotation_error"
    return (
        f"{text}expression error {entry[expression]:.4f} eye distances (of an avatar that never moves: "
        f"{entry[f'{expression}_still']:.4f}), head rotation error {entry[f'{rotation}_degrees']:.1f} degrees "
        f"({entry[f'{rotation}_still_degrees']:.1f}), faces found in {100 * entry['faces_found']:.0f} % of frames"
    )


def scores_lines(scores: Mapping[str, Any]) -> list[str]:
    """The figures of `score_folders`, with one line for each part of the picture."""
    lines = [f"{scores['frames']} pictures; whole frame: {_figures(scores)}"]
    if scores["crop"] is None:
        return [*lines, "head crop: not known; give --crops or --mattes"]
    return [*lines, f"head crop ({scores['crop']}): {_figures(scores['head'])}"]


def _both(entry: Mapping[str, Any]) -> str:
    return f"{entry['psnr']:.2f} dB whole frame / {entry['head']['psnr']:.2f} dB head crop"


def _figures(entry: Mapping[str, Any]) -> str:
    text = f"PSNR {entry['psnr']:.2f} dB, SSIM {entry['ssim']:.4f}, L1 {entry['l1']:.5f}"
    return text if entry["perceptual"] is None else f"{text}, ST-LPIPS {entry['perceptual']:.4f}"
