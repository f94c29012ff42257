"""Recipes of synthetic captures: what a capture shows, and the recipes with names."""

import tomllib
from dataclasses import asdict, dataclass, field
from importlib.resources import files
from typing import Any, Literal

PEOPLE: dict[str, Any] = tomllib.loads(files("mien.lab.synthetic").joinpath("people.toml").read_text(encoding="utf-8"))
"""The tables of the drawn people: expressions, colours, shared recipes and reference captures."""
SIDES: dict[str, tuple[float, float]] = {
    **{f"{side}-{angle}": (sign * angle, 0.0) for angle in (15, 30, 45, 60, 90)
       for side, sign in (("left", 1.0), ("right", -1.0))},
    "behind-180": (180.0, 0.0), "above-25": (0.0, 25.0), "below-25": (0.0, -25.0),
}  # fmt: skip
"""Cameras at the side: azimuth towards the subject's left and elevation above the face, in degrees from the front
camera."""
OBLIQUE: dict[str, tuple[float, float]] = {"left-20": (20.0, 0.0)}
"""The camera that sees posed faces beside the front camera, in the same angles."""

SegmentKind = Literal["still", "speech", "expressions", "turns", "free"]


@dataclass(frozen=True)
class Segment:
    """One part of a clip's script."""

    kind: SegmentKind
    """still: nothing moves, not even an eye. speech: talking. expressions: posed expressions, each held. turns: wide
    turns of the head to all sides. free: talking, smiles and frowns in any order. All but `still` have blinks."""
    seconds: float


@dataclass(frozen=True)
class Detail:
    """Details that photographs have and plain drawings lack."""

    pores: float = 1.0
    """Strength of pores, fine lines and mottling of the skin; 0 looks like wax."""
    wet_eyes: bool = True
    """Whether lamps have highlights on cornea and lid rims."""
    shadows: bool = True
    """Whether hair, nose, brow and chin cast soft shadows and ambient occlusion."""
    compression: int = 18
    """x264's constant rate factor when the clip is written as a video (0 is lossless, 51 worst)."""


@dataclass(frozen=True)
class SyntheticRecipe:
    """Everything besides the seed that decides a synthetic capture."""

    name: str = "demo"
    """Name of the sequence."""
    face_model: str = "anny"
    """Name of the face model, for `mien.face.load_face_model`."""
    width: int = 512
    height: int = 512
    seconds: float = 9.0
    fps: float = 25.0
    focal: float = 2.35
    """Focal length in picture widths."""
    distance: float = 1.0
    """Distance from the camera to the head, in metres."""
    identity_scale: float = 0.8
    """Standard deviation of the identity coefficients; 0 is the mean person."""
    hair: Literal["none", "short", "long"] = "short"
    """Hair on the scalp as strands, which are not part of the face model."""
    glasses: bool = True
    """Whether the person wears glasses, which are not part of the face model."""
    brows_and_lashes: bool = True
    """Whether brows and lashes have strands of hair on top of the painted ones."""
    clothes: bool = True
    """Whether there are shoulders and a shirt below the neck."""
    stubble: float = 0.0
    """Strength of stubble that is painted on the skin, 0..1."""
    beard: float = 0.0
    """Length of a full beard of strands in metres; 0 for none. It is not part of the face model."""
    off_model: float = 0.0
    """Distance of head shape and expressions from the face model's space: 1 is far, 0 is none."""
    make_up: float = 0.0
    """Strength of make-up, 0..1: red lips, dark lids and lines of the eyes, filled brows."""
    cameras: Literal["front", "ring", "sides", "oblique"] = "front"
    """front: one camera in front of the face. ring: `ring_size` calibrated cameras on half a sphere, the first in
    front. sides, oblique: the front camera and those of `SIDES` or `OBLIQUE`, calibrated."""
    ring_size: int = 16
    script: tuple[Segment, ...] = ()
    """The script, part by part; it replaces `seconds`. If empty, there is one `free` part."""
    detail: Detail = field(default_factory=Detail)
    rotation: tuple[float, float, float] = (25.0, 12.0, 8.0)
    """Largest yaw, pitch and roll of the head outside of turns, in degrees."""
    turns: tuple[float, float] = (60.0, 26.0)
    """Largest yaw and pitch in the script's turns, in degrees."""
    translation: tuple[float, float, float] = (0.02, 0.012, 0.04)
    """Largest shift sideways, upwards and in depth, in metres."""
    expression: float = 1.0
    """Scale of speech, smiles and brow raises; 0 keeps the face neutral except for blinks."""
    blinks: bool = True
    """Whether the eyes blink and make saccades."""
    noise: float = 0.004
    """Standard deviation of the camera's noise, with pixels in 0..1."""
    supersample: int = 2
    """Samples along each side of a pixel."""
    texture_size: int = 1536
    """Texels along each side of the skin's textures."""

    @property
    def timesteps(self) -> int:
        """The number of frames."""
        seconds = sum(segment.seconds for segment in self.script) if self.script else self.seconds
        return max(round(seconds * self.fps), 1)

    @property
    def camera_ids(self) -> tuple[str, ...]:
        """Names of the cameras."""
        if self.cameras == "ring":
            return tuple(f"{index:02d}" for index in range(self.ring_size))
        return ("front", *self.angles)

    @property
    def angles(self) -> dict[str, tuple[float, float]]:
        """The cameras beside the front camera that stand at fixed angles, by name."""
        return {"sides": SIDES, "oblique": OBLIQUE}.get(self.cameras, {})

    @property
    def record(self) -> dict[str, Any]:
        """The recipe for keys. What was added later is left out where it is not used, so that keys stay."""
        return {name: value for name, value in asdict(self).items() if name != "make_up" or value}


RECIPES: dict[str, SyntheticRecipe] = {
    "demo": SyntheticRecipe(),
    "plain": SyntheticRecipe(name="plain", seconds=4.0, hair="none", glasses=False, noise=0.0),
}
"""Named recipes."""
