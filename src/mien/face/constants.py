"""Numbers that decide what face models look like and that no setting changes, with how each was chosen.

The log is docs/log.md, "Face model". "Set by eye" means that the result looked right and no figure was recorded; "not
varied" means that the first value worked and no other was measured. Those of anny are baked into the model, which is
cached: after a change, raise `mien.face.models.anny_source.RECIPE`, and track again.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class FaceConstants:
    """The constants of this room, by the file that uses them. The layout of textures stays beside its code."""

    # anny.py
    anny_bounds: tuple[tuple[str, float], ...] = (
        ("eyeBlink", 1.15), ("jawForward", 1.0), ("jawLeft", 1.0), ("jawRight", 1.0), ("cheekPuff", 1.2),
        ("jawOpen", 1.2),
    )  # fmt: skip
    """Upper bounds below 1.5, by the start of an expression's name. Beyond them the mesh intersects itself. Set by
    eye."""
    anny_neck_planes: tuple[float, float] = (0.655, 0.598)
    """Values of y + 0.5 z, in metres of the base mesh, at which the neck's skinning weight is 0 and 1. They are planes
    slanted like the jaw: one under skull and chin, one above the collar. Set by eye."""
    anny_gaze: tuple[tuple[str, float], ...] = (("Up", 9.8), ("Down", 11.4), ("In", 15.3), ("Out", 15.0))
    """Angles in degrees by which the source's eyeLook face units turn the eyeball. Fitted rigidly, with a residual
    below 0.3 mm."""
    anny_lid_reach: tuple[float, float] = (0.030, 0.045)
    """Distances from the eyeball's centre between which the motion of the lids fades out, in metres. Set by eye."""
    anny_blink: float = 0.8
    """Factor on the source's eyeBlink. It closes the eye at this value (the eyeball is hidden); beyond it the upper lid
    runs through the lower one, by up to 2.3 mm. ARKit's 1 means closed. Measured: closed at 0.78 (log)."""
    anny_lower_teeth_width: float = 0.93
    """Factor on the width of the helper geometry's lower teeth and tongue. They are as wide as the upper teeth and run
    through lip and cheeks. Set by eye."""
    anny_lower_teeth_back: float = 0.002
    """Distance in metres by which both move back, to close behind the upper teeth. Set by eye."""
    anny_tongue_height: float = 0.6
    """Factor on the height of the tongue. It fills the closed mouth up to the palate and looks like a slab in an open
    one. Set by eye (log, "Recipe 5")."""
    anny_tongue_back: float = 0.003
    """Distance in metres by which the tongue moves back as well. Set by eye."""
    anny_collar_steps: int = 24
    """Smoothing steps along the jagged edge of the cut over the shoulders. Set by eye (log, "Recipe 5")."""
    anny_collar_rings: int = 5
    """Number of vertex rings above this edge that follow it. Set by eye."""

    # anny_identity.py
    anny_people: int = 900
    """Number of people sampled. Each counts together with its mirror image, so that the mean is symmetric. Not
    varied."""
    anny_components: int = 80
    """Number of identity directions that are kept. Not varied."""
    anny_local_spread: float = 0.17
    """Standard deviation of a local control, which ranges over -1..1. Measured: 0.35 has twice the variance of real
    people, and 0.17 matches published head measurements (log)."""
    anny_asymmetry: float = 0.25
    """Difference between the two sides of a sided control, as a fraction of its standard deviation. Not varied."""

    # anny_topology.py
    anny_neck_rings: int = 6
    """Rings of vertices below the texture seam around the neck's top at which the neck ends. Set by eye."""
    anny_socket_depth: float = 0.1255
    """Depth in metres in front of which the sockets are kept, into which the lids continue. Set by eye."""
    anny_iris_angle: float = 23.0
    """Angle of the ring of eyeball vertices that is as wide as an iris, in degrees. Geometry of the source."""

    # chart.py
    chart_from: tuple[float, float] = (-0.03, 0.02)
    """Height and depth of the point from which the outside is seen, in metres in the head frame. It is behind the
    mouth. One cylinder instead put nostrils over the lips (log); the place was not varied."""
    chart_flat: float = 0.02
    """Cosine below which a triangle is seen edge-on. Not varied."""

    # flame.py
    flame_largest_coefficient: float = 3.0
    """Bound of an expression coefficient. FLAME's coefficients are in standard deviations. Not varied."""
    flame_iris_radius: float = 0.0061
    """Radius of the iris in metres. Anatomy: it hardly differs between people."""

    # head_parts.py
    mouth_color: tuple[float, float, float] = (0.30, 0.12, 0.11)
    """Colour of the mouth's lining at the lips, in daylight. These seven were set by eye."""
    teeth_color: tuple[float, float, float] = (0.84, 0.80, 0.72)
    """The same of teeth."""
    tongue_color: tuple[float, float, float] = (0.62, 0.34, 0.33)
    """The same of the tongue."""
    mouth_fade: float = 0.016
    """Depth in metres over which light falls to 1 / e on the mouth's lining."""
    teeth_fade: float = 0.030
    """The same on teeth and tongue."""
    lips_depth: float = 0.012
    """Depth behind the lips' front at which the inside of the mouth begins, in metres."""
    darkest_mouth: float = 0.08
    """Share of light that reaches the bottom of the mouth."""

    # mirror.py
    mirror_reach: float = 0.75
    """Distance between a triangle's reflected middle and its mirror image's, in square roots of the triangle's area.
    Not varied."""
    mirror_aligned: float = 0.5
    """Cosine between a reflected normal and the mirror image's normal from which two triangles face alike. Not
    varied."""

    # parts.py
    eyes_margin: float = 0.12
    """Margin around the eyes' regions on each side, relative to the width of the part. Set by eye."""
    mouth_margin: float = 0.2
    """The same around the mouth. Set by eye."""
    part_least_cosine: float = 0.3
    """Smallest cosine between the direction from the head's middle to the part and that from the part to the camera at
    which the part counts as seen. Not varied."""
    part_least_side: int = 8
    """Smallest side of a part's box, in pixels. Smaller parts show nothing. Not varied."""


FACE = FaceConstants()
