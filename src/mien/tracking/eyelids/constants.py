"""Numbers of finding eyelids and irises in crops of the eyes."""

from dataclasses import dataclass


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
