"""Names of the figures of scored pictures. They are apart from what computes them, which needs torch."""

METRICS = ("psnr", "ssim", "l1", "perceptual")
COLUMNS = (
    ("psnr", "PSNR, dB", 2, True), ("ssim", "SSIM", 3, True), ("l1", "L1", 4, False),
    ("perceptual", "ST-LPIPS", 3, False),
)  # fmt: skip
"""Metric, heading, number of digits, whether higher is better."""
