"""What a synthetic capture shows, and the recipes that have a name."""

from dataclasses import dataclass, field
from typing import Literal

SegmentKind = Literal["still", "speech", "expressions", "turns", "free"]


@dataclass(frozen=True)
class Segment:
    """One part of a clip's script."""

    kind: SegmentKind
    """still: nothing moves, not even an eye; speech: talk; expressions: posed ones, each held; turns: wide turns of
    the head to all sides; free: talk, smiles and frowns as they come. Blinks come in all but `still`."""
    seconds: float
    """Length."""


@dataclass(frozen=True)
class Detail:
    """What photographs have and plain drawings have not."""

    pores: float = 1.0
    """Strength of pores, fine lines and mottling of the skin; 0 for wax."""
    wet_eyes: bool = True
    """Highlights of the lamps on cornea and lid rims."""
    shadows: bool = True
    """Soft shadows and ambient occlusion from hair, nose, brow, chin."""
    compression: int = 18
    """x264's constant rate factor where the clip becomes a video (0 lossless, 51 worst)."""


@dataclass(frozen=True)
class SyntheticRecipe:
    """Everything that decides a synthetic capture, besides the seed."""

    name: str = "demo"
    """Of the sequence."""
    face_model: str = "anny"
    """For `mien.face.load_face_model`."""
    width: int = 512
    """Pixels."""
    height: int = 512
    """Pixels."""
    seconds: float = 9.0
    """Length of the clip."""
    fps: float = 25.0
    """Frames a second."""
    focal: float = 2.35
    """Focal length in picture widths."""
    distance: float = 1.0
    """From the camera to the head, metres."""
    identity_scale: float = 0.8
    """Standard deviation of the identity coefficients; 0 is the mean person."""
    hair: Literal["none", "short", "long"] = "short"
    """Strands on the scalp, which the face model does not know."""
    glasses: bool = True
    """Frame and lenses, which the face model does not know."""
    brows_and_lashes: bool = True
    """As strands of hair, on top of the painted ones."""
    clothes: bool = True
    """Shoulders and a shirt below the neck."""
    stubble: float = 0.0
    """Of a beard, painted on the skin, 0..1."""
    beard: float = 0.0
    """Length of a full beard of strands, metres; 0 for none. The face model does not know it."""
    off_model: float = 0.0
    """How far head shape and expressions leave what the face model can represent; 1 is far, 0 not at all."""
    cameras: Literal["front", "ring"] = "front"
    """front: one camera before the face; ring: `ring_size` calibrated ones on half a sphere, the first in front."""
    ring_size: int = 16
    """Number of cameras of a ring."""
    script: tuple[Segment, ...] = ()
    """What happens, part by part; `seconds` is then not used. Empty: one `free` part."""
    detail: Detail = field(default_factory=Detail)
    rotation: tuple[float, float, float] = (25.0, 12.0, 8.0)
    """Largest yaw, pitch and roll of the head, degrees, but in turns."""
    turns: tuple[float, float] = (60.0, 26.0)
    """Largest yaw and pitch in the script's turns, degrees."""
    translation: tuple[float, float, float] = (0.02, 0.012, 0.04)
    """Largest shift to the side, upwards and in depth, metres."""
    expression: float = 1.0
    """Scale of speech, smiles and brow raises; 0 keeps the face neutral but for blinks."""
    blinks: bool = True
    """Blinks and saccades of the eyes."""
    noise: float = 0.004
    """Standard deviation of the camera's noise, of 0..1."""
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
        return ("front",) if self.cameras == "front" else tuple(f"{index:02d}" for index in range(self.ring_size))


RECIPES: dict[str, SyntheticRecipe] = {
    "demo": SyntheticRecipe(),
    "plain": SyntheticRecipe(name="plain", seconds=4.0, hair="none", glasses=False, noise=0.0),
}
"""By name."""
