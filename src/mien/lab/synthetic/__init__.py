"""Synthetic captures with exact ground truth: heads that are drawn instead of filmed.

The order of the files:

- `recipe` says what a capture shows; `references` are the fixed recipes that figures are measured on.
- `motion` makes the face parameters of every timestep from the recipe's script; `posing` turns them into vertices.
- `subject` builds the person on the face model: `anatomy` measures the head; `skin`, `hair`, `facial_hair` and
  `accessories` cover it; `off_model` bends it beyond the face model.
- `painter` draws the posed person with the light and the materials of `shading`. `arithmetic` has the noise and the
  ramps of all of these.
- `scene` joins them into frames; `captures` writes whole captures; `truth` stores what is known exactly.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
