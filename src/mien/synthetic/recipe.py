"""What a synthetic capture shows, and the recipes that have a name."""

from dataclasses import dataclass
from typing import Literal


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
    hair: Literal["none", "short"] = "short"
    """Strands on the scalp, which the face model does not know."""
    glasses: bool = True
    """Frame and lenses, which the face model does not know."""
    brows_and_lashes: bool = True
    """As strands of hair, on top of the painted ones."""
    clothes: bool = True
    """Shoulders and a shirt below the neck."""
    stubble: float = 0.0
    """Of a beard, painted on the skin, 0..1."""
    rotation: tuple[float, float, float] = (25.0, 12.0, 8.0)
    """Largest yaw, pitch and roll of the head, degrees."""
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
        return max(round(self.seconds * self.fps), 1)


RECIPES: dict[str, SyntheticRecipe] = {
    "demo": SyntheticRecipe(),
    "plain": SyntheticRecipe(name="plain", seconds=4.0, hair="none", glasses=False, noise=0.0),
}
"""By name."""
