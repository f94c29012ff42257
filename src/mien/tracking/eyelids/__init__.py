"""Eyelids, placed from the colours of each eye."""

from mien.tracking.eyelids.placing import place_lids

__all__ = [
    "place_lids",
]
