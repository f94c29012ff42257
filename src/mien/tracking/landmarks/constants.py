"""Numbers of the detector's landmarks on the face model, and of the fit to them."""

from dataclasses import dataclass


@dataclass(frozen=True)
class EmbeddingConstants:
    """How a face model gets its landmarks and regions: `landmarks/embedding.py`, `landmarks/regions.py`.

    Lengths of regions were set by eye on anny and on a model in FLAME's schema.
    """

    # embedding.py
    scalp_front: float = 0.06
    """Landmarks may lie on the scalp only farther ahead of the head frame's origin than this, in metres. Not varied."""
    least_seen: float = 0.25
    """Landmarks may lie on a triangle only if it is seen in at least this share of the pictures. Measured against 0:
    landmarks of lids lie up to 0.9 instead of 3.0 mm inside the eyeball (log, "Face model")."""
    subdivisions: int = 12
    """Number of steps along a triangle's side between the points that are tried. Not varied."""
    coarse_views: int = 16
    """Number of views of the coarse search over all triangles. Not varied."""
    coarse_subdivisions: int = 3
    """Number of steps along a triangle's side in the coarse search. Not varied."""
    best_triangles: int = 16
    """Number of triangles that the coarse search passes on. A search near the closest vertex misses large triangles
    beside dense parts (log, "The landmark detector"). Not varied."""

    # regions.py
    lip_depth: float = 0.008
    """Largest distance of lips from their landmarks, in metres."""
    lid_width: float = 0.006
    """Largest distance of lids from their landmarks, in metres."""
    mouth_reach: float = 0.075
    """Largest distance of the mouth's inside from the middle of the lips, in metres."""
    socket_reach: float = 0.025
    """Largest distance of a socket from its eyeball, in metres."""
    hairline: float = 0.010
    """Height of the hairline above the forehead's highest landmark, in metres."""
    neck: float = 0.030
    """Distance of the neck below the chin, measured to a plane slanted like the jaw, in metres."""


@dataclass(frozen=True)
class LandmarkConstants:
    """The fit to landmarks, by the file of `landmarks` that uses them."""

    # detector_response.py, and driving/live/landmark_fit.py
    largest_turn: float = 0.6
    """Largest turn of the head from which the detector's response was measured, in radians. Farther turns count as this
    one. It belongs to the drawn people of the measurement (log, "The landmark detector")."""

    # groups.py
    oval_weight: float = 0.15
    """Weight of landmarks on the face's outline, where that of a landmark of the cheeks is 1. The outline slides over
    the skin. This and the next four were not varied."""
    nose_weight: float = 3.0
    """The same of the nose."""
    lips_weight: float = 3.0
    """The same of the lips."""
    eyelids_weight: float = 5.0
    """The same of the eyelids."""
    irises_weight: float = 4.0
    """The same of the irises."""

    # head_pose.py, and driving/live/landmark_fit.py
    first_outlier: float = 40.0
    """Outlier threshold of the first head pose, in standard deviations. It is wide because a turned head is far from
    the frontal start. Not varied."""
    pose_iterations: int = 15
    """Number of iterations of the first head pose. Not varied."""

    # shared_fit.py
    shared_rounds: int = 4
    """Rounds in which identity and offsets are fitted in turn. Not varied."""
    shared_iterations: int = 6
    """Iterations of each of these rounds. Not varied."""
    focal_sigma: float = 0.03
    """Standard deviation of the logarithm of the focal length. The prior counts once for each keyframe. Measured: 0.15
    to 1.5 change the focal length from 0.64 to 0.71 of the truth, and no error (log, "Focal length")."""
    rim_bias_share: float = 0.25
    """Standard deviation of the static offset for lids and lips, as a share of that of other landmarks. Not varied."""

    # stages.py
    frame_iterations: int = 12
    """Number of iterations of the fit of single frames. Not varied."""
    sequence_rounds: int = 2
    """Rounds of the fit over time, with new turn habits in each. Not varied."""
    sequence_iterations: int = 10
    """Largest number of iterations of the fit over time, in all rounds together. Not varied."""

    # term.py
    sideways_angle: float = 0.3
    """Angle between the direction of the face and the camera at which a picture counts half if there are several
    cameras, in radians. Measured: 0.25 to 0.7 have the same error to 0.04 mm, and smaller angles better blinks (log,
    "Several cameras in the fit")."""
