"""What drives an avatar: tracked sequences, recordings of other programs, and the transfer from neutral to neutral."""

from typing import TYPE_CHECKING

from mien.lazy import lazy_names

if TYPE_CHECKING:
    from mien.driving.drivers import Driver, read_recording, read_tracked_driver
    from mien.driving.expression_map import ExpressionMap, fit_expression_map
    from mien.driving.keeping import keep_to_filmed
    from mien.driving.motion import ARKIT_NAMES, Motion
    from mien.driving.neutral import with_neutral
    from mien.driving.rest import facing, rest_before, rest_of
    from mien.driving.sources.blendshape_json import read_blendshape_json
    from mien.driving.sources.live_link_face import read_live_link_face
    from mien.driving.transfer import drive, face_of_motion
else:
    __getattr__, __dir__ = lazy_names(__name__, __file__)

__all__ = [
    "ARKIT_NAMES",
    "Driver",
    "ExpressionMap",
    "Motion",
    "drive",
    "face_of_motion",
    "facing",
    "fit_expression_map",
    "keep_to_filmed",
    "read_blendshape_json",
    "read_live_link_face",
    "read_recording",
    "read_tracked_driver",
    "rest_before",
    "rest_of",
    "with_neutral",
]
