"""Layouts: a tracked capture of mien as the files of other laboratories, for training outside. One file for each.

`registry` lists them and `layout` says what one is. `writing` makes the folder, with README.txt and `scoring`.
"""

from typing import TYPE_CHECKING

from mien.lazy import lazy_names

if TYPE_CHECKING:
    from mien.datasets.layouts.filmed import Filmed, filmed_frames
    from mien.datasets.layouts.layout import Layout, MatteKind, check_new_folder
    from mien.datasets.layouts.registry import LAYOUTS, find_layout
    from mien.datasets.layouts.writing import write_layout
else:
    __getattr__, __dir__ = lazy_names(__name__, __file__)

__all__ = [
    "LAYOUTS",
    "Filmed",
    "Layout",
    "MatteKind",
    "check_new_folder",
    "filmed_frames",
    "find_layout",
    "write_layout",
]
