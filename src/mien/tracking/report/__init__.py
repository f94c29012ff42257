"""What people see of a tracking: overlays, residuals, the report page and the preview of a running fit."""

from mien.tracking.report.contact_sheet import write_overlay_sheet
from mien.tracking.report.overlay import frontal_camera, overlay_stride, write_overlay
from mien.tracking.report.preview import DONE, Preview
from mien.tracking.report.residuals import residual_report, write_residual_report

__all__ = [
    "DONE",
    "Preview",
    "frontal_camera",
    "overlay_stride",
    "residual_report",
    "write_overlay",
    "write_overlay_sheet",
    "write_residual_report",
]
