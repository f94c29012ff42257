"""Sphinx extension: code in the text that names something of mien is checked, and linked to the reference.

A full name such as `mien.render.rasterize` has to exist, wherever it is written. Other names are linked if the
reference has exactly one thing of that name.
"""

import re
from collections import defaultdict
from typing import Any

from docutils import nodes
from doors import doors, exists
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.util import logging

_LOGGER = logging.getLogger(__name__)
_NAME = re.compile(r"([A-Za-z_][\w.]*)(\(.*\))?")
_OLD_PAGES = ("changelog", "log")
"""Pages about earlier versions, which name what is gone."""


def _places() -> dict[str, set[str]]:
    """Name as written -> the full public names that it can mean."""
    places: dict[str, set[str]] = defaultdict(set)
    for door, names in doors().items():
        places[door].add(door)
        for public in names:
            for written in (public.name, public.full, f"{public.home}.{public.name}"):
                places[written].add(public.full)
    return places


def link_names(app: Sphinx, doctree: nodes.document) -> None:
    """Replace code that names public things by references, and report full names that lead nowhere."""
    places = _places()
    page = app.env.docname
    if page in _OLD_PAGES:
        return
    for literal in list(doctree.findall(nodes.literal)):
        written = _NAME.fullmatch(literal.astext())
        if written is None or _is_linked(literal):
            continue
        name = written[1]
        if name.startswith("mien.") and not exists(name) and not _is_format(literal):
            _LOGGER.warning("%s does not exist", name, location=literal)
        targets = places.get(name, set())
        here = {full for full in targets if page == f"reference/{full.rpartition('.')[0]}"}
        member = _member(literal, name)
        target = member or _only(here) or _only(targets)
        if target and (member or here or _is_telling(name)):
            link = addnodes.pending_xref("", refdomain="py", reftype="obj", reftarget=target, refdoc=page)
            literal.replace_self(link)
            link.append(literal)


def resolve(app: Sphinx, env: Any, node: addnodes.pending_xref, content: nodes.TextElement) -> nodes.Node | None:
    """Types of signatures that the reference does not have stay plain text: those of other packages, and inner ones."""
    target = node.get("reftarget", "")
    if node.get("refdomain") != "py":
        return None
    full = _only(_places().get(target, set()))
    if full and full != target:
        node["reftarget"] = full
        return env.get_domain("py").resolve_any_xref(env, node["refdoc"], app.builder, full, node, content)[0][1]
    return None if target.startswith("mien.") and not exists(target) else content


def _is_linked(node: nodes.Node) -> bool:
    while node is not None:
        if isinstance(node, nodes.reference | addnodes.pending_xref | nodes.title | addnodes.desc_signature):
            return True
        node = node.parent
    return False


def _member(literal: nodes.literal, name: str) -> str | None:
    """The full name of a field or method, if the text is that of a class which has one of this name."""
    node = literal.parent
    while node is not None and not (isinstance(node, addnodes.desc) and node["objtype"] == "class"):
        node = node.parent
    if node is None:
        return None
    for signature in node.findall(addnodes.desc_signature):
        if signature["fullname"].partition(".")[2] == name:
            return f"{signature['module']}.{signature['fullname']}"
    return None


def _is_format(literal: nodes.literal) -> bool:
    """Whether the text before says that this is the name of a file format."""
    before = literal.previous_sibling() if literal.parent else None
    return before is not None and before.astext().rstrip().endswith("format")


def _is_telling(name: str) -> bool:
    """Whether a bare name can mean nothing but Python. `track` may be a sub-command."""
    return not name.isalpha() or not name.islower()


def _only(names: set[str]) -> str | None:
    return next(iter(names)) if len(names) == 1 else None


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect the extension."""
    app.connect("doctree-read", link_names)
    app.connect("missing-reference", resolve)
    return {"parallel_read_safe": True}
