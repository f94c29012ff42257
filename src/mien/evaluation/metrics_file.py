"""Reads metrics.json, and names its figures for people."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mien.disk.files import read_json
from mien.disk.reading import expect_whole

FORMAT, VERSION = "mien.metrics", 1
REMEDY = "delete this file, not its folder, and run `mien evaluate` again"
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
FITTED_NAME = "fitted to the scored pictures"
"""Name for face parameters that were fitted to the held-out frames themselves. They are never the headline."""
OVER_DARK_NAME = "over dark blue"
"""Name for figures over a dark background. The others are over white."""


def read_metrics(run_dir: Path) -> dict[str, Any]:
    """Read what `evaluate` wrote."""
    path = run_dir / "metrics.json"
    content = read_json(path, FORMAT, VERSION, "`mien evaluate`", REMEDY)
    with expect_whole(path, REMEDY):
        _ = content["protocols"].keys(), content["training"].keys()
    return {name: value for name, value in content.items() if name not in ("format", "version")}


def protocol_means(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """The protocols of metrics.json without the figures of single frames."""
    protocols = metrics["protocols"].items()
    return {name: {key: value for key, value in entry.items() if key != "per_frame"} for name, entry in protocols}


def figure(entry: Mapping[str, Any], part: str | None, metric: str) -> float | None:
    """One figure of the whole frame (no `part`) or of a part, or None if it was not computed or is not finite."""
    value = (entry if part is None else entry.get(part, {})).get(metric)
    return None if value is None or not math.isfinite(value) else value
