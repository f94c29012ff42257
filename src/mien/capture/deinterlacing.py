"""The choice of frames to deinterlace, apart from `fields`, so that options need no decoder."""

from typing import Literal

Deinterlace = Literal["auto", "always", "never"]
