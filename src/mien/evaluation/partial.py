"""Partial scores of an evaluation, kept in the run's folder so that an interrupted evaluation can continue."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mien.disk.files import write_atomically
from mien.disk.inside import open_to_append
from mien.disk.limits import checked_whole
from mien.disk.reading import parse_json, read_bytes
from mien.evaluation.scoring import Scores
from mien.training.footage.frames import Frame

_MAX_BYTES = 256 << 20
"""Largest file that is read, in bytes. A frame takes some hundred bytes."""
_LEAST_LINE = 40
"""Fewest bytes of a frame's line."""
_MAX_INDEX = _MAX_BYTES
"""Largest index in a frame."""

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
        good, found = [json.dumps({"scores_of": self.fingerprint})], {}
        lines = self._lines()
        if lines[:1] == good:
            for line in lines[1:]:
                frame = _parsed(line)
                if frame is None:
                    break
                found[frame[0]] = frame[1]
                good.append(line)
        text = "\n".join(good) + "\n"
        write_atomically(self.path, lambda aside: aside.write_text(text, encoding="utf-8"))
        return found

    def _lines(self) -> list[str]:
        try:
            data = read_bytes(self.path, _MAX_BYTES)
        except (OSError, ValueError):
            return []
        # A line takes more memory than its text, so a file of empty lines is not split.
        whole = data.count(b"\n") <= 1 + len(data) // _LEAST_LINE
        return data.decode("utf-8", "replace").split("\n") if whole else []

    def add(self, frame: Frame, scores: Mapping[str, Scores], seconds: float) -> None:
        """Append one more frame."""
        line = json.dumps({"frame": list(frame), "scores": dict(scores), "seconds": seconds})
        with open_to_append(self.path) as file:
            file.write(line + "\n")

    def remove(self) -> None:
        """Delete the file, because the figures are in metrics.json now."""
        self.path.unlink(missing_ok=True)


def _parsed(line: str) -> tuple[Frame, Scored] | None:
    """The frame and figures of a line, or None if the line is not complete."""
    try:
        content: dict[str, Any] = parse_json(line)
        frame = Frame(*(checked_whole(number, 0, _MAX_INDEX) for number in content["frame"]))
        scores = {str(name): _figures(row) for name, row in content["scores"].items()}
        return frame, (scores, float(content["seconds"]))
    except (ValueError, LookupError, TypeError, AttributeError):
        return None


def _figures(row: Mapping[str, Any]) -> Scores:
    if not all(isinstance(value, int | float) for value in row.values()):
        raise ValueError("a figure is no number")
    return {name: float(value) for name, value in row.items()}
