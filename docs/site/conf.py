"""Settings of the site that `make docs` builds. Sphinx reads this file; build.py prepares the pages."""

import re
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

_ROOT = Path(__file__).parent.parent.parent

project = "mien"
version = release = re.findall(r'^version = "(.+)"', (_ROOT / "pyproject.toml").read_text("utf-8"), re.MULTILINE)[0]
html_title = f"mien {release}"
copyright = "the authors of mien, Apache-2.0"  # noqa: A001

extensions = ["myst_parser", "sphinx.ext.autodoc", "docstrings", "links", "ranges"]
exclude_patterns = ["**/_*"]
nitpicky = True  # a reference that leads nowhere is a warning, and build.py lets no warning pass

# Markdown, as GitHub shows it.
myst_heading_anchors = 6

# The reference: one page for each room (build.py).
default_role = "literal"
add_module_names = False
autodoc_class_signature = "mixed"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "undoc-members": True}
autodoc_preserve_defaults = True  # the source's text of a default: its value may hold a path of this machine
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
python_maximum_signature_line_length = 88
python_display_short_literal_types = True
toc_object_entries_show_parents = "hide"

html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
html_show_sphinx = False
html_theme_options = {"top_of_page_buttons": []}
pygments_style = "friendly"
pygments_dark_style = "native"
