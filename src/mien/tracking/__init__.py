"""The face model fitted to a capture: tracking, its files, the neck line and the frozen scoring mask."""

from mien.tracking.files import read_tracking, write_tracking
from mien.tracking.pipeline import track
from mien.tracking.scoring import Scoring, make_scoring
from mien.tracking.scoring_files import read_scoring, scoring_exists, write_scoring
from mien.tracking.settings import SmoothnessSettings, TrackingSettings
from mien.tracking.tracking import Tracking

__all__ = [
    "Scoring",
    "SmoothnessSettings",
    "Tracking",
    "TrackingSettings",
    "make_scoring",
    "read_scoring",
    "read_tracking",
    "scoring_exists",
    "track",
    "write_scoring",
    "write_tracking",
]
