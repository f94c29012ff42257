"""Build the site of the documentation: `make docs`.

The pages are those of docs/, README.md, CONTRIBUTING.md, SECURITY.md, CHANGELOG.md and the pages beside code. They are
copied into one folder, and the links between them are changed to match. A page is added for each room of the public
API, and for each file of code that a page links. docs/README.md becomes the front page, and its sections become the
menu. If `make demo` has drawn its person, the front page shows that avatar, alive.

Any warning of Sphinx (a link, a heading or a reference that leads nowhere) fails the build, and so does a path of this
machine in the result. External links are not opened.
"""

import argparse
import ast
import importlib
import inspect
import posixpath
import re
import shutil
import sys
import textwrap
from functools import cache
from pathlib import Path
from urllib.parse import unquote

from doors import PublicName, doors, first_line
from sphinx.cmd.build import main as sphinx_build

from mien.cli import main as mien

ROOT = Path(__file__).parent.parent.parent
FRONT = "docs/README.md"
_BESIDE_CODE = {
    "README.md": "readme.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
    "CHANGELOG.md": "changelog.md",
    "examples/README.md": "examples.md",
    "native/README.md": "native.md",
    "web/README.md": "web_package.md",
}
"""Pages outside docs/, and what they are called in the site."""
_LINK = re.compile(r"(?P<before>\]\()(?P<target>[^)\s#:]+)(?P<after>(#[^)\s]*)?\))")
_CODE = {".py": "python", ".h": "cpp", ".cpp": "cpp", ".toml": "toml"}
_LONGEST_VALUE = 88
"""Longest value of a constant that the reference shows, in characters."""
_PICTURE = re.compile(r"^!\[[^\]]*\]\([./\w]*images/demo\.jpg\)$", re.MULTILINE)
"""The picture of the front page, below which the living avatar stands."""
_LIVING = """

```{raw} html
<iframe class="living" src="avatar.html" title="A drawn person as a living avatar" loading="lazy"></iframe>
```"""
_MOST_BYTES = 1_200_000
"""Largest page of an avatar that the front page shows, in bytes."""
_MENDED = {
    '<p class="caption" role="heading">': '<p class="caption" role="heading" aria-level="2">',
    '<aside class="sidebar-drawer">': '<aside class="sidebar-drawer" aria-label="All pages">',
}
"""Elements of the theme's pages that screen readers cannot use -> the elements that replace them."""
_REFERENCE = "| Reference |"
"""Where the front page names the reference, which exists in the site only."""


@cache
def pages() -> dict[str, str]:
    """Page of the repository -> page of the site."""
    below_docs = {
        path.relative_to(ROOT).as_posix(): path.relative_to(ROOT / "docs").as_posix()
        for path in sorted((ROOT / "docs").rglob("*.md"))
    }
    return {**below_docs, FRONT: "index.md", **_BESIDE_CODE}


def copy_pages(to: Path, living: bool) -> None:
    """Copy every page, and whatever it links. The front page shows a living avatar if there is one."""
    for source, name in pages().items():
        text = _with_links_of_the_site((ROOT / source).read_text("utf-8"), source, name, to)
        if source == FRONT:
            assert _REFERENCE in text
            text = text.replace(_REFERENCE, "| [Reference](reference.md) |")
            text += _menu(text)
            if living:
                assert _PICTURE.search(text)
                text = _PICTURE.sub(lambda match: match[0] + _LIVING, text, count=1)
        _write(to / name, text)


def _with_links_of_the_site(text: str, source: str, name: str, to: Path) -> str:
    def target_of(match: re.Match[str]) -> str:
        linked = posixpath.normpath(posixpath.join(posixpath.dirname(source), unquote(match["target"])))
        place = pages().get(linked) or _copied(linked, to)
        if place is None:
            return match[0]  # Sphinx reports it
        return match["before"] + posixpath.relpath(place, posixpath.dirname(name) or ".") + match["after"]

    parts = re.split(r"(^```[\s\S]*?^```|^ {4,}.*$|`[^`\n]+`)", text, flags=re.MULTILINE)
    return "".join(part if index % 2 else _LINK.sub(target_of, part) for index, part in enumerate(parts))


def _copied(linked: str, to: Path) -> str | None:
    """The place in the site of a file that is not a page: a picture is copied, code gets a page."""
    path = ROOT / linked
    if not path.is_file() or not path.resolve().is_relative_to(ROOT.resolve()):
        return None
    if path.suffix not in _CODE:
        (to / linked).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, to / linked)
        return linked
    code = path.read_text("utf-8")
    _write(to / f"code/{linked}.md", f"---\norphan: true\n---\n# {linked}\n\n````{_CODE[path.suffix]}\n{code}````\n")
    return f"code/{linked}.md"


def _menu(page: str) -> str:
    """Hidden tables of contents, for the sidebar: one for each section of the front page that has a table of pages."""
    menu = ""
    for section in re.split(r"^#+ ", page, flags=re.MULTILINE)[1:]:
        entries = re.findall(r"^\| *\[([^\]]*)\]\(([^)\s#:]+)\.md\)", section, flags=re.MULTILINE)
        if entries:
            caption = f":caption: {section.splitlines()[0]}\n"
            lines = "\n".join(f"{title} <{page}>" for title, page in entries)
            menu += f"\n```{{toctree}}\n:hidden:\n{caption}\n{lines}\n```\n"
    return menu


def write_reference(to: Path) -> None:
    """Write one page for each door, and a page that names them all."""
    rows, names = [], []
    for door, exported in doors().items():
        _write(to / f"reference/{door}.rst", _page_of(door, exported))
        rows.append(f"| [`{door}`](reference/{door}.rst) | {first_line(importlib.import_module(door))} |")
        names.append(f"reference/{door}")
    _write(
        to / "reference.md",
        "# Reference\n\nThe public API: what each room exports, with shapes, units and errors, from the docstrings.\n"
        "[The ten entry points](api.md) are a shorter way in.\n\n| room | what it is |\n|---|---|\n"
        + "\n".join(rows)
        + "\n\n```{toctree}\n:hidden:\n\n"
        + "\n".join(names)
        + "\n```\n",
    )


def _page_of(door: str, exported: list[PublicName]) -> str:
    parts = [f"{door}\n{'=' * len(door)}\n\n.. automodule:: {door}\n   :no-members:\n\n.. currentmodule:: {door}\n"]
    parts.append(".. list-table::\n   :widths: 30 70\n   :class: names\n")
    for public in exported:
        doc = public.doc.split("\n\n")[0].replace("\n", " ") or f"``{_value(public)}``"
        parts[-1] += f"\n   * - :py:obj:`{public.name} <{public.full}>`\n     - {doc}"
    parts[-1] += "\n"
    kinds = {"Classes": inspect.isclass, "Functions": inspect.isroutine}
    for title, belongs in kinds.items():
        group = [public for public in exported if belongs(public.value)]
        if group:
            parts.append(f"{title}\n{'-' * len(title)}\n")
        parts += [f".. auto{'class' if title == 'Classes' else 'function'}:: {public.name}\n" for public in group]
    rest = [public for public in exported if not any(belongs(public.value) for belongs in kinds.values())]
    if rest:
        parts.append("Constants and types\n-------------------\n")
    parts += [_constant(public) for public in rest]
    return "\n".join(parts)


def _constant(public: PublicName) -> str:
    doc = "".join(f"   {line}\n" for line in public.doc.splitlines())
    return f".. py:data:: {public.name}\n   :value: {_value(public)}\n\n{doc}"


def _value(public: PublicName) -> str:
    """The expression that defines a constant, shortened."""
    for node in ast.parse(inspect.getsource(importlib.import_module(public.home))).body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if any(isinstance(target, ast.Name) and target.id == public.name for target in targets):
            assert isinstance(node, ast.Assign | ast.AnnAssign)
            assert node.value is not None, public.name
            return textwrap.shorten(ast.unparse(node.value), _LONGEST_VALUE, placeholder=" ...")
    return "..."


def paths_of_this_machine(site: Path) -> list[str]:
    """Files of the site that hold a path of this machine."""
    paths = {str(path) for path in (ROOT, ROOT.resolve(), Path.home(), Path(sys.prefix))} - {"/"}
    return [
        str(file.relative_to(site))
        for file in sorted(site.rglob("*"))
        if file.is_file() and any(path.encode() in file.read_bytes() for path in paths)
    ]


def marks_in_the_reference(site: Path) -> list[str]:
    """Pages of the reference that show the source of an annotation's marks (ranges.py takes them off)."""
    pages = sorted((site / "reference").glob("*.html"))
    return [str(page.relative_to(site)) for page in pages if "Annotated[" in page.read_text("utf-8")]


def mend(site: Path) -> None:
    """Add what screen readers need and the theme leaves out."""
    for page in sorted(site.rglob("*.html")):
        text = page.read_text("utf-8")
        for missing, whole in _MENDED.items():
            text = text.replace(missing, whole)
        page.write_text(text, "utf-8")


def small_page(avatar: Path, aside: Path) -> Path | None:
    """Return the page of an avatar that the front page can show: `avatar`, or a smaller one in its place.

    The smaller one is exported from the workspace that the page lies in, to `aside`. If there is none, say why.
    """
    if not avatar.is_file():
        print(f"The front page has no living avatar: {avatar} is made by `make demo`; then run `make docs` again.")
        return None
    if avatar.stat().st_size <= _MOST_BYTES:
        return avatar
    sequences = sorted((avatar.parent / "sequences").glob("*/"))
    if not sequences:
        print(f"The front page has no living avatar: {avatar} has more than {_MOST_BYTES:,} bytes.")
        return None
    aside.parent.mkdir(parents=True, exist_ok=True)
    limits = ["--largest", str(_MOST_BYTES / 1e6), "--series", sequences[0].name, "--every", "2"]
    return aside if mien(["export", str(avatar.parent), "--out", str(aside), *limits]) == 0 else None


def build(out: Path, avatar: Path) -> int:
    """Build the site into `out`, with the page of an avatar if there is one, and return the exit code."""
    work = out.with_name(out.name + "-pages")
    for folder in (work, out):
        shutil.rmtree(folder, ignore_errors=True)
    living = small_page(avatar, out.with_name(out.name + "-avatar.html"))
    copy_pages(work, living is not None)
    write_reference(work)
    (out.parent).mkdir(parents=True, exist_ok=True)
    arguments = ["-b", "html", "-q", "-W", "--keep-going", "-c", str(Path(__file__).parent)]
    code = sphinx_build([*arguments, "-d", str(work / "_doctrees"), str(work), str(out)])
    (out / ".buildinfo").unlink(missing_ok=True)
    mend(out)
    if living is not None:
        shutil.copyfile(living, out / "avatar.html")
    leaks = paths_of_this_machine(out)
    for name in leaks:
        print(f"{out / name} holds a path of this machine", file=sys.stderr)
    marked = marks_in_the_reference(out)
    for name in marked:
        print(f"{out / name} shows the marks of an annotation", file=sys.stderr)
    return code or bool(leaks) or bool(marked)


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, "utf-8")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "docs", help="folder of the site")
    parser.add_argument("--avatar", type=Path, default=ROOT / "out" / "demo" / "me.html", help="page of a drawn person")
    given = parser.parse_args()
    sys.exit(build(given.out, given.avatar))
