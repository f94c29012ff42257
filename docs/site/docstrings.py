"""Sphinx extension: the Google sections of docstrings become fields.

It does what `sphinx.ext.napoleon` does, but leaves the docstrings of fields and constants alone. Napoleon takes what is
before their first colon for a type.
"""

from typing import Any, cast

from sphinx.application import Sphinx
from sphinx.ext.napoleon import Config, GoogleDocstring

_CONFIG = Config(napoleon_use_rtype=False)
_WITH_SECTIONS = ("module", "class", "exception", "function", "method")


def sections(app: Sphinx, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    """Replace the sections of a docstring, in place."""
    if what in _WITH_SECTIONS:
        lines[:] = GoogleDocstring(list(lines), cast(Any, _CONFIG), app, what, name, value, options).lines()


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect the extension."""
    app.connect("autodoc-process-docstring", sections)
    return {"parallel_read_safe": True}
