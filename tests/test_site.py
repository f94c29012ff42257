"""The site of the documentation: its first page shows a living avatar of at most 1.2 MB, and everybody can read it."""

import importlib
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from mien.export import write_page
from web_case import browse, chromium, drawn_head, violations

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


@pytest.fixture(scope="module")
def site(builder: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The whole site, with a drawn head on its first page."""
    folder = tmp_path_factory.mktemp("docs")
    write_page(folder / "me.html", drawn_head(2000))
    command = [sys.executable, str(ROOT / "docs/site/build.py"), "--out", str(folder / "site")]
    subprocess.run([*command, "--avatar", str(folder / "me.html")], check=True, capture_output=True, timeout=900)
    return folder / "site"


@pytest.mark.slow
def test_the_first_page_is_alive_and_everybody_can_read_it(site: Path) -> None:
    chromium()
    assert (site / "avatar.html").stat().st_size <= MOST
    told = browse(site / "index.html", [FRAMES, ALIVE], (1280, 800), flags=["--allow-file-access-from-files"])
    assert told["results"][0] == 1
    address, title, expressions = told["results"][1]
    assert (address, title) == ("avatar.html", "A drawn person as a living avatar")
    assert expressions > 40
    for size, device in (((1280, 800), []), ((390, 844), ["dark", "touch"])):
        assert violations(site / "index.html", size, device) == []
