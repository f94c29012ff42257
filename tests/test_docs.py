"""The documentation's links point to files and headings that exist."""

import importlib
import re
from contextlib import suppress
from functools import cache
from pathlib import Path
from urllib.parse import unquote

import pytest

from mien.avatar import METHODS
from mien.cli import COMMANDS, main

ROOT = Path(__file__).parent.parent
_OUTSIDE_DOCS = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "examples/README.md", "native/README.md")
PAGES = [*(ROOT / name for name in _OUTSIDE_DOCS), *sorted((ROOT / "docs").rglob("*.md"))]
CURRENT = [page for page in PAGES if page.name not in ("CHANGELOG.md", "log.md")]
"""Pages that describe this version alone, not what was tried before it."""
_LINK = re.compile(r"!?\[[^\]]*\]\(<?([^)\s>]+)>?(?:\s+\"[^\"]*\")?\)")
_ADDRESS = re.compile(r"[a-z][a-z0-9+.-]*:", re.IGNORECASE)
_PATH = re.compile(r"(?<![\w./])((?:docs|native|examples|benchmarks|src|tests)/[\w./-]+\.(?:md|py|h|cpp))\b")
"""Pattern of a file that the text names without a link."""


def prose(page: Path) -> str:
    """Return the text of a page without fenced and indented code."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    return re.sub(r"(?m)^ {4,}.*$", "", text)


@cache
def anchors(page: Path) -> set[str]:
    """Return the anchors that GitHub gives the headings of a page."""
    found: dict[str, int] = {}
    for heading in re.findall(r"^#{1,6} +(.+?) *#*$", prose(page), flags=re.MULTILINE):
        text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading)
        slug = re.sub(r"[^\w\- ]", "", text.lower()).replace(" ", "-")
        found[slug] = found.get(slug, -1) + 1
        if found[slug]:
            found[f"{slug}-{found[slug]}"] = 0
    return set(found)


def broken_links(page: Path, root: Path = ROOT) -> list[str]:
    """Return a page's relative links that leave the repository or point to a file or heading that does not exist."""
    broken = []
    for target in _LINK.findall(prose(page)):
        if _ADDRESS.match(target):
            continue
        path, _, anchor = unquote(target).partition("#")
        linked = (page.parent / path).resolve() if path else page
        missing = not linked.is_relative_to(root.resolve()) or not linked.exists()
        if missing or (anchor and anchor not in anchors(linked)):
            broken.append(target)
    return broken


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    assert broken_links(page) == []


@pytest.mark.parametrize("page", CURRENT, ids=lambda page: str(page.relative_to(ROOT)))
def test_files_that_pages_name_exist(page: Path) -> None:
    text = re.sub(r"`[^`\n]*[A-Z*{][A-Z*{]+[^`\n]*`", "", prose(page))  # NAME.py and patterns
    assert [path for path in _PATH.findall(text) if not (ROOT / path).exists()] == []


def test_every_page_of_the_documentation_is_linked() -> None:
    linked = {
        (page.parent / unquote(target).partition("#")[0]).resolve()
        for page in PAGES
        for target in _LINK.findall(prose(page))
        if not _ADDRESS.match(target)
    }
    assert [page.name for page in PAGES if page.resolve() not in linked and page.name != "README.md"] == []


def test_the_index_names_every_page() -> None:
    index = ROOT / "docs" / "README.md"
    rows = re.findall(r"^\| *\[[^\]]*\]\(([^)\s]+)\) *\| *\S", index.read_text(encoding="utf-8"), re.MULTILINE)
    named = {(index.parent / unquote(target).partition("#")[0]).resolve() for target in rows}
    assert [str(page.relative_to(ROOT)) for page in PAGES if page.resolve() not in named and page != index] == []


def test_the_architecture_gives_every_room_its_job() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| \w", page.split("## Rooms")[1].split("## Layers")[0], re.MULTILINE)
    assert sorted(rows) == sorted(path.parent.name for path in (ROOT / "src/mien").glob("*/__init__.py"))


def test_pictures_are_small_and_described() -> None:
    shown = {
        (page.parent / target).resolve(): text
        for page in PAGES
        for text, target in re.findall(r"!\[([^\]]*)\]\(([^)\s]+)\)", prose(page))
    }
    assert all(len(text.split()) > 3 for text in shown.values()), "a picture has no text that says what it shows"
    pictures = [path for path in (ROOT / "docs").rglob("*") if path.suffix in (".png", ".jpg", ".webp", ".gif")]
    assert [path.name for path in pictures if path.resolve() not in shown] == [], "a picture that no page shows"
    assert [path.name for path in pictures if path.stat().st_size > 120_000] == []
    assert sum(path.stat().st_size for path in pictures) < 1_000_000


def test_commands_that_pages_name_exist() -> None:
    targets = set(re.findall(r"^([a-z0-9-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    missing = []
    for page in CURRENT:
        text = page.read_text(encoding="utf-8")
        missing += [(page.name, name) for name in re.findall(r"`make ([a-z][a-z0-9-]*)", text) if name not in targets]
        for names in re.findall(r"`mien ((?:[a-z][a-z-]*(?: \| )?)+)", text):
            missing += [(page.name, name) for name in names.split(" | ") if name.split()[0] not in COMMANDS]
    assert missing == []


def test_options_that_pages_name_exist(capsys: pytest.CaptureFixture[str]) -> None:
    lists = [[name] for name in COMMANDS if name not in ("bench", "train")]
    lists += [["train", "--method", method] for method in METHODS] + [["bench", name] for name in ("render", "quality")]
    for arguments in lists:
        with suppress(SystemExit):
            main([*arguments, "--help-all"])
    known = set(re.findall(r"(?<![\w-])--[a-z][\w.-]*\w", capsys.readouterr().out))
    option = re.compile(r"(?<![\w-])--(?:capture|tracking|training|method)\.[a-z][\w.-]*\w")
    named = {(page.name, name) for page in CURRENT for name in option.findall(page.read_text("utf-8"))}
    assert sorted((page, name) for page, name in named if name not in known) == []


def test_the_reference_finds_the_public_api(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "docs" / "site")
    site = importlib.import_module("doors")
    assert {"mien.camera", "mien.face", "mien.render", "mien.tracking", "mien.avatar"} <= set(site.doors())
    public = [name for names in site.doors().values() for name in names]
    assert [name.full for name in public if callable(name.value) and not name.doc] == []
    assert all(site.exists(name.full) and site.exists(f"{name.home}.{name.name}") for name in public)
    assert site.exists("mien.face.FaceParams.identity")
    assert not site.exists("mien.face.FaceParams.nothing")
    assert not site.exists("mien.nothing")


def test_broken_links_are_found(tmp_path: Path) -> None:
    (tmp_path / "other.md").write_text("# One `thing`, here\n\n## Twice\n\n## Twice\n", encoding="utf-8")
    page = tmp_path / "page.md"
    good = "[a](other.md) [b](other.md#one-thing-here) [c](other.md#twice-1) [d](https://example.org/x) [e](#title)"
    bad = "[f](none.md) [g](other.md#nowhere) [h](../outside.md) ![i](none.png)"
    page.write_text(f"# Title\n\n{good}\n{bad}\n\n    [code](none.md)\n\n```\n[code](none.md)\n```\n", encoding="utf-8")
    assert broken_links(page, tmp_path) == ["none.md", "other.md#nowhere", "../outside.md", "none.png"]
