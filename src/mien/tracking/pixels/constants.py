"""Numbers of the fit to pixels, and of what it leaves out because something covers the face."""

from dataclasses import dataclass


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
    least_lasting: int = 3
    """Fewest pictures in a row that something covers. At 25 frames a second it is what `lasting` says; with fewer, one
    grimace or one turn of the head was taken for a hand."""
    similar_turn: float = 15.0
    """Angle in degrees between the turns of a head up to which its pictures are compared. Not varied."""
    least_similar: int = 5
    """Fewest usual pictures of a similar turn without which a picture is not judged. Not varied."""
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
