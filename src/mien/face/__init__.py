"""Face models: parameters in, vertices out.

`model` and `params` are the classes; `posing` computes vertices natively, and `parts` finds eyes and mouth in pictures.
`listing` says which models there are, without torch; `loading` reads them and keeps them
in the user's `cache`, and `checks` tests what is read. `models/` has the families of models. `chart` makes texture
coordinates for a head without any, and `mirror` finds each triangle's image on the other side.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
