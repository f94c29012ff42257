"""Numbers that decide how good a capture is and that no setting changes, with how each was chosen.

The log is docs/log.md, "Capture". "Set by eye" means that the result looked right and no figure was recorded; "not
varied" means that the first value worked and no other was measured. After a change that gives another capture, raise
`mien.capture.from_video.RECIPE`.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class CaptureConstants:
    """The constants of this room, by file. What only decides whether a message appears is not here."""

    # crop.py, head_path.py
    crop_margin: float = 1.5
    """Room around all positions of the face for hair, neck and shoulders, in face boxes (eyebrows to chin). Set by
    eye."""
    crop_outliers: float = 1.0
    """Percent of the frames at either end that may lie outside of the crop, so that a false detection does not decide
    it. Not varied."""
    crop_most_aspect: float = 1.25
    """Largest aspect ratio of a picture that counts as a head crop already and is kept whole. Not varied."""
    crop_least_head_share: float = 0.7
    """Least part of such a picture's shorter side that the chosen crop takes. Not varied."""

    # faces.py
    face_confidence: float = 0.5
    """Least score of a found face. MediaPipe's default."""

    # from_cameras.py
    landmarks_most_astray: float = 1.0
    """Largest distance between landmarks and the projected head, in sides of the landmarks' box. Farther ones are taken
    for a false face, for example in hair seen from behind. Not varied."""

    # head_path.py
    head_radius: float = 0.24
    """Radius in metres of the sphere about the middle of the face that a crop of a rig shows: head, hair and neck. Set
    by eye."""
    head_most_miss: float = 0.5
    """Largest distance between a found face and the projected one, in sides of the found box, for the two to agree. Not
    varied: heads agree within 0.15 (log, 11-22)."""
    head_least_angle: float = 0.03
    """Smallest angle between two rays that give a point, in radians. Not varied."""

    # live_camera.py
    live_side: int = 640
    """Longest side in pixels of a camera's pictures that are kept. MediaPipe looks at 192 x 192 pixels around the face.
    Chosen for speed; not varied."""

    # matte.py
    matte_steadiness: float = 0.7
    """Weight of the previous mask where the picture has not changed at all. Not varied."""
    matte_change: float = 0.03
    """Colour difference (0..1) at which that weight has dropped to 1 / e. Not varied."""
    matte_radius: float = 1 / 48
    """Radius of the guided filter's window, as a fraction of the picture's longer side. Not varied."""
    matte_epsilon: float = 1e-4
    """Variance of colour (0..1) below which the guided filter smooths instead of following edges. Measured: at 1e-6 the
    filter is 10 % off on an exactly linear picture, as float32 does not suffice (log)."""
    matte_mask_levels: tuple[float, float] = (0.2, 0.8)
    """Mask values that are background and person for certain. The filter smooths; a soft mask would leave a halo.
    Chosen by eye with the next: together they remove the halo and keep curls (log)."""
    matte_alpha_levels: tuple[float, float] = (0.08, 0.92)
    """Filtered values that become 0 and 1. Without this the filter's overshoot would leave a veil and holes."""

    # pace.py
    rate_tolerance: float = 0.01
    """Relative difference up to which the measured frame rate is taken for the file's nominal one. Not varied."""
    rate_steady_ratio: float = 1.6
    """Ratio to the median up to which times between frames count for the rate. It is above 1.5, which films at 24
    frames a second have on a grid of 60: they alternate between two and three steps."""

    # parts.py, survey.py
    cut_reach: int = 3
    """Frames on either side of a cut that must all differ. After a flash, the picture from before it comes back. All
    numbers of cuts were judged together: no false cut in 1,341 real frames, and all spliced shots found (log)."""
    cut_neighbors: int = 4
    """Frames on either side of a cut in which the picture may change only a little: motion lasts longer than a cut."""
    cut_least_change: float = 0.05
    """Smallest change at a cut, as a fraction of the mean brightness."""
    cut_least_contrast: float = 3.0
    """Factor by which the change at a cut exceeds the changes beside it."""
    cut_blocks: tuple[int, int] = (3, 4)
    """Rows and columns of blocks. The change is that of half of the blocks, or of the face's place if that is larger.
    The quarter that changes most also has captions in it, which cost 47 to 67 % of the frames of such videos."""
    cut_thumbnail: tuple[int, int] = (32, 18)
    """Width and height in pixels of the thumbnails that are compared, whatever the picture's shape. Not varied."""

    # people.py, survey.py
    person_most_move: float = 0.6
    """Sides of a face by which it moves at most from one frame to the next. Not varied."""
    person_most_growth: float = 1.6
    """Factor by which a face grows or shrinks at most from one frame to the next. Not varied."""
    person_most_gap: float = 1.0
    """Seconds without detection after which a face that comes back starts a new track. Not varied."""
    person_most_size_ratio: float = 2.5
    """Factor by which the same person's face is larger or smaller at most when it comes back. Not varied."""
    person_most_color_change: float = 0.12
    """Largest difference of the mean colours (0..1) of the same person's face when it comes back. Not varied."""
    person_color_cells: int = 3
    """Cells along each side of the grid on which a face's mean colours are computed. Not varied."""
    person_least_frames: int = 3
    """Frames below which a track counts as a false detection, in clips of at least as many frames. Not varied."""

    # matte_owner.py
    matte_apart_distance: float = 0.02
    """Distance from the person, as a fraction of the longer side, from which a region of the matte is not theirs. Set
    by eye on d14 and s18, with the next two."""
    matte_apart_most_area: float = 0.25
    """Area of such a region, in areas of the person's, up to which it goes: shoulders below a covered neck stay."""
    matte_bridge: float = 0.008
    """Half of the width of what does not join two regions, in longer sides: ends of hair reach to d14's bottle."""
    matte_held_frames: int = 12
    """Frames before and after in which another face still counts where it is not found. Not varied."""

    # same_person.py; chosen on thirds of the seven reference clips, which show seven people (log)
    identity_pictures: int = 48
    """Pictures of a capture, spread evenly, of which shapes of faces are compared. Not varied."""
    identity_most_pairs: int = 8
    """Pairs of pictures that are compared, those of the most similar poses. Not varied."""
    identity_least_pairs: int = 3
    """Pairs below which nothing is said. Not varied."""
    identity_most_turn: float = 0.35
    """Angle in radians between the poses of two pictures up to which they are compared."""
    identity_noise: float = 1e-3
    """Variance of a coordinate, added to the spread within clips, in units of the face's size."""
    identity_most_difference: float = 3.1
    """Largest difference of one person's faces. Thirds of a clip differ by up to 2.7, two people by 3.5 or more."""
    identity_near_turn: float = 0.15
    """Angle up to which that holds; the estimated shape follows the pose..."""
    identity_turn_allowance: float = 20.0
    """...and this much more difference is allowed for each radian beyond."""
    identity_neighbors: int = 4
    """Most captures of a workspace that a new one is compared with. Not varied."""
    identity_noise: float = 3e-4
    """Variance of a coordinate below which the spread within a clip is not trusted, in units of the face's size."""
    identity_most_difference: float = 4.6
    """Difference up to which two captures show one person. Halves of a clip differ by at most 3.3, people by 5.4."""

    # plate.py
    plate_person_level: float = 0.9
    """Value of the person mask from which it is trusted away from its border. All numbers of plates were set by eye."""
    plate_background_level: float = 0.05
    """Value of the person mask up to which it is trusted away from its border."""
    plate_core: float = 1 / 40
    """Width of the border inside the certain person in which the plate decides, as a fraction of the longer side."""
    plate_halo: float = 1 / 12
    """Width of the border outside of it, for hair that the mask misses, as a fraction of the longer side."""
    plate_levels: tuple[float, float] = (2.5, 7.0)
    """Colour differences that become 0 and 1, in standard deviations of the background's noise."""
    plate_doubt: tuple[float, float] = (2.0, 0.25)
    """Factors on the two levels where the mask says background (raised) and where it says person (lowered)."""
    plate_least_noise: float = 0.008
    """Least standard deviation of the background's noise (colours are 0..1)."""
    plate_shadow: float = 0.35
    """Weight of a difference that only darkens: it may be the person's shadow on the wall."""
    plate_darkest_shadow: float = 0.5
    """Share of the light that a shadow leaves at least."""
    plate_shift_size: int = 256
    """Longest side in pixels of the pictures that tell how the camera has shifted."""
    plate_most_shift: float = 8.0
    """Largest shift of the camera in pixels at that size."""
    plate_shift_gain: float = 0.9
    """A shift is accepted if it brings the background's difference below this part of its former value."""
    plate_gains: tuple[float, float] = (0.7, 1.4)
    """Range of the gain that matches the plate's exposure to the picture's."""

    # process.py
    lead_in: int = 8
    """Frames before a chunk that set up the detectors' state. Measured: landmarks are off by 0.8 to 1.6 px in the first
    frame, by 0.1 px after 2, and by no more than their noise after 4 (log)."""
    face_most_distance: float = 0.6
    """Largest distance between the centres of landmarks and of the followed face, as a part of the face's longer side.
    Not varied: it refuses no good face (log)."""
    face_most_age: int = 12
    """Frames for which the last landmarks predict the face's position if the survey did not find it. Not varied."""

    # quality.py
    sharpness_side: int = 192
    """Side in pixels to which the face is scaled to measure its sharpness, so that its distance hardly matters.
    Measured: with 128, a blur of 8 % of the face's width is missed (log; the measure changed as well)."""
    least_sharpness: float = 0.65
    """Part of the clip's median sharpness below which a frame counts as blurred and is not trained on. Measured: a
    motion by 4 % of the face's width causes that, or by 5 pixels in a face of 130. Turned heads and closed eyes stay
    above it (log)."""

    least_light_change: float = 1.35
    """Factor by which the face's brightness changes over time from which the light counts as changing, and training
    learns a gain for each frame. Measured: seven clips in steady light have up to 1.17 (log)."""

    # screen.py; all set by eye
    screen_least_level: float = 0.2
    """Least level of a screen's brightest channel, 0..1."""
    screen_most_red: float = 0.7
    """Most red of a screen, relative to its brightest channel. Skin has most of red."""
    screen_least_saturation: float = 0.45
    """Least difference of a screen's channels, relative to the brightest."""
    screen_most_difference: float = 0.15
    """Largest difference of a screen's channels, relative to the brightest one, from their median."""
    screen_least_share: float = 0.8
    """Part of the border that has the screen's tint at least."""
    screen_levels: tuple[float, float] = (0.08, 0.9)
    """Shares of what is not screen that become 0 and 1. Skin at the edges has some of the screen's light."""
    screen_inside_most: float = 0.6
    """Share of screen up to which a pixel inside the person's mask is opaque: green eyes and stripes make no holes."""
    screen_spill: float = 1 / 40
    """Width of the edge that loses the screen's light, as a fraction of the longer side; at twice that nothing does."""
    screen_window: float = 1 / 6
    """Side of the window in which the screen's light is averaged, as a fraction of the longer side."""

    # survey.py
    survey_side: int = 512
    """Longest side in pixels of the pictures in which faces are searched. The detectors see at most 192 pixels. Chosen
    for speed; not varied."""

    # tone.py
    hdr_white: float = 203.0
    """Light in cd/m2 of diffuse white in HDR. ITU-R BT.2408."""
    hdr_peak: float = 1000.0
    """Brightest light in cd/m2 that is shown below white. The peak of BT.2100's nominal HLG display."""
    hdr_knee: float = 0.75
    """Share of diffuse white above which light is compressed. Set by eye."""


CAPTURE = CaptureConstants()
