"""Fit of the face model to a capture: the tracking, its files, the cut at the neck, and the fixed scoring mask."""

from typing import TYPE_CHECKING

from mien.lazy import lazy_names

if TYPE_CHECKING:
    from mien.tracking.files import check_tracking_of, read_tracking, write_tracking
    from mien.tracking.fitting.shot import has_enough_faces
    from mien.tracking.neck_cut import NeckCut, NeckParts, fit_neck_cut
    from mien.tracking.neck_line import fit_neck_lines
    from mien.tracking.pipeline import track, track_subject
    from mien.tracking.report.contact_sheet import write_overlay_sheet
    from mien.tracking.report.overlay import frontal_camera, overlay_stride, write_overlay
    from mien.tracking.report.residuals import residual_report, write_residual_report
    from mien.tracking.scoring import Scoring, head_crop, head_cutter, head_mask, make_scoring
    from mien.tracking.scoring_files import (
        check_scoring_cut,
        read_scoring,
        read_scoring_hash,
        scoring_exists,
        write_scoring,
    )
    from mien.tracking.settings import (
        PaperSettings,
        PhotometricSettings,
        ScoringSettings,
        SmoothnessSettings,
        TrackingSettings,
    )
    from mien.tracking.tracking import Appearance, Tracking
else:
    __getattr__, __dir__ = lazy_names(__name__, __file__)

__all__ = [
    "Appearance",
    "NeckCut",
    "NeckParts",
    "PaperSettings",
    "PhotometricSettings",
    "Scoring",
    "ScoringSettings",
    "SmoothnessSettings",
    "Tracking",
    "TrackingSettings",
    "check_scoring_cut",
    "check_tracking_of",
    "fit_neck_cut",
    "fit_neck_lines",
    "frontal_camera",
    "has_enough_faces",
    "head_crop",
    "head_cutter",
    "head_mask",
    "make_scoring",
    "overlay_stride",
    "read_scoring",
    "read_scoring_hash",
    "read_tracking",
    "residual_report",
    "scoring_exists",
    "track",
    "track_subject",
    "write_overlay",
    "write_overlay_sheet",
    "write_residual_report",
    "write_scoring",
    "write_tracking",
]
