"""What an evaluation has scored so far, kept in the run's folder, so that an interrupted one goes on where it was."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mien.evaluation.experiment import Frame
from mien.evaluation.scoring import Scores

Scored = tuple[dict[str, Scores], float]
"""A frame's figures by what was scored, and the seconds of rendering the avatar."""


@dataclass(frozen=True)
class PartialScores:
    """A file with a line for each frame that was scored, behind a line that says of what."""

    path: Path
    fingerprint: str
    """Figures of anything else are dropped."""

    def read(self) -> dict[Frame, Scored]:
        """Frames scored before; none where the file is of another run, other settings, or damaged.

        Cuts the file back to its good lines (a killed process may leave half a line), or begins it.
        """
        good, found = [json.dumps({"scores_of": self.fingerprint})], {}
        lines = self.path.read_text(encoding="utf-8", errors="replace").splitlines() if self.path.is_file() else []
        if lines[:1] == good:
            for line in lines[1:]:
                frame = _parsed(line)
                if frame is None:
                    break
                found[frame[0]] = frame[1]
                good.append(line)
        self.path.write_text("\n".join(good) + "\n", encoding="utf-8")
        return found

    def add(self, frame: Frame, scores: Mapping[str, Scores], seconds: float) -> None:
        """Keep one more frame."""
        line = json.dumps({"frame": list(frame), "scores": dict(scores), "seconds": seconds})
        with self.path.open("a", encoding="utf-8") as file:
            file.write(line + "\n")

    def remove(self) -> None:
        """Forget everything: the figures are in metrics.json now."""
        self.path.unlink(missing_ok=True)


def _parsed(line: str) -> tuple[Frame, Scored] | None:
    """A line's frame and figures, or none where it is no whole line."""
    try:
        content: dict[str, Any] = json.loads(line)
        return Frame(*content["frame"]), (content["scores"], float(content["seconds"]))
    except (ValueError, KeyError, TypeError):
        return None
