"""The viewer: an avatar in a browser, drawn by mien's own renderer on the processor.

Session, pictures and the loop that draws know nothing of the browser. Only `server` and `panel` call viser.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
