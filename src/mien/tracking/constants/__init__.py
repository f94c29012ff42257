"""Numbers that decide how well faces are tracked and that no setting changes, with how each was chosen.

The log is docs/log.md, "Tracking". "Set by eye" means that the result looked right and no figure was recorded; "not
varied" means that the first value worked and no other was measured.
"""

from dataclasses import dataclass

from mien.tracking.descent.constants import DescentConstants
from mien.tracking.eyelids.constants import EyelidConstants
from mien.tracking.fitting.constants import CameraConstants, PriorConstants
from mien.tracking.landmarks.constants import EmbeddingConstants, LandmarkConstants
from mien.tracking.neck_constants import NeckConstants
from mien.tracking.pixels.constants import CoveredConstants, PixelConstants


@dataclass(frozen=True)
class TrackingConstants:
    """The constants of this room, by stage. Numbers of the report stay beside its code, as they change no fit."""

    camera: CameraConstants = CameraConstants()
    """Assumed lenses, and swinging landmarks."""
    priors: PriorConstants = PriorConstants()
    """Joints and expressions."""
    embedding: EmbeddingConstants = EmbeddingConstants()
    """Landmarks and regions of a face model."""
    landmarks: LandmarkConstants = LandmarkConstants()
    """The fit to landmarks."""
    eyelids: EyelidConstants = EyelidConstants()
    """Lids by the colours of the eye."""
    pixels: PixelConstants = PixelConstants()
    """The fit to pixels."""
    covered: CoveredConstants = CoveredConstants()
    """Frames in which something covers the face."""
    descent: DescentConstants = DescentConstants()
    """The schedule `paper`."""
    neck: NeckConstants = NeckConstants()
    """The lower end of the head."""


TRACKING = TrackingConstants()
