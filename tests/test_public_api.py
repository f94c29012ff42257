"""What docs/api.md names is stable: every name, and the arguments of every function, as `public_api.json` has them."""

import importlib
import inspect
import json
import re
from pathlib import Path
from typing import Any

import pytest

HERE = Path(__file__).parent
STABLE: dict[str, list[str] | None] = json.loads((HERE / "public_api.json").read_text(encoding="utf-8"))
"""Full name -> the parameters of a function, in their order, with "=" after those that may be left out; None for what
is no function."""


def parameters(value: Any) -> list[str] | None:
    if not inspect.isfunction(value):
        return None
    optional = inspect.Parameter.empty
    found = inspect.signature(value).parameters.values()
    return [each.name + ("" if each.default is optional else "=") for each in found]


@pytest.mark.parametrize("name", STABLE)
def test_a_stable_name_is_there_and_takes_what_it_took(name: str) -> None:
    module, _, own = name.rpartition(".")
    room = importlib.import_module(module)
    assert own in getattr(room, "__all__", [own]), f"{module} does not list {own} in __all__"
    before, now = STABLE[name], parameters(getattr(room, own))
    if before is None:
        assert now is None
        return
    assert now is not None
    assert now[: len(before)] == before, (
        "a stable function changed its parameters; keep them, or release a major version"
    )
    assert all(each.endswith("=") for each in now[len(before) :]), "a new parameter needs a default"


def test_every_name_that_the_page_imports_is_stable() -> None:
    page = (HERE.parent / "docs" / "api.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    imports = re.findall(r"^from (mien[\w.]*) import (.+)$", "\n".join(blocks), re.MULTILINE)
    named = {f"{module}.{name.strip()}" for module, names in imports for name in names.split(",")}
    assert len(named) > 15
    assert sorted(named - set(STABLE)) == []


def test_the_page_lists_every_stable_name() -> None:
    page = (HERE.parent / "docs" / "api.md").read_text(encoding="utf-8")
    table = page[page.index("## What is stable") :]
    assert [name for name in STABLE if f"`{name.rpartition('.')[2]}`" not in table] == []


def test_the_package_has_types() -> None:
    assert (HERE.parent / "src" / "mien" / "py.typed").is_file()
