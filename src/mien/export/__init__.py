"""Avatars and posed Gaussians as files for other programs, with a `read_*` beside each `write_*`."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
