"""Avatars: functions from face parameters to Gaussians. Each method has a folder."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
