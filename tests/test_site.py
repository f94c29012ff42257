"""The site of the documentation: its first page shows a living avatar of at most 1.2 MB, and everybody can read it."""

import importlib
import sys
from pathlib import Path
from types import ModuleType

import pytest

from forked import ForkServer
from mien.export import write_page
from web_case import browse, drawn_head, served, violations

ROOT = Path(__file__).parent.parent
MOST = 1_200_000
"""Bytes that the avatar of the first page may have."""
FRAMES = "document.querySelectorAll('iframe.living').length"
ALIVE = """(async () => {
  const frame = document.querySelector("iframe.living");
  frame.loading = "eager";
  frame.scrollIntoView();
  for (let i = 0; i < 300 && !frame.contentWindow?.mien; ++i) await new Promise((done) => setTimeout(done, 100));
  const viewer = await frame.contentWindow.mien;
  return [frame.getAttribute("src"), frame.title, viewer.avatar.expression_names.length];
})()"""


@pytest.fixture(scope="module")
def builder() -> ModuleType:
    """The program behind `make docs`."""
    pytest.importorskip("sphinx")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "docs" / "site")
        return importlib.import_module("build")


def test_an_avatar_of_more_than_a_megabyte_and_a_fifth_is_made_smaller_or_left_out(
    builder: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    avatar, aside = tmp_path / "me.html", tmp_path / "site" / "avatar.html"
    assert builder.small_page(avatar, aside) is None
    assert "is made by `make demo`" in capsys.readouterr().out
    for size, page in ((MOST, avatar), (MOST + 1, None)):
        avatar.write_bytes(b" " * size)
        assert builder.small_page(avatar, aside) == page
        builder.copy_pages(tmp_path / "pages", page is not None)
        assert ('src="avatar.html"' in (tmp_path / "pages" / "index.md").read_text()) == (page is not None)
    assert "has more than 1,200,000 bytes" in capsys.readouterr().out
    (tmp_path / "sequences" / "demo").mkdir(parents=True)
    asked: list[list[str]] = []
    monkeypatch.setattr(builder, "mien", lambda words: asked.append(words) or 0)
    assert builder.small_page(avatar, aside) == aside
    assert asked[0][:6] == ["export", str(tmp_path), "--out", str(aside), "--largest", "1.2"]
    monkeypatch.setattr(builder, "mien", lambda _: 2)
    assert builder.small_page(avatar, aside) is None


def build_first_page(folder: str) -> None:
    """Build the site with nothing but titles on its other pages; `make docs` in CI builds all."""
    sys.path.insert(0, str(ROOT / "docs" / "site"))
    builder = importlib.import_module("build")
    pages, out = Path(folder, "pages"), Path(folder, "site")
    builder.copy_pages(pages, living=True)
    for page in (*pages.rglob("*.md"), pages / "reference.md"):
        if page != pages / "index.md":
            page.write_text(f"---\norphan: true\n---\n# {page.stem}\n")
    assert builder.sphinx_build(["-b", "html", "-q", "-c", str(ROOT / "docs" / "site"), str(pages), str(out)]) == 0
    builder.mend(out)


@pytest.fixture(scope="module")
def site(fork_server: ForkServer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site with a drawn head on its first page, built in a process of its own, whose annotations it changes."""
    pytest.importorskip("sphinx")
    folder = tmp_path_factory.mktemp("docs")
    process = fork_server.call("test_site:build_first_page", str(folder))
    assert process.wait() == 0, process.stderr
    write_page(folder / "site" / "avatar.html", drawn_head(500))
    return folder / "site"


def test_the_first_page_is_alive_and_everybody_can_read_it(site: Path) -> None:
    with served(site) as address:
        told = browse(f"{address}/index.html", [FRAMES, ALIVE], (1280, 800))
        assert told["results"][0] == 1
        source, title, expressions = told["results"][1]
        assert (source, title) == ("avatar.html", "A drawn person as a living avatar")
        assert expressions > 40
        for size, device in (((1280, 800), []), ((390, 844), ["dark", "touch"])):
            assert violations(f"{address}/index.html", size, device) == []
