"""What drives an avatar: tracked sequences, recordings of other programs, and the transfer from neutral to neutral."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
