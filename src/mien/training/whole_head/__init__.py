"""Heads become whole here: sides, hair and the mouth interior, where training pictures show too little of them."""

from typing import TYPE_CHECKING

from mien.lazy import lazy_names

if TYPE_CHECKING:
    from mien.training.whole_head.completion import complete_colors, vertex_means
    from mien.training.whole_head.mouth_interior import prepare_inside
    from mien.training.whole_head.outline_fit import fitted_faces
    from mien.training.whole_head.part import prepare_whole_head
    from mien.training.whole_head.soft_cut import shares_left, with_soft_cut
else:
    __getattr__, __dir__ = lazy_names(__name__, __file__)

__all__ = [
    "complete_colors",
    "fitted_faces",
    "prepare_inside",
    "prepare_whole_head",
    "shares_left",
    "vertex_means",
    "with_soft_cut",
]
