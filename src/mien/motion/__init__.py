"""Motion recorded by other programs, with one reader for each format."""

from mien.motion.blendshape_json import read_blendshape_json
from mien.motion.live_link_face import read_live_link_face
from mien.motion.motion import ARKIT_NAMES, Motion

__all__ = ["ARKIT_NAMES", "Motion", "read_blendshape_json", "read_live_link_face"]
