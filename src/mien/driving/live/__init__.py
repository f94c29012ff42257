"""Driving while it happens: landmarks of a camera's frames become the avatar's face, frame after frame.

`landmark_fit` fits one frame, `one_euro` smooths, and `follower` has the calibration and the way to rest.
"""

from typing import TYPE_CHECKING

from mien.lazy import lazy_names

if TYPE_CHECKING:
    from mien.driving.live.follower import Follower, FollowOptions, State
    from mien.driving.live.landmark_fit import Fitted, LandmarkFit
    from mien.driving.live.one_euro import OneEuro
else:
    __getattr__, __dir__ = lazy_names(__name__, __file__)

__all__ = ["Fitted", "FollowOptions", "Follower", "LandmarkFit", "OneEuro", "State"]
