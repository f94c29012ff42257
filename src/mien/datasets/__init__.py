"""Datasets: folders of other programs and laboratories, each with the file that recognises and reads it.

`registry` lists them and `dataset` says what one is. Readers use `content`, and `sequences` makes what they return.
`writing` puts that into a workspace.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
