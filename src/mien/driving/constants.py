"""Numbers that decide how avatars are driven and that no setting changes, with how each was chosen.

The log is docs/log.md, "Driving". "Not varied" means that the first value worked and no other was measured.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class DrivingConstants:
    """The constants of this room, by the file that uses them. Formats of recordings have theirs beside their code."""

    # expression_map.py
    transfer_noise: float = 0.0005
    """Distance in metres by which a landmark of a matched motion may be off: the weight of the fit against the priors
    below. Not varied, as the next three."""
    transfer_spread: float = 0.5
    """Standard deviation of ARKit's coefficients."""
    transfer_jaw_spread: float = 0.2
    """The same of the angles of a jaw that is a joint, in radians."""
    transfer_jaw: tuple[tuple[float, float], ...] = ((-0.05, 0.6), (-0.15, 0.15), (-0.1, 0.1))
    """Bounds of its angles about x, y and z, in radians."""
    transfer_jaw_step: float = 0.2
    """Angle in radians over which a jaw's motion is taken as linear. Not varied."""
    transfer_sweeps: int = 40
    """Rounds of the bounded fit. Not varied."""

    # live/follower.py
    learn_seconds: float = 1.0
    """Time over which the face at rest is learnt, in seconds. Not varied."""
    learn_least_frames: int = 8
    """Least number of frames from which it is learnt. Not varied."""
    away_seconds: float = 0.4
    """Time without a face after which the avatar goes to rest. Until then it keeps its face, because detectors miss
    some frames. Not varied."""
    rest_seconds: float = 0.35
    """Time in which the avatar goes two thirds of the way to rest, in seconds. Not varied."""
    head_cutoff: tuple[float, float] = (1.2, 12.0)
    """Cutoff of the smoothing at rest in Hz, and its growth in Hz for a speed of 1 a second, of the head's angles in
    radians. Not varied, as the next two and that of other coefficients; those of the page were measured (log, "One Euro
    filter")."""
    place_cutoff: tuple[float, float] = (1.0, 40.0)
    """The same of the head's place in metres."""
    eye_cutoff: tuple[float, float] = (2.5, 4.0)
    """The same of eyes and lids. Measured: without smoothing of eyes and mouth, the mean correlation with the truth is
    0.912 instead of 0.913 (log, 11-23)."""
    mouth_cutoff: tuple[float, float] = (2.0, 4.0)
    """The same of jaw and mouth."""
    other_cutoff: tuple[float, float] = (1.2, 2.0)
    """The same of the other coefficients."""

    # live/landmark_fit.py
    live_step: float = 0.5
    """Part of a coefficient over which landmarks are taken as linear; for joints, in radians, a quarter of that. Not
    varied."""
    live_outlier: float = 6.0
    """Outlier threshold in standard deviations. Measured: 20 has the same mean correlation to 0.001 (log, 11-23)."""
    live_steps: int = 2
    """Gauss-Newton steps from the frame before. Measured: 4 have a mean correlation of 0.915 instead of 0.913 (log,
    11-23)."""
    live_first_steps: int = 12
    """Gauss-Newton steps from a face that looks ahead. Not varied."""
    live_expression_limits: tuple[float, float] = (0.4, 0.7)
    """Limits of the coefficients of jaw, brows, smiles and rounded lips of the face at rest. They are wider than those
    of a tracking, because the person's shape is unknown: in clips of seven people, medians of the fit are up to 0.34.
    For lids and other lips they are up to 0.9, so their part is always taken as shape."""
    live_gaze_limits: tuple[float, float] = (0.35, 0.5)
    """The same of the angles of eyes, in radians. In clips of seven people, medians are up to 0.24."""

    # live/one_euro.py
    speed_cutoff: float = 3.0
    """Cutoff of the low pass of the speeds, in Hz. Chosen for the exported page with the other two numbers of its
    filter (log, "One Euro filter")."""

    # neutral.py
    first_seconds: float = 0.5
    """Length of the beginning that --neutral first takes, in seconds. Not varied."""

    # rest.py
    rest_expression: tuple[float, float] = (0.3, 0.6)
    """Limits of a coefficient of ARKit: up to the first it belongs to the person, from the second on it is motion.
    Measured: calm tenths of nine real sequences have 0.22 at most, of ten drawn ones 0.28 (log, 11-25)."""
    rest_head: tuple[float, float] = (0.524, 0.785)
    """The same for the angle between the head and the direction to the camera, in radians: 30 and 45 degrees. A camera
    aside is common, so these limits are wide. Measured: 18 degrees at most, 26 on drawn people."""
    rest_gaze: tuple[float, float] = (0.262, 0.384)
    """The same for the angle of the gaze, in radians: 15 and 22 degrees. Eyes that look ahead or into the camera are at
    rest however the head is turned. Measured: 11 degrees at most, 12 on drawn people."""
    rest_jaw: tuple[float, float] = (0.12, 0.24)
    """The same for a jaw that is a joint, in radians. Not varied."""
    rest_sigmas_of_one: float = 5.0
    """Standard deviations of a face model's coefficient that count as 1 of ARKit, so that the limits are 1.5 and 3. Not
    varied."""

    # speech.py
    speech_window: float = 0.04
    """Length of the pieces of sound that are measured, in seconds. Bands, weights, smoothing, exponent and drops were
    chosen on 5 English sentences of 4 voices of a synthesiser, and judged on others (docs/using.md, "A voice")."""
    speech_bands: tuple[tuple[float, float], ...] = ((500.0, 900.0), (1400.0, 3000.0))
    """Bands in Hz in which open vowels are louder than closed ones: one of the first of their formants, one above."""
    speech_band_weights: tuple[float, ...] = (1.0, 0.5)
    """How much the share of each band counts, in dB, beside the loudness."""
    speech_least_share: float = 10**-2.5
    """Smallest share of the energy that a band counts with."""
    speech_smoothing: float = 0.02
    """Standard deviation of the smoothing over time, in seconds. It is even before and after, so there is no lag."""
    speech_floor: float = 10
    """Percentile of the level that is the noise floor."""
    speech_loud: float = 95
    """Percentile of the level that is a loud voice."""
    speech_range: tuple[float, float] = (25.0, 45.0)
    """Bounds of the distance from the noise floor to a loud voice, in dB."""
    speech_gate: float = 0.15
    """Share of this distance above the noise floor that still counts as silence."""
    speech_silence: float = -55.0
    """Loudness of silence in dB, where 0 is the loudest possible. Files that are never louder do not move the mouth."""
    speech_exponent: float = 2.0
    """Exponent from the level in dB to opening."""
    speech_split: tuple[float, float] = (700.0, 2500.0)
    """Frequencies in Hz below which sound is low, and above which it is high."""
    speech_jaw: float = 0.55
    """Largest coefficient of the open jaw."""
    speech_lower_lip: float = 0.25
    """Largest coefficient of the lowered lower lip."""
    speech_upper_lip: float = 0.12
    """Largest coefficient of the raised upper lip."""
    speech_funnel: float = 0.35
    """Largest coefficient of rounded lips."""
    speech_stretch: float = 0.3
    """Largest coefficient of wide lips."""
    speech_less_jaw: float = 0.6
    """Share of the jaw's opening that high sounds take away."""
    speech_press: float = 0.3
    """Largest coefficient of pressed lips, at p, b and m."""
    speech_shut_within: float = 0.14
    """Time within which sound is as loud before and after a drop at which lips shut, in seconds."""
    speech_shut_drop: tuple[float, float] = (14.0, 26.0)
    """Drops of the level in dB from which on lips begin to shut, and at which they are shut. No real speech was
    compared."""
    speech_shut_hiss: float = 6.0
    """How much energy at high frequencies keeps lips open, as at s: from its inverse on, they are."""
    speech_shut_beside: float = 0.3
    """How shut lips are in the picture before and after that in which they are shut."""
    speech_sway: tuple[float, float, float] = (0.012, 0.02, 0.008)
    """Sizes of the head's slow waves about x, y and z, in radians."""
    speech_blink_every: float = 3.5
    """Mean time between blinks, in seconds, as in the exported page."""
    speech_blink_closing: float = 0.08
    """Time in which lids close, in seconds, as in the exported page."""
    speech_blink_opening: float = 0.17
    """Time in which they open, in seconds, as in the exported page."""


DRIVING = DrivingConstants()
