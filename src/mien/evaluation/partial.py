"""Partial scores of an evaluation, kept in the run's folder so that an interrupted evaluation can continue."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mien.disk.files import write_atomically
from mien.disk.inside import open_to_append
from mien.disk.reading import parse_json, read_bytes
from mien.evaluation.scoring import Scores
from mien.training.footage.frames import Frame

Scored = tuple[dict[str, Scores], float]
"""A frame's figures by the scored subject, and the seconds that rendering the avatar took."""


@dataclass(frozen=True)
class PartialScores:
    """A file with one line per scored frame, after a first line with the fingerprint of the evaluation."""

    path: Path
    fingerprint: str
    """Identity of the evaluation. Figures of any other evaluation are dropped."""

    def read(self) -> dict[Frame, Scored]:
        """The frames that were scored before. Empty if the file is of another run or other settings, or is damaged.

        Cuts the file back to its good lines, because a killed process may leave half a line. Creates the file if
        needed.
        """
        good: list[str] = [json.dumps({"scores_of": self.fingerprint})]
        found: dict[Frame, Scored] = {}
        try:
            lines = read_bytes(self.path, 256 << 20).decode("utf-8", "replace").split("\n")
        except (OSError, ValueError):
            lines = []
        if lines[:1] == good:
            for line in lines[1:]:
                try:
                    content: dict[str, Any] = parse_json(line)
                    rows: dict[str, Scores] = {}
                    rows |= {name: {key: float(row[key]) for key in row} for name, row in content["scores"].items()}
                    found[Frame(*content["frame"])] = (rows, float(content["seconds"]))
                except (ValueError, LookupError, TypeError, AttributeError):
                    break
                good.append(line)
        text = "\n".join(good) + "\n"
        write_atomically(self.path, lambda aside: aside.write_text(text, encoding="utf-8"))
        return found

    def add(self, frame: Frame, scores: Mapping[str, Scores], seconds: float) -> None:
        """Append one more frame."""
        line = json.dumps({"frame": list(frame), "scores": dict(scores), "seconds": seconds})
        with open_to_append(self.path) as file:
            file.write(line + "\n")

    def remove(self) -> None:
        """Delete the file, because the figures are in metrics.json now."""
        self.path.unlink(missing_ok=True)
