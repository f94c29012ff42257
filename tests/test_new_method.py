"""A stranger adds a method: the steps of CONTRIBUTING.md, "Add a method", to the letter, then the suite on it."""

import re
from pathlib import Path

from forked import ForkServer
from toy_package import blocks

ROOT = Path(__file__).parents[1]
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
