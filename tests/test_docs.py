"""Pages name what exists and what is stable, the site shows a living avatar, and a stranger adds a method."""

import importlib
import inspect
import json
import re
import shlex
import sys
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from forked import ForkServer
from mien.avatar.methods import METHODS
from mien.cli import COMMANDS, main
from mien.commands.parsing import parse
from mien.errors import UserError
from mien.formats.page import write_page
from mien.lab.analysis import gaussian_avatars, headgas, headgas_ablations
from toy_package import blocks
from web_case import browse, drawn_head, served, violations

ROOT = Path(__file__).parent.parent
_OUTSIDE_DOCS = ("README.md", "CONTRIBUTING.md", "examples/README.md", "native/README.md")
PAGES = [*(ROOT / name for name in _OUTSIDE_DOCS), *sorted((ROOT / "docs").rglob("*.md"))]
PROSE = {page: page.read_text(encoding="utf-8") for page in PAGES if page.name != "log.md"}
"""Text of the pages that describe this version alone, not what was tried before it."""
_PATH = re.compile(r"(?<![\w./])((?:docs|native|examples|benchmarks|src|tests)/[\w./-]+\.(?:md|py|h|cpp))\b")
"""Pattern of a file that the text names without a link."""


def test_files_and_commands_that_pages_name_exist() -> None:
    targets = set(re.findall(r"^([a-z0-9-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    missing = []
    for page, text in PROSE.items():
        prose = re.sub(r"^```.*?^```|^ {4,}[^\n]*$", "", text, flags=re.MULTILINE | re.DOTALL)
        prose = re.sub(r"`[^`\n]*[A-Z*{][A-Z*{]+[^`\n]*`", "", prose)  # NAME.py and patterns
        missing += [(page.name, path) for path in _PATH.findall(prose) if not (ROOT / path).exists()]
        missing += [(page.name, name) for name in re.findall(r"`make ([a-z][a-z0-9-]*)", text) if name not in targets]
        for names in re.findall(r"`mien ((?:[a-z][a-z-]*(?: \| )?)+)", text):
            missing += [(page.name, name) for name in names.split(" | ") if name.split()[0] not in COMMANDS]
    assert missing == []


def test_tests_that_pages_name_exist() -> None:
    named = {
        (page.name, *each) for page, text in PROSE.items() for each in re.findall(r"`(test_\w+)::(test_\w+)", text)
    }
    assert len(named) > 250
    sources = {file: (ROOT / f"tests/{file}.py").read_text(encoding="utf-8") for _, file, _ in named}
    assert sorted(each for each in named if f"def {each[2]}(" not in sources[each[1]]) == []


CLAIMS = {
    int(number): cells.split(" | ")
    for number, cells in re.findall(r"^\| (\d+) \| (.*) \|$", PROSE[ROOT / "docs" / "papers.md"], re.MULTILINE)
}
"""Number of a claim of the papers -> place, claim, what mien has, what shows it, and its state."""


def test_every_claim_of_the_papers_has_a_state_and_what_is_full_names_what_shows_it() -> None:
    assert [*CLAIMS] == [*range(1, 94)]
    counts = Counter(re.split("[:;,]", state)[0] for *_, state in CLAIMS.values())
    (told,) = re.findall(r"^\| all \| ([\d |]+) \|$", PROSE[ROOT / "docs" / "papers.md"], re.MULTILINE)
    assert told.split(" | ") == [str(n) for n in (93, *map(counts.pop, ("fully", "partly", "not", "cannot here")))]
    assert counts == {}
    shown = {number: shown for number, (*_, shown, state) in CLAIMS.items() if state.startswith("fully")}
    assert [each for each in shown.items() if not re.match(r"`test_\w+::test_|`mien |the same", each[1])] == []


def test_the_papers_figures_are_those_that_analyses_show() -> None:
    def numbers(claim: int) -> list[float]:
        return [float(each.replace(",", "")) for each in re.findall(r"\d[\d.]*(?:,\d{3})*", CLAIMS[claim][1])]

    sizes = [size[::-1] for size in (min(gaussian_avatars.TABLE_3), max(gaussian_avatars.TABLE_3))]
    assert numbers(28) == [*gaussian_avatars.TABLE_3.values(), *sizes[0], *sizes[1]]
    assert numbers(52) == [*headgas.SIZES.values(), *headgas.SIZES]
    full, *others = (
        headgas_ablations.ABLATIONS[name][1:] for name in ("full", *(set(headgas_ablations.ABLATIONS) - {"full"}))
    )
    known = [[value for value in column if value is not None] for column in zip(*others, strict=True)]
    assert numbers(54) == [*full, *(most(column) for column in known for most in (min, max))]


def test_pictures_are_small_and_described() -> None:
    found = [(page, *each) for page, text in PROSE.items() for each in re.findall(r"!\[([^\]]*)\]\(([^)\s]+)\)", text)]
    shown = {(page.parent / target).resolve(): text for page, text, target in found}
    assert all(len(text.split()) > 3 for text in shown.values()), "a picture has no text that says what it shows"
    pictures = [path for path in (ROOT / "docs").rglob("*") if path.suffix in (".png", ".jpg", ".webp", ".gif")]
    assert [path.name for path in pictures if path.resolve() not in shown] == [], "a picture that no page shows"
    assert [path.name for path in pictures if path.stat().st_size > 120_000] == []
    assert sum(path.stat().st_size for path in pictures) < 1_000_000


@pytest.mark.unchecked
def test_options_that_pages_name_exist(capsys: pytest.CaptureFixture[str]) -> None:
    lists = [[name] for name in COMMANDS if name not in ("bench", "train")]
    lists += [["train", "--method", method] for method in METHODS] + [["bench", name] for name in ("render", "quality")]
    for arguments in lists:
        with suppress(SystemExit):
            main([*arguments, "--help-all"])
    known = set(re.findall(r"(?<![\w-])--[a-z][\w.-]*\w", capsys.readouterr().out))
    option = re.compile(r"(?<![\w-])--(?:capture|tracking|training|method)\.[a-z][\w.-]*\w")
    named = {(page.name, name) for page, text in PROSE.items() for name in option.findall(text)}
    assert sorted((page, name) for page, name in named if name not in known) == []


def complaint_of(line: str) -> str:
    """What is wrong with a command line. A part of one, inline, lacks what must be given."""
    whole = line.startswith("mien ")
    name, _, typed = line.strip("`").removeprefix("mien ").partition(" ")
    if "..." in line or name not in COMMANDS:
        return ""
    words = shlex.split(typed, comments=True)
    if {"|", "NAME", "METHOD", "[--run"} & {*words} or not words:
        return ""
    try:
        parse(importlib.import_module(f"mien.commands.{name.replace('-', '_')}"), name, words)
    except SystemExit:
        return ""  # help
    except UserError as error:
        is_wrong = "Unrecognized" in str(error) or (whole and "no such file" not in str(error))
        return f"{line}: {error}" if is_wrong else ""
    return ""


@pytest.mark.unchecked
def test_command_lines_of_pages_are_those_of_the_command_line() -> None:
    lines = set[str]()
    for text in PROSE.values():
        code = text.replace("\\\n", " ").replace(" && ", "\n    ")
        lines |= set(re.findall(r"^(?: {4})?(mien [a-z][^\n]*)", code, re.MULTILINE))
        lines |= set(re.findall(r"`mien [a-z][^`\n]*`", text))
    assert len(lines) > 250
    assert [told for line in sorted(lines) if (told := complaint_of(line))] == []


API = PROSE[ROOT / "docs" / "api.md"]
STABLE: dict[str, list[str] | None] = json.loads((ROOT / "tests/public_api.json").read_text(encoding="utf-8"))
"""Full name -> the parameters of a function in order, "=" after those that may be left out; None for other things."""


def parameters(value: Any) -> list[str] | None:
    if not inspect.isfunction(value):
        return None
    found = inspect.signature(value).parameters.values()
    return [each.name + ("" if each.default is each.empty else "=") for each in found]


@pytest.mark.parametrize("name", STABLE)
def test_a_stable_name_is_there_and_takes_what_it_took(name: str) -> None:
    module, _, own = name.rpartition(".")
    room = importlib.import_module(module)
    assert own in getattr(room, "__all__", [own]), f"{module} does not list {own} in __all__"
    before, now = STABLE[name], parameters(getattr(room, own))
    if before is None or now is None:
        assert before == now
        return
    told = "a stable function changed its parameters; keep them, or release a major version"
    assert now[: len(before)] == before, told
    assert all(each.endswith("=") for each in now[len(before) :]), "a new parameter needs a default"


def test_every_name_that_the_api_page_imports_is_stable_and_it_lists_them_all() -> None:
    blocks = re.findall(r"^```python\n(.*?)^```", API, re.MULTILINE | re.DOTALL)
    imports = re.findall(r"^from (mien[\w.]*) import (.+)$", "\n".join(blocks), re.MULTILINE)
    named = {f"{module}.{name.strip()}" for module, names in imports for name in names.split(",")}
    assert len(named) > 15
    assert sorted(named - set(STABLE)) == []
    table = API[API.index("## What is stable") :]
    assert [name for name in STABLE if f"`{name.rpartition('.')[2]}`" not in table] == []
    assert (ROOT / "src" / "mien" / "py.typed").is_file()


FRAMES = "document.querySelectorAll('iframe.living').length"
ALIVE = """(async () => {
  const frame = document.querySelector("iframe.living");
  frame.loading = "eager";
  frame.scrollIntoView();
  for (let i = 0; i < 300 && !frame.contentWindow?.mien; ++i) await new Promise((done) => setTimeout(done, 100));
  const viewer = await frame.contentWindow.mien;
  return [frame.getAttribute("src"), frame.title, viewer.avatar.expression_names.length];
})()"""


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


def test_the_first_page_is_alive_and_everybody_can_read_it(fork_server: ForkServer, tmp_path: Path) -> None:
    """A drawn head is on it. It is built in a process of its own, whose annotations sphinx changes."""
    pytest.importorskip("sphinx")
    process = fork_server.call("test_docs:build_first_page", str(tmp_path))
    assert process.wait() == 0, process.stderr
    write_page(tmp_path / "site" / "avatar.html", drawn_head(500))
    with served(tmp_path / "site") as address:
        told = browse(f"{address}/index.html", [FRAMES, ALIVE], (1280, 800))
        frames, (source, title, expressions) = told["results"]
        assert (frames, source, title) == (1, "avatar.html", "A drawn person as a living avatar")
        assert expressions > 40
        for size, device in (((1280, 800), []), ((390, 844), ["dark", "touch"])):
            assert violations(f"{address}/index.html", size, device) == []


RECIPE = "Add a method"
REGISTER = """
import pytest

@pytest.hookimpl(trylast=True)
def pytest_configure(config):
    import mien.avatar
    from mien.avatar.methods import METHODS, Method

    mien.avatar.__path__.append({folder!r})
    METHODS.update({{{line}}})
"""


def follow(folder: Path) -> str:
    """Write the method's file and a plugin that registers it; return the method's name."""
    *parts, line = blocks(RECIPE, "python")
    content = "\n\n".join(parts)
    place = re.match(r"# (src/mien/avatar/(\w+)\.py)\n", content)
    assert place is not None, "the first block names the file"
    (folder / f"{place[2]}.py").write_text(content)
    (folder / "a_new_method.py").write_text(REGISTER.format(folder=str(folder), line=line))
    return place[2]


def suite() -> list[str]:
    """The words after `pytest` in the recipe's fourth step."""
    section = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8").split(f"\n## {RECIPE}\n")[1]
    (words,) = re.findall(r"`\.venv/bin/pytest (-k [^`]*)`", section)
    return [name for word in words.split() for name in (map(str, sorted(ROOT.glob(word))) if "*" in word else [word])]


def test_the_suite_passes_as_it_is(fork_server: ForkServer, tmp_path: Path) -> None:
    """Pose, regularizers, density, bake, train, resume to the bit, render, export, files, options."""
    name = follow(tmp_path)
    # The server has imported mien and jaxtyping, so types of the new method alone are checked.
    options = ["-o", "addopts=--strict-markers", f"--jaxtyping-packages=mien.avatar.{name},beartype.beartype"]
    options += ["-W", "ignore::pytest.PytestAssertRewriteWarning", "-p", "no:cacheprovider", "-p", "a_new_method"]
    words = [*options, *suite(), "-v"]
    kept = {name: "" for name in ("PYTEST_XDIST_WORKER", "PYTEST_ADDOPTS", "PYTEST_CURRENT_TEST")}
    process = fork_server.call("pytest:main", words, cwd=ROOT, env=kept, path=[tmp_path], exits=True)
    assert process.wait() == 0, process.stdout[-6000:] + process.stderr[-2000:]
    passed = set(re.findall(rf"::(\w+)\[{name}[^]]*\] PASSED", process.stdout))
    assert "No test was skipped." in process.stdout
    assert {
        "test_first_fifty_steps_lower_the_loss",
        "test_saved_avatar_renders_the_same_picture",
        "test_baked_avatar_poses_as_the_avatar_does",
        "test_an_avatar_becomes_a_file_a_page_and_a_mesh",
        "test_training_goes_on_from_a_checkpoint_as_if_it_had_never_stopped",
    } <= passed
    for file in ("test_runtime", "test_settings"):
        assert re.search(rf"{file}\w*\.py::\w+\[{name}[^]]*\] PASSED", process.stdout)
