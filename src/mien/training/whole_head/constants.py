"""Numbers that decide how whole heads look and that no setting changes, with how each was chosen.

The log is docs/log.md, "Whole head". "Not varied" means that the first value worked and no other was measured.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class WholeHeadConstants:
    """The constants of this room, by the file that uses them. `benchmarks/ablate.py` measures what one is worth."""

    # back_hair.py
    back_hair_least_height: float = 0.015
    """Median height at a level of jaw and neck, in metres, from which hair counts as hanging. Measured: 41 to 70 mm on
    two drawn people with long hair, and 15 mm at most on those with short hair."""
    back_hair_least_distance: float = 0.8
    """Least distance from the axis at the sides, as a share of that of the hair above, at which hair hangs. Not
    varied."""
    back_hair_level: float = 0.01
    """Height of the levels at which the sides are looked at, in metres. Hair has to hang at each from the scalp down.
    Not varied."""
    back_hair_beside: float = 35.0
    """Angle from the sides, in degrees, within which the pictures' outline tells how far hair hangs. Not varied."""
    back_hair_alike: float = 15.0
    """Difference of angle about the axis, in degrees, within which hair above decides about hair below. Not varied."""
    back_hair_most_forward: float = 0.0
    """Forward part of a triangle's normal up to which it is behind. Geometry: hair in front of the shoulders is not
    made up."""
    back_hair_cut_clearance: float = 0.006
    """Least distance of hair from the cut at the neck, in metres. Not varied."""

    # completion.py
    color_spread: float = 0.12
    """Distance between colours (0..1) over which a colour stops counting as skin or as hair. Not varied."""
    tint_spread: float = 0.06
    """The same for colours of equal brightness. Chosen with the rule (log, 11-22); not varied alone."""
    light_spread: float = 0.25
    """The same for the logarithm of their brightness beyond half or twice. Chosen with the rule; not varied alone."""
    different_colors: float = 0.10
    """Distance between the medians of skin and hair from which their colours can be told apart. Not varied."""
    largest_offset: float = 0.25
    """Largest difference of brightness between a triangle and its mirror image that counts as light, and between a
    triangle and its neighbours that counts as texture. Not varied."""
    least_light: float = 0.1
    """Least light by which colours are divided. Not varied."""

    # contribution.py
    hidden_contribution: float = 0.03
    """Contribution below which a Gaussian counts as hidden, in pixels of the training picture that shows it best. Not
    varied. Of the Gaussians of a run, 40 % were below 1/8 (log, 11-24)."""

    # hair_height.py
    hair_frames: int = 60
    """Number of evenly spread frames whose outlines are measured. Not varied."""
    hair_step: float = 0.002
    """Distance between the points that are tested above the scalp, in metres. Not varied."""
    hair_highest: float = 0.08
    """Largest height of hair that counts, in metres. Not varied."""
    hair_grazing: float = 0.4
    """Cosine between a triangle's normal and the direction to the camera up to which the outline tells its height. Not
    varied."""
    hair_outline_clearance: float = 0.008
    """Height in metres at which nothing of the mesh may be behind or in front of a triangle at the outline. Not
    varied."""
    hair_quantile: float = 0.3
    """Share of the measured heights below the one that counts. Single strands and other things behind make some
    higher. Measured: 0.2 is as good on short hair, and 0.3 dB worse at 15 degrees on long hair (log, 11-24)."""
    hair_guess_limit: float = 1.3
    """Largest height where nothing was measured, as a multiple of the median height on top of the head. Measured
    against no limit on three drawn people: short hair loses up to .005 of overlap, long hair gains .012 to .018."""
    hair_slope: float = 0.12
    """Difference of slope (the upward part of a normal) within which measured heights count alike for what is never
    measured. Chosen with the rule (log, 11-24); not varied alone."""
    hair_slope_distance: float = 0.03
    """Distance in metres within which they do. Chosen with the rule; not varied alone."""
    hairline_height: float = 0.004
    """Largest height in metres at the hairline where nothing was measured. Chosen with the rule (log, 11-24); not
    varied alone."""
    hairline_rise: float = 0.4
    """How much this height grows per metre from skin. Chosen with the rule; not varied alone."""
    hair_smoothing_rounds: int = 2
    """Rings of triangles over which heights are averaged. Measured: 80 flatten the hair on top (3.3 instead of 2.6 mm
    of error; log, 11-24)."""
    hairline_fading_rounds: int = 2
    """Rings of triangles over which the height fades at the hairline. Chosen with the smoothing, instead of 6."""
    hanging_hair_rounds: int = 4
    """Rings of triangles around an outline that hanging hair may cover too. Not varied."""

    # hair_surface.py
    hair_every: int = 8
    """Number of training frames from one correction of the hair's surface to the next. Not varied."""
    hair_begin: float = 0.03
    """Time of the first correction, as a fraction of the run. Not varied."""
    hair_end: float = 0.6
    """Time of the last correction, as a fraction of the run. Their size falls to 0 until then. Not varied."""
    hair_reach: float = 0.012
    """Distance in metres over which gradients are smoothed (standard deviation of a Gaussian). Measured: 0.1 dB more at
    30 to 60 degrees than 20 mm with smaller corrections, which does not decide anything (log, 11-24)."""
    hair_same_side: float = 0.3
    """Cosine between two normals from which triangles belong to the same side of a fold. Not varied."""
    hair_first_decay: float = 0.9
    """Decay of the running mean of the gradient. Of the paper (Adam, Kingma and Ba 2015)."""
    hair_second_decay: float = 0.98
    """Decay of the running mean of its square. Shorter than the paper's 0.999, as there are few corrections. Not
    varied."""
    hair_lowest_shift: float = -0.004
    """How far hair may sink below the scalp, in metres. Not varied."""
    hair_furthest_shift: float = 0.03
    """How far it may move at all, in metres. Not varied."""

    # mouth_interior.py
    mouth_closed_at: float = 0.5
    """Time at which an open surface inside the mouth is closed, as a fraction of the run. It is after the last opacity
    reset of the presets, from which surface that is hardly ever seen does not recover. Measured against the first step
    only (log, "Mouth")."""

    # side_views.py
    side_views_every: int = 8
    """Number of steps between two side views. Views of raised expressions take turns with those from the side.
    Measured: 16 with twice the weights has the same PSNR, but 2 to 9 % more ST-LPIPS from the side (log, 11-27)."""
    side_views_size: int = 256
    """Longer side of these pictures, in pixels. Not varied: the completed colours are no finer."""
    side_views_least_angle: float = 45.0
    """Smallest angle by which the head turns to the side, in degrees. Pictures know the outline nearer to the front
    better. Chosen instead of 30 together with other changes (log, 11-24); not varied alone."""
    side_views_most_angle: float = 180.0
    """Largest such angle. Geometry: the back of the head."""
    raised_most_angle: float = 45.0
    """Largest angle at which a raised expression is seen, in degrees. Not varied."""
    raised_coefficients: int = 6
    """Number of coefficients that are raised. Not varied."""
    raised_free_difference: float = 0.06
    """Difference of colour (0..1) between an avatar and the completed mesh that costs nothing in raised expressions.
    The mesh knows neither hair nor pores. Not varied."""
    raised_change_weight: float = 8.0
    """Factor on the method's penalty of changes with the expression, in raised ones. Measured on d3: without it, skin
    is blotched; 80 has 0.35 dB less in front (log, 11-26)."""
    side_views_outline_weight: float = 3.0
    """Weight of the difference of alpha from the side against that of colours. Most errors from the side are at the
    outline. Measured: 10 has 0.4 dB less at 30 degrees, 1 has 0.3 less at 90 (log, 11-24)."""

    # spreading.py
    spread_nearest: int = 24
    """Number of known triangles that a value spreads from before it is smoothed. Not varied."""
    spread_softness: float = 0.004
    """Distance in metres within which known triangles count alike. Not varied."""
    spread_own: float = 0.7
    """Knowledge (0..1) from which smoothing begins with a triangle's own value. Not varied."""
    spread_rounds: int = 80
    """Number of times that values are averaged over neighbours. Not varied."""
    spread_hold: float = 4.0
    """Weight of a known value against the mean of its neighbours while values spread. Not varied."""

    # outline_fit.py
    outline_frames: int = 48
    """Largest number of frames whose outlines are looked at. Not varied."""
    outline_frames_at_once: int = 6
    """Number of frames in one round of the descent. Not varied."""
    outline_rounds: int = 160
    """Number of rounds. Measured: 240 leave as much of the mesh outside (log, 11-26)."""
    outline_rate: float = 0.0012
    """First step of the descent in metres. It falls to 0. Chosen with the number of rounds."""
    outline_free: float = 1.0
    """Distance in pixels from the matte up to which a vertex counts as inside. Not varied."""
    outline_robust: float = 0.003
    """Distance in metres beyond which the pull on a vertex grows no more. A frame can be tracked wrongly. Not
    varied."""
    outline_reach: float = 0.014
    """Distance in metres over which the mesh moves together (standard deviation of a Gaussian). Geometry: an ear has
    60 by 35 mm. Not varied."""
    outline_spacing: float = 0.012
    """Distance in metres between the points that are moved. Not varied."""
    outline_shift_weight: float = 0.5
    """Weight of the mean square of all shifts in metres, against the mean pull. It makes the smallest change win.
    Measured: 2 leaves 0.2 to 0.5 % of the mesh outside on s18, d14 and d6, 0.5 leaves 0.1 to 0.3 %, 0.1 leaves 0.02 to
    0.1 % and moves an ear by 12 mm (log, 11-26)."""
    outline_bend_weight: float = 4.0
    """Weight of the mean square of how far a point of the scalp moves from what is around it, in metres. Measured on
    s18, where a crown of 12 mm was cut flat: 2 leaves it a little flat, 8 leaves 0.05 instead of 0.01 % of the mesh
    outside. The other six clips do not change (log, 11-27)."""
    outline_scalp_reach: float = 0.04
    """Distance in metres over which points of the scalp count as around each other (standard deviation of a Gaussian).
    Not varied."""
    outline_scalp_held: float = 0.1
    """Share of `outline_shift_weight` that holds the scalp. Not varied."""

    # unseen.py
    unseen_confidence: float = 0.02
    """Confidence below which a triangle is made up. Measured: 0.01 and 0.1 differ by 0.1 dB at most, from the front to
    90 degrees; 0.02 was chosen between them (11-23)."""
    outline_band: float = 0.025
    """Distance in metres from what pictures show up to which unseen triangles are trained. Hair above them is on the
    outline. Measured (1,600 steps): without a band, the heads of d3, d9 and wojtek have 0.7, 0.3 and 0.1 dB less; with
    50 mm, or with no fills at all, d3 has 0.1 dB more (log, 11-26)."""
    height_frames: int = 48
    """Largest number of frames in which the mesh is drawn as high as its hair, to find what they show of hair. Not
    varied."""
    soft_cut_width: float = 0.03
    """Distance from the neck cut over which opacity fades where a head is shown, in metres. 2 to 4 cm were looked at on
    four clips; with 2 cm, the end of a bare neck is tufted."""
    soft_cut_power: float = 1.5
    """Power of the fading share. Gaussians lie over each other, and together hide more than each alone: with 1, the end
    of the neck is jagged over dark backgrounds; with 3, half of the neck goes. Looked at on seven clips."""
    soft_cut_off_skin: tuple[float, float] = (0.005, 0.012)
    """Distances from the mesh up to which nothing stands off the skin, and from which on what does so is not shown just
    above the cut, in metres. With 3 to 8 mm, necks themselves thin out. Looked at on seven clips."""
    soft_cut_collar: tuple[float, float] = (0.025, 0.05)
    """Heights above the cut below which what stands off the skin goes, and from which on it stays, in metres. With 5 to
    8 cm, long hair (d3, s18) is bitten off beside the neck."""
    soft_cut_head: tuple[float, float] = (0.008, 0.02)
    """Distances from the vertices of the head without its neck up to which nothing is cut off, and from which on the
    cut counts alone, in metres. A chin may reach below the cut. Set by eye."""
    soft_cut_least: float = 1e-4
    """Least opacity after the soft cut. Not varied."""
    mouth_frames: int = 240
    """Number of frames in which the inside of the mouth is looked for. Not varied."""
    mouth_shown_share: float = 0.02
    """Share of these frames that have to show a triangle of it. Not varied."""
    moving_widening: float = 3.0
    """Factor on the limits to the surface at regions that move most, and inside the mouth. The tracked mesh is
    millimetres off there, and its folds are not those of the skin. Measured on wojtek (256 px, 11-23): 2.5 and 3 have
    the same mouth, 4 has 0.15 dB more there, and 0.1 dB less in all."""
    moving_near: tuple[float, float] = (0.008, 0.024)
    """Distances in metres from these regions between which the factor falls to 1. Measured on wojtek (256 px, 11-23):
    the mouth has 0.25 dB more than with a factor in the regions alone."""
    strands_least_height: float = 0.003
    """Height of hair in metres from which made-up hair has strands. Not varied."""
    fill_contradiction: float = 1e-6
    """Gradient of a centre, in triangle units, from which pictures contradict the height of a fill. A little light
    shines through every avatar, so smaller gradients reach what is hidden. Chosen instead of 3e-6 together with other
    changes (11-23); not varied alone."""
    fill_alpha_weight: float = 1.0
    """Least weight of the loss of alpha. Without it, white Gaussians hide fills that stand out beyond the outline, and
    white shines through hair. Measured on wojtek's head, 12,000 steps over white: 0.2, 0.5 and 1 have 30.3 to 30.4 dB
    over white, and 26.4, 27.9 and 28.7 over dark blue. Growth at half the gradient, used with 1 alone, is
    0.3 of it at most (log, 11-28)."""


WHOLE_HEAD = WholeHeadConstants()
