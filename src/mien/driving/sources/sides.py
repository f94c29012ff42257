"""The table of sides: whose left and right the coefficients of a recording mean, for each source.

In mien, left and right are the performer's, as Apple describes the coefficients of ARKit and as the face models have
them. In the csv of Live Link Face, the slides of mouth and jaw have the observer's sides:

- In two public takes, MouthLeft - MouthRight goes against MouthUpperUpLeft - MouthUpperUpRight (correlation -0.91 and
  -0.81). In pictures, a mouth that slides to one side lifts the lip of that side: with MediaPipe, whose MouthLeft moves
  the lips to the performer's left (+0.92 with their place), the correlation is +0.56.
- JawLeft - JawRight goes with MouthLeft - MouthRight in the same takes (+0.83 and +0.85), as in pictures (+0.32), so
  the jaw has the sides of the mouth.
- An importer for Blender has a switch that exchanges MouthLeft and MouthRight of the app.

Nothing is known against the names of the other sources, so their sides are those of the names. docs/conventions.md has
the same table, and a test compares the two.
"""

from dataclasses import dataclass
from enum import Enum

import numpy as np
from jaxtyping import Float32

from mien.driving.motion import ARKIT_NAMES


class Side(Enum):
    """Whose left and right a coefficient means."""

    PERFORMER = "performer"
    OBSERVER = "observer"


@dataclass(frozen=True)
class Sides:
    """The sides of a source's directional coefficients."""

    parts: Side
    """Coefficients of one half of the face, such as eyeBlinkLeft, eyeLookInLeft or mouthSmileLeft. Gaze in and out is
    relative to the nose."""
    jaw: Side
    """jawLeft and jawRight."""
    mouth: Side
    """mouthLeft and mouthRight."""

    def of(self, name: str) -> Side:
        """The side that a name of `ARKIT_NAMES` with Left or Right means."""
        slides = {"jawLeft": self.jaw, "jawRight": self.jaw, "mouthLeft": self.mouth, "mouthRight": self.mouth}
        return slides.get(name, self.parts)


_NAMED = Sides(Side.PERFORMER, Side.PERFORMER, Side.PERFORMER)
LIVE_LINK_FACE = Sides(Side.PERFORMER, Side.OBSERVER, Side.OBSERVER)
PLAIN = FACE_LANDMARKER = NAMED_WEIGHTS = AUDIO2FACE = AZURE_SPEECH = _NAMED
SOURCES = {
    "Live Link Face (.csv)": LIVE_LINK_FACE,
    "table without a timecode (.csv)": PLAIN,
    "plain list (.json)": PLAIN,
    "MediaPipe's FaceLandmarker (.json)": FACE_LANDMARKER,
    "BEAT, LAM (.json)": NAMED_WEIGHTS,
    "Audio2Face (.json)": AUDIO2FACE,
    "Azure speech (.json)": AZURE_SPEECH,
}
"""The table: sides by source."""
PAIRS = tuple((name, name[:-4] + "Right") for name in ARKIT_NAMES if name.endswith("Left"))
"""All directional coefficients, as pairs of left and right."""


def as_performer(coefficients: Float32[np.ndarray, "t 52"], sides: Sides) -> Float32[np.ndarray, "t 52"]:
    """The coefficients with the performer's sides: pairs that have the observer's are exchanged."""
    exchanged = coefficients.copy()
    for pair in PAIRS:
        if sides.of(pair[0]) is Side.OBSERVER:
            left, right = (ARKIT_NAMES.index(name) for name in pair)
            exchanged[:, [left, right]] = coefficients[:, [right, left]]
    return exchanged
