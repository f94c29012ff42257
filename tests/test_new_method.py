"""A stranger adds a method: the steps of CONTRIBUTING.md, "Add a method", to the letter, then the suite on it."""

import contextlib
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from web_case import node

TESTS = Path(__file__).parent
PAGE = TESTS.parent / "CONTRIBUTING.md"
SUITE = (
    "test_methods.py", "test_runtime.py", "test_runtime_equality.py", "test_hostile_avatars.py",
    "test_device_stalls.py", "test_settings.py", "test_settings_help.py",
)  # fmt: skip
"""Files with tests of every method."""
REGISTER = """
import pytest

@pytest.hookimpl(trylast=True)
def pytest_configure(config):
    import mien.avatar
    from mien.avatar.methods import METHODS, Method

    mien.avatar.__path__.append({folder!r})
    METHODS.update({{{line}}})
"""


def blocks() -> list[str]:
    """The blocks of Python in that section."""
    section = PAGE.read_text(encoding="utf-8").split("\n## Add a method\n")[1].split("\n## ")[0]
    return re.findall(r"^```python\n(.*?)^```", section, flags=re.MULTILINE | re.DOTALL)


def follow(folder: Path) -> str:
    """Write the method's file and a plugin that registers it; return the method's name."""
    *parts, line = blocks()
    content = "\n\n".join(parts)
    place = re.match(r"# (src/mien/avatar/(\w+)\.py)\n", content)
    assert place is not None, "the first block names the file"
    (folder / f"{place[2]}.py").write_text(content)
    (folder / "a_new_method.py").write_text(REGISTER.format(folder=str(folder), line=line))
    return place[2]


def run(folder: Path, *words: str) -> str:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    environment["PYTHONPATH"] = str(folder)
    done = subprocess.run(
        [sys.executable, "-m", *words], env=environment, cwd=TESTS.parent, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    return done.stdout


@pytest.fixture(scope="module")
def tested(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """Return the method's name, and what pytest said of the suite, with the web runtime where node is."""
    folder = tmp_path_factory.mktemp("method")
    name = follow(folder)
    files = [str(TESTS / file) for file in SUITE]
    with contextlib.suppress(pytest.skip.Exception):
        node()
        files.append(str(TESTS / "test_web_skinned.py"))
    return name, run(folder, "pytest", "-p", "a_new_method", "-p", "no:cacheprovider", "-k", name, "-v", *files)


@pytest.mark.slow
def test_the_suite_passes_as_it_is(tested: tuple[str, str]) -> None:
    """Pose, regularizers, density, bake, train, resume to the bit, render, export, damaged files, options."""
    name, shown = tested
    passed = set(re.findall(rf"::(\w+)\[{name}[^]]*\] PASSED", shown))
    assert "No test was skipped." in shown
    assert {
        "test_first_fifty_steps_lower_the_loss",
        "test_saved_avatar_renders_the_same_picture",
        "test_baked_avatar_poses_as_the_avatar_does",
        "test_an_avatar_becomes_a_file_a_page_and_a_mesh",
        "test_training_goes_on_from_a_checkpoint_as_if_it_had_never_stopped",
        "test_pictures_equal_those_of_training",
        "test_numbers_that_cannot_be_drawn",
        "test_a_step_of_training_asks_for_no_number",
        "test_help_all_lists_every_setting_of_the_method",
    } <= passed


@pytest.mark.slow
def test_a_page_reads_its_avatars(tested: tuple[str, str]) -> None:
    node()
    name, shown = tested
    assert f"test_a_page_reads_avatars_of_every_method[{name}] PASSED" in shown


def test_it_is_written_as_the_project_is(tmp_path: Path) -> None:
    name = follow(tmp_path)
    for words in (("ruff", "check"), ("ruff", "format", "--check")):
        run(tmp_path, *words, "--config", str(TESTS.parent / "pyproject.toml"), str(tmp_path / f"{name}.py"))
