"""What people see of a tracking: overlays, residuals, the report page and the preview of a running fit."""
