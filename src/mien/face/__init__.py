"""Face models: parameters in, vertices out.

`model` and `params` are the classes, and `posing` computes vertices natively. `listing` says which models there are,
without torch; `loading` reads them and keeps them in the user's `cache`, and `checks` tests what is read. `models/` has
the families of models. `head_parts` finds hair, skin, eyes and mouth, `chart` makes texture coordinates for a head
without any, and `mirror` finds each triangle's image on the other side.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
