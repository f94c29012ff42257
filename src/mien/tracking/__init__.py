"""Fit of the face model to a capture: the tracking, its files, the cut at the neck, and the fixed scoring mask."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
