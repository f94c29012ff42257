"""`seams.py` finds what it is meant for; mutations fit the code, and the stub fits the native module."""

import ast
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Protocol

import pytest
from torch import nn

import mien
from mien import _native
from mutations.copies import Case, read_cases
from seams import MethodNames, naming_faults, override_faults, private_faults

ROOT = Path(__file__).parents[1]
METHODS = [MethodNames("old", ("OldAvatar", "OldConfig")), MethodNames("new_one", ("NewOne", "NewOneConfig"))]
NAMES = {
    "src/mien/a.py": ("import mien\n\nif method == 'new_one':\n    pass\n", 3),
    "src/mien/avatar/old/avatar.py": ("from mien.avatar import (\n    NewOneConfig,\n)\n", 2),
    "web/src/points.ts": ("// new_one\n", 1),
    "src/mien/avatar/new_one/avatar.py": ("class NewOne:\n    name = 'new_one'\n", None),
    "src/mien/b.py": ('"""The paper NewOne."""\nfrom mien.export.new_one_folder import NewOneFolder\n', None),
    "list.py": ("METHODS = ['old', 'new_one']\n", None),
    "idle.py": ("pass\n", None),
}
"""Files, and the lines that name a method and may not."""
PRIVATE = """from mien.face import _part, loading
from mien import _native, cli
_native.draw()
loading._read(1)
loading.read(1)
monkeypatch.setattr(cli, '_run', None)
monkeypatch.setattr(cli, 'run', None)
import mien.face
mien.face._part
self._y
"""


class Base(nn.Module, ABC):
    @abstractmethod
    def open(self) -> None: ...
    def done(self) -> None: ...
    @property
    def size(self) -> int: ...


class Shape(Protocol):
    def draw(self) -> None: ...


class Own(Base):
    def open(self) -> None: ...
    def done(self) -> None: ...
    def forward(self) -> None: ...


class Last(Own, Shape):
    def open(self) -> None: ...
    def draw(self) -> None: ...
    @property
    def size(self) -> int: ...


def test_what_seams_finds() -> None:
    told = "names the method new_one; ask what it is needed for of the avatar itself"
    texts = {place: text for place, (text, _) in NAMES.items()}
    found = list(naming_faults(texts, METHODS, {"list.py": "", "idle.py": ""}))
    expected = [f"{place}:{line}: {told}" for place, (_, line) in NAMES.items() if line]
    assert found == [*expected, "tests/seams.py: idle.py names no method any more; take it out of MAY_NAME"]
    faults = override_faults([Base, Shape, Own, Last])
    assert [fault.replace(f"{__name__}.", "").split(",")[0] for fault in faults] == [
        "Own.done overrides that of Base",
        "Last.open overrides that of Own",
        "Last.size overrides that of Base",
    ]
    assert sorted(fault.split(":")[1] for fault in private_faults({"t.py": PRIVATE})) == ["1", "4", "6", "9"]


@pytest.mark.parametrize("case", read_cases(), ids=lambda case: f"{case.file}: {case.old[:30]}")
def test_a_mutation_changes_one_place_and_names_tests_that_exist(case: Case) -> None:
    """Code that moves would let `make mutate` test nothing."""
    assert (ROOT / case.file).read_text(encoding="utf-8").count(case.old) == 1
    assert case.new != case.old
    assert all((ROOT / f"tests/{name}.py").is_file() for name in case.tests)


def test_the_stub_lists_what_the_native_module_has() -> None:
    body = ast.parse(Path(mien.__file__).with_name("_native.pyi").read_text()).body
    functions = {node.name: node.args.args for node in body if isinstance(node, ast.FunctionDef)}
    classes = {node.name: fields(node.body) for node in body if isinstance(node, ast.ClassDef)}
    assert {*functions, *classes, *fields(body)} == {name for name in dir(_native) if not name.startswith("_")}
    for name, own in classes.items():
        assert own == list(getattr(getattr(_native, name), "_fields", ())), name
        assert len(own) <= 10
    for name, given in functions.items():
        signature = getattr(_native, name).__doc__.splitlines()[0]
        assert all(f"{one.arg}: " in signature for one in given), signature
        assert signature.count(": ") == len(given), signature


def fields(body: list[ast.stmt]) -> list[str]:
    """Return the names that a module or class declares with a type."""
    declared = (one.target for one in body if isinstance(one, ast.AnnAssign))
    return [target.id for target in declared if isinstance(target, ast.Name)]
