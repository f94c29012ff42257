"""Numbers that decide how well faces are tracked and that no setting changes, with how each was chosen.

The log is docs/log.md, "Tracking". "Set by eye" means that the result looked right and no figure was recorded; "not
varied" means that the first value worked and no other was measured.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class CameraConstants:
    """Assumptions about a camera, and landmarks that are averaged before the fit: `fitting/shot.py`."""

    focal: float = 1.5
    """Focal length of an unknown camera, in larger sides of the source picture. It lies between a phone's wide lens and
    a portrait lens. Not varied."""
    cropped_focal: float = 2.2
    """The same for a nearly square picture. No camera films squares, so the picture was cropped around a head. Measured
    against 1.5: d3 gains 0.3 dB, and wojtek nothing (log, "Focal length")."""
    square: float = 1.1
    """Ratio of sides below which a picture counts as square. Not varied."""
    swing: float = 0.3
    """Largest ratio of squared motion over two frames to the sum of both squared single-frame motions that counts as a
    swing. The ratio is 0 for a swing, 0.5 for noise and 2 for steady motion. Not varied."""
    swing_frames: int = 4
    """Fewest frames in a row that swing. A blink is a single swing and is kept. Measured against no averaging: the
    jitter of beard falls from 0.104 to 0.055 mm, and footage does not change (log, "The landmark detector")."""


@dataclass(frozen=True)
class PriorConstants:
    """Priors and bounds of joints and expressions: `fitting/parameters.py`."""

    joint_sigmas: tuple[tuple[str, tuple[float, float, float]], ...] = (
        ("eye", (0.4, 0.4, 0.0)), ("neck", (0.0, 0.0, 0.0)), ("jaw", (0.25, 0.05, 0.03)),
    )  # fmt: skip
    """Prior standard deviations of joint angles in radians, by a word in the joint's name; 0 fixes an angle. Eyes do
    not roll, a face says nothing about its neck, and a jaw opens (about x), shifts a little (about y) and hardly
    twists. Anatomy, not varied."""
    other_joint_sigmas: tuple[float, float, float] = (0.2, 0.2, 0.2)
    """The same for all other joints, which no face model has so far."""
    jaw_bounds: tuple[float, float] = (-0.03, 0.6)
    """Bounds of the jaw's opening angle in radians. Teeth stop it one way, ligaments the other. Anatomy, not varied."""
    jaw_open: float = 0.35
    """Opening angle of a wide open mouth, in radians. Anatomy, not varied."""
    eyes_alike_sigmas: tuple[float, float] = (0.1, 0.03)
    """Standard deviations of the difference of the two eyes' angles (up-down, left-right), in radians. The eyes look at
    the same thing. Not varied."""
    expression_sigmas: tuple[tuple[str, float], ...] = (
        ("brow", 0.25), ("cheek", 0.3), ("nose", 0.3), ("jaw", 0.5), ("mouth", 0.4), ("eyeLook", 0.3),
        ("eyeBlink", 2.0), ("eyeWide", 1.0), ("eye", 0.5),
    )  # fmt: skip
    """Prior standard deviations of expression coefficients, by the beginning of their name. That of brows is small,
    because otherwise they follow the head's pitch. Not varied one by one. Measured: a third of all of them has the same
    errors, and d3's frown shrinks to a third (log, "Fit to pixels")."""
    other_expression_sigma: float = 0.4
    """The same for all other names. Not varied."""


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


@dataclass(frozen=True)
class EyelidConstants:
    """How colours of the eye place the lids, by the file of `eyelids` that uses them (log, "Lids")."""

    # colors.py
    eye_colors: int = 6
    """Number of colours in the palette of the eyeball. Not varied."""
    edge_colors: int = 8
    """Number of colours in the palette of the edge of the lids. Not varied."""
    palette_rounds: int = 20
    """Rounds in which a palette's colours move to the middle of their pixels. Not varied."""
    palette_samples: int = 20_000
    """Largest number of pixels, about, that a palette is learned from. Not varied."""
    least_palette_samples: int = 100
    """Fewest pixels of each kind that a palette is learned from. Not varied."""
    color_sigma: float = 0.15
    """Standard deviation of logarithms of colours about each colour of a palette. Not varied."""
    skin_sigma: float = 0.15
    """The same of plain skin on the lids, in addition to the spread of the skin around the eye. Wider, lids are 0.2 too
    open, because lashes are as dark as pupils (log)."""
    edge_share: float = 0.1
    """Share of plain skin that may have any colour of the edge palette: moles, folds, make-up. Not varied."""
    eye_share: float = 0.2
    """Share of the edge of a lid that may have any colour of the eyeball palette: lashes are as dark as pupils. Not
    varied."""
    other_density: float = 0.05
    """Density of all other colours, such as reflections and frames of glasses. Not varied."""

    # crops.py
    widest_eye: int = 40
    """Largest width of an eyeball, in pixels. If it is wider, the picture is scaled down. Not varied."""
    narrowest_eye: int = 20
    """Smallest width of an eyeball, in pixels. Narrower eyeballs show too little and are skipped. Not varied."""
    supersampling: int = 2
    """Multiple of the picture's size at which the mesh is drawn, so that edges of lids can lie between pixels. Not
    varied."""
    eye_margin: int = 2
    """Margin around the eyeball, in pixels. Not varied."""
    ring: float = 0.3
    """Width of the ring of skin around the eye, in widths of the opening. Not varied."""
    ring_blur: float = 0.18
    """Standard deviation of the blur of the ring's colour, in widths of the opening. Not varied."""
    least_ring: int = 12
    """Fewest pixels of the ring of skin. With fewer the eye is skipped. Not varied."""
    least_opening: int = 12
    """Fewest pixels of the opening of the eye. With fewer the eye is skipped. Not varied."""
    darkest: float = 0.03
    """Value added to colours (0..1) before the logarithm, so that noise in dark pixels does not matter. Not varied."""

    # eyes.py
    lids_reach: float = 1.3
    """Distance from an eyeball's centre that contains its lids, in radii. Set by eye on the face models."""
    around_reach: float = 3.5
    """Distance from an eyeball's centre that contains everything that may hide it, in radii. Set by eye."""
    closing_steps: int = 64
    """Number of equal steps of a coefficient. Lids touch at the first step at which the least of the eyeball is seen.
    Not varied."""
    most_closing: float = 1.25
    """A coefficient closes an eye if the lids meet within this multiple of its upper bound. Not varied."""
    others_share: float = 0.2
    """A coefficient is not an eye's own if it moves the other eye's lids by more than this share. Not varied."""

    # placing.py
    position_range: tuple[float, float] = (-0.4, 1.2)
    """First and last of the positions of the lids that are tried: 0 is at rest, 1 is closed, below 0 is wider open than
    at rest. Not varied."""
    positions: int = 13
    """Number of these positions. Not varied."""
    edge_band: int = 4
    """Width of the lashes and the edge of the upper lid, in positions. A generous estimate, not varied; lashes anywhere
    on the skin make a shaded eye closed (log)."""
    fine_step: float = 0.01
    """Step of the fine positions to which costs are interpolated. Not varied."""
    cost_blur: float = 0.08
    """Standard deviation of the kernel that smooths the costs, in positions' units. Straight lines between positions
    make lids jitter (log). Not varied."""
    cost_divisor: float = 8.0
    """Divisor of the costs, because errors of neighbouring pixels are correlated. Not varied."""
    disagreement: float = 0.07
    """Largest upper quartile, over the frames, of the cost of the fit's lids above the best one, as a share of the
    range of costs. If it is larger, the colours are misleading and count less. Measured: d3, where they mislead, has
    0.12 to 0.14, and all other clips up to 0.05 (log)."""
    fit_sigma: float = 0.12
    """Standard deviation of the lids of a good fit. Chosen with the shape of the cost (log); not varied alone."""
    offset_sigma: float = 0.4
    """Wider standard deviation of the fit's lids, for the estimate of the usual offset between colours and fit. Not
    varied."""
    learning_pictures: int = 100
    """Largest number of pictures that colours are learned from. Not varied."""
    least_pictures: int = 10
    """Fewest pictures that must show an eye for its lids to be placed. Not varied."""
    least_facing: float = 0.35
    """Smallest cosine between an eye's direction and the direction to the camera. Not varied."""


@dataclass(frozen=True)
class PixelConstants:
    """The fit to pixels, by the file of `pixels` that uses them (log, "Fit to pixels")."""

    # texture.py, eyelids/crops.py
    least_cosine: float = 0.25
    """Least cosine between the surface's normal and the direction to the camera at which the surface's colour is used.
    Not varied."""

    # comparison.py, term.py
    comparison_outlier: float = 10.0
    """Number of standard deviations beyond which a pixel hardly counts for `Comparison.rms`. It is the default of the
    fit's own threshold, `PhotometricSettings.outlier`: with 3, the shape of a drawn head errs by 0.67 instead of 0.43
    mm (log)."""
    least_pixels: float = 100.0
    """Fewest pixels of a comparison. Fewer show nothing of a face. Not varied."""

    # outline.py
    outline_reach: float = 0.012
    """Largest distance along the normal at which an edge of the matte is searched, in metres. Not varied."""
    outline_samples: int = 49
    """Number of samples of the matte along the normal. Not varied."""
    outline_beside: float = 1.5
    """Distance outside of the outline, in pixels, at which there must be no mesh. Not varied."""
    outline_sigma: float = 0.0015
    """Expected distance between outline and matte, in metres. Set with the outlier thresholds; not varied."""
    outline_outliers: tuple[float, float] = (4.0, 2.0)
    """Outlier thresholds in these standard deviations, for mattes that end inside and outside of the mesh. The second
    is smaller, because hair, beards and collars extend the matte. Chosen on d3, whose hair over the ears pulled them
    outwards (log)."""

    # pictures.py
    blur: float = 0.8
    """Standard deviation of the blur, in pixels of the scaled picture. Without it, colours between pixels are guesses.
    Not varied."""
    matte_margin: int = 2
    """Margin along the person's outline that is masked, in pixels of the scaled picture: it mixes with the background.
    Not varied."""

    # refine.py
    frame_damping: float = 1e-3
    """Damping of a frame's step, as a share of the diagonal. Not varied."""
    worse: float = 1.02
    """A step of a frame is undone if it multiplies the frame's cost by this factor or more. Not varied."""
    least_keyframes: int = 3
    """Fewest keyframes for any number of cameras, because the mouth must be seen open and closed. Measured: with 16
    cameras, 3 are as good as 24 (log, "Several cameras in the fit")."""
    least_share: float = 0.03
    """Least weight of a frame in the texture, however far from the middle pose. It may be the only one to show an ear.
    Not varied."""

    # shared.py
    shared_damping: float = 1e-6
    """Damping of a step of identity and focal length. It is tiny, because the effect that separates focal length from
    depth is a thousandth of the effect of either alone. Measured: 1e-3 keeps the focal length where it was (log, "Focal
    length")."""
    pose_smoothing: float = 0.3
    """Ridge regularisation of the affine map from poses to pose steps, in keyframes. Not varied."""
    focal_step: float = 0.2
    """Largest change of the logarithm of a focal length in one step. Not varied."""

    # texture.py
    least_weight: float = 0.05
    """Least total weight of a texel's sightings (each the squared cosine) for the texel to be known. Not varied."""
    first_sigma: float = 0.1
    """Expected colour difference (0..1) before anything is known. Not varied."""
    sigma_bounds: tuple[float, float] = (0.01, 0.1)
    """Bounds of the expected colour difference afterwards. Not varied."""
    light_rounds: int = 3
    """Number of rounds of albedo and light in turn. Not varied."""
    light_stiffness: float = 0.02
    """Weight of the prior that pulls the light towards an even one, relative to the evidence of the pictures. Not
    varied."""


@dataclass(frozen=True)
class CoveredConstants:
    """How frames are found in which a hand covers the face: `pixels/covered.py`.

    Thresholds were chosen on seven real clips and one drawn person, and judged on two others, without an error (log,
    "Capture", 11-25).
    """

    mouth_reach: float = 0.014
    """Distance from the landmarks of the lips up to which triangles belong to the mouth, in metres. Set by eye."""
    nose_reach: float = 0.008
    """The same of the nose. Set by eye."""
    eyes_reach: float = 0.010
    """The same of lids and brows. Set by eye."""
    picture_size: int = 256
    """Shorter side of the pictures that are compared, in pixels. Not varied."""
    light_extent: float = 0.012
    """Standard deviation of the blur that counts as light and is left out, in metres on the face. It is the default of
    `PhotometricSettings.light_extent`, and was not varied here."""
    least_cosine: float = 0.3
    """Least cosine between the surface's normal and the direction to the camera of a point that counts. Not varied."""
    least_seen: float = 0.4
    """Least share of a part's points that a picture must show. Not varied."""
    least_likeness: float = 0.35
    """Correlation with the usual look of a part below which something covers it. Measured: a drawn hand reaches 0.29 at
    most. Seven real clips without hands have 0.43 or more, except for one frame of a grimace with 0.22, which `lasting`
    leaves out."""
    lasting: float = 0.05
    """Half of the least time that something covers a part, in seconds. A grimace is shorter than a hand."""
    alike: float = 0.5
    """Correlation with the usual look above which a frame has a part in it."""
    flat: float = 0.05
    """Share of the usual contrast below which a picture is flat, such as a phone's back: it correlates with nothing.
    Not varied."""
    usual_share: float = 0.3
    """Share of the pictures that the usual look comes from. Fewer could be those of a hand that rests. Not varied."""
    usual_rounds: int = 5
    """Rounds in which the usual look is made of all pictures that are like it. Without them, 20 frames of wojtek were
    found."""
    many: float = 0.25
    """Share of odd pictures from which on they may be the face itself. Not varied."""
    clearly: float = 0.1
    """Difference of correlations by which what moves in front of the face is less alike from picture to picture. Not
    varied."""
    least_pictures: int = 8
    """Fewest pictures of a part that can tell what is usual. Not varied."""
    look_every: float = 0.2
    """Seconds between the frames that are looked at first. A clip in which these show nothing odd is not looked at
    further. Chosen for speed; not varied."""
    least_looks: int = 60
    """Least number of these frames. Not varied."""


@dataclass(frozen=True)
class DescentConstants:
    """The schedule `paper`, by the file of `descent` that uses them (log, "The paper's schedule")."""

    # adam.py
    settled_gradient: float = 2.0
    """Gradient of a squared cost at one standard deviation; it damps steps with smaller gradients. Plain Adam moves by
    its whole rate however small the gradient is. Measured against none: jitter falls from 0.034 to 0.014 mm (log)."""

    # epochs.py
    global_rate: float = 0.1
    """Factor of the initial learning rates in the first epoch. Not varied."""
    epoch_decay: float = 0.9
    """Factor of the learning rates from one epoch to the next. Not varied."""
    good_cosine: float = 0.5
    """Least cosine of the viewing angle at which a triangle's texels count fully. Below it they count in proportion.
    Not varied."""
    most_batches: int = 40
    """Largest number of batches in an epoch. Frames err alike, so longer clips need no more steps of shared parameters.
    Chosen instead of a step for each frame (log); not varied."""
    texture_every: int = 4
    """Fewest frames whose texture gradients are summed for one step. A step of the texture costs as much as a picture.
    Chosen for speed; not varied."""

    # frames.py
    last_rate: float = 0.1
    """Factor of the learning rates at the last of a frame's steps. Not varied."""
    texture_gain: float = 0.15
    """Cosine by which a frame must see a triangle more frontally than earlier frames for its texels to be learned
    again. Not varied."""
    texture_least_cosine: float = 0.1
    """Least cosine of the viewing angle at which a frame's texels are learned at all. Not varied."""
    texture_frames: int = 40
    """Number of frames of each sequence from which texture and light are fitted before the epochs. Not varied."""
    texture_rounds: int = 6
    """Number of steps at each of these frames. Not varied."""
    lost_landmarks: float = 3.0
    """Standard deviations by which landmarks must be farther off than in their own fit to be lost. Not varied."""
    light_every: int = 10
    """Number of steps between estimates of the unexplained light of a picture. Chosen for speed; not varied."""
    further_start_divisor: int = 5
    """The first frames of further sequences get the first frame's number of steps divided by this. Not varied."""

    # terms.py
    blur_at: float = 4.0
    """For a wide blur, pictures are scaled down until its standard deviation is about this many pixels. Chosen for
    speed; not varied."""
    light_difference: float = 0.1
    """Colour difference (0..1) above which a pixel hardly counts as light. Not varied."""


@dataclass(frozen=True)
class NeckConstants:
    """The lower end of the head: `neck_line.py`, `neck_cut.py`, `scoring.py`. It decides what is trained and scored."""

    # neck_line.py
    middle: tuple[float, float] = (0.4, 0.7)
    """Range of the middle of the neck, as shares of the way from its base to its top. Set by eye."""

    # neck_cut.py
    raised: float = 0.4
    """Height of the cut above the base of the neck, as a share of the way to the middle of the neck: above most
    collars. Measured: without the raise, the front of `mono-sides` has 2 dB less (log, "Capture", 11-23)."""
    beside: float = 1.15
    """Radius that is kept at the neck cut, in radii of the neck. Set by eye."""
    slope: float = 1.0
    """Growth of that radius with the height above the cut. Hair is kept; collars and shoulders are cut off. Set by
    eye."""

    # scoring.py
    silhouette_margin: float = 0.015
    """Margin around the projected head, in its own widths, because tracking is not exact to the pixel. Not varied."""
    faint: int = 32
    """Least opacity (of 255) of a pixel that counts for connection and for the crop. Not varied."""


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
