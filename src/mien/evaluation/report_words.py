"""Explanations of the terms in a report, for readers who see one for the first time."""

GLOSSARY = {
    "Held out": (
        "Frames that training never saw. blocks: every fifth block of 10 frames. tail: the last 20 %, which may show "
        "poses and expressions that never occurred before, so its figures are lower. sequences: whole sequences, posed "
        "as tracked. cameras: cameras at moments that other cameras were trained at."
    ),
    "Target": (
        "The picture inside a frozen mask (the matte, cut below the neck line), over white. The mask stays when the "
        "sequence is tracked again, so that runs compare."
    ),
    "Whole frame, head crop": (
        "A white background raises the whole frame's PSNR by several dB: compare head crops between clips. The crop is "
        "the box of the mask."
    ),
    "Baselines": (
        "An avatar must beat both: the mean of all training pictures, and the tracked mesh with the colours that "
        "training frames show on it. In green: its lead over the better one, dB."
    ),
    "Face parameters": (
        "as tracked: held-out frames are posed by the tracker alone. corrected: training also improved the tracking of "
        "the frames that it saw, and held-out frames get those corrections, interpolated over time; their own pixels "
        "are never looked at."
    ),
    "PSNR, SSIM, L1": (
        "Images in 0..1, clamped; means over frames. SSIM: 11x11 Gaussian window, sigma 1.5, zeros beyond the border."
    ),
    "ST-LPIPS": "A learned distance that forgives shifts of a few pixels; its figures are not those of LPIPS.",
}
"""Term -> explanation."""
