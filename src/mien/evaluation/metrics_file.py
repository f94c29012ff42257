"""Reads metrics.json, checks that every figure to compare or show is there and is a number, and names the figures."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

from mien.disk.files import expect_whole, read_json
from mien.disk.inside import is_one_line
from mien.evaluation.experiment import Edges
from mien.face.parts import PARTS
from mien.pages.metric_names import METRICS

FORMAT, VERSION = "mien.metrics", 1
_REMEDY = "delete this file, not its folder, and run `mien evaluate` again"
PROTOCOL_NAMES = {
    "self_reenactment": "Self-reenactment",
    "self_reenactment_tail": "Self-reenactment, last part of the sequence",
    "self_reenactment_sequence": "Self-reenactment, held-out sequences",
    "novel_view": "Novel views, held-out cameras",
}
"""Headings of protocols, by their keys in metrics.json."""
PART_NAMES = {"eyes": "Eyes", "mouth": "Mouth"}
"""Headings of the parts of the face that have figures of their own, by their keys in metrics.json."""
BASELINE_NAMES = {"mean_frame": "mean training picture", "mesh": "coloured mesh"}
"""Names of the baselines, by their keys in metrics.json."""
FACE_SOURCE_NAMES = {"corrected": "corrected", "as_tracked": "as tracked"}
"""Names for the source of held-out face parameters: tracking with corrections from training, or tracking alone."""
FITTED_NAME = "fitted to the scored pictures"
"""Name for face parameters that were fitted to the held-out frames themselves. They are never the headline."""
OVER_DARK_NAME = "over dark blue"
"""Name for figures over a dark background. The others are over white."""
_DRIVEN = ("expression_error", "expression_error_still", "head_rotation_error_degrees",
           "head_rotation_error_still_degrees", "faces_found")  # fmt: skip
_MAX_FIGURE = 1e12
"""Largest figure of any kind: seconds, decibels, numbers of Gaussians."""


def read_metrics(run_dir: Path) -> dict[str, Any]:
    """Read what `evaluate` wrote."""
    path = run_dir / "metrics.json"
    content = read_json(path, FORMAT, VERSION, "`mien evaluate`", _REMEDY)
    with expect_whole(path, _REMEDY):
        _ = content["protocols"].keys(), content["training"].keys()
    return {name: value for name, value in content.items() if name not in ("format", "version")}


def protocol_means(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """The protocols of metrics.json without the figures of single frames."""
    protocols = metrics["protocols"].items()
    return {name: {key: value for key, value in entry.items() if key != "per_frame"} for name, entry in protocols}


def read_figures(run_dir: Path) -> dict[str, Any]:
    """`read_metrics`, with a check of every figure that tables, pages and lines show."""
    content, path = read_metrics(run_dir), run_dir / "metrics.json"
    with expect_whole(path, _REMEDY):
        for name, entry in content["protocols"].items():
            _require(is_one_line(name), "a protocol's name")
            if "psnr" in entry:
                _check_protocol(entry)
            else:
                _check_driven(entry)
        _number(content["training"], "gaussians", whole=True)
        _number(content["training"], "seconds")
    return content


def figure(entry: Mapping[str, Any], part: str | None, metric: str) -> float | None:
    """One figure of the whole frame (no `part`) or of a part, or None if it was not computed or is not finite."""
    value = (entry if part is None else entry[part]).get(metric)
    return None if value is None or not math.isfinite(value) else value


def _check_protocol(entry: Mapping[str, Any]) -> None:
    _check_row(entry)
    _require(is_one_line(entry["split"]) and entry["face_params"] in FACE_SOURCE_NAMES, "split or face_params")
    _require(entry["edges"] in get_args(Edges), "edges")
    _number(entry, "frames", whole=True)
    _number(entry, "seconds_per_frame")
    if "covered_frames" in entry:
        _number(entry, "covered_frames", whole=True)
    if entry["face_params"] != "as_tracked":
        _check_row(entry["as_tracked"])
    for name in ("over_dark", "fitted", "opened", "without_clothes"):
        if name in entry:
            _check_row(entry[name])
    for name, row in entry["baselines"].items():
        _require(name in BASELINE_NAMES, "a baseline's name")
        _check_row(row)
    for name in ("perceptual_backbone", "pixels", "part_crops", "lpips_backbone"):
        _require(entry.get(name) is None or is_one_line(entry[name]), name)
    if "dataset_protocol" in entry:
        _require(all(is_one_line(entry[name]) for name in ("dataset_protocol", "mask", "ssim_window")), "its protocol")
    if entry.get("lpips") is not None:
        _number(entry, "lpips")
        _require(is_one_line(entry["lpips_backbone"]), "lpips_backbone")
    _require(isinstance(entry.get("perceptual_frames"), int | None), "perceptual_frames")
    for name, digests in entry["scored_on"].items():
        _require(all(map(is_one_line, (name, *digests, *digests.values()))), "scored_on")
    _check_frames(entry["per_frame"])


def _check_frames(frames: Mapping[str, Sequence[Any]]) -> None:
    columns = [frames[name] for name in ("sequence", "camera_id", "timestep", "psnr", "head_psnr")]
    _require(all(isinstance(column, list) for column in columns), "per_frame")
    _require(len({len(column) for column in columns}) == 1 and bool(columns[0]), "per_frame")
    _require(all(map(is_one_line, (*columns[0], *columns[1]))), "per_frame")
    for column in columns[2:]:
        for value in column:
            _require(_is_number(value), "per_frame")


def _check_row(row: Mapping[str, Any]) -> None:
    """Check the figures of the whole frame, of the head crop, and of eyes and mouth if there are any.

    Only PSNR is required.
    """
    for part in (row, row["head"], *(row[name] for name in PARTS if name in row)):
        for name in METRICS:
            _require(_is_number(part.get(name)) or (name != "psnr" and part.get(name) is None), name)


def _check_driven(entry: Mapping[str, Any]) -> None:
    _require(isinstance(entry["drivers"], list), "drivers")
    _number(entry, "frames", whole=True)
    for name in _DRIVEN:
        _require(_is_number(entry[name]) or entry["expression_error"] is None, name)


def _number(entry: Mapping[str, Any], name: str, *, whole: bool = False) -> None:
    value = entry[name]
    _require(_is_number(value) and value >= 0 and (isinstance(value, int) or not whole), name)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _MAX_FIGURE


def _require(holds: bool, what: str) -> None:
    if not holds:
        raise ValueError(f"{what} is missing or has a wrong value")
