"""The rules of `seams.py` find what they are meant for, and nothing else."""

import pytest

from seams import MethodNames, naming_faults, override_faults, private_faults

METHODS = [MethodNames("old", ("OldAvatar", "OldConfig")), MethodNames("new_one", ("NewOne", "NewOneConfig"))]
BASE = """
from abc import ABC, abstractmethod
from typing import Protocol
from torch import nn

class Base(nn.Module, ABC):
    def __init__(self): ...
    @abstractmethod
    def open(self): ...
    def done(self): ...
    @property
    def size(self): ...
    def forward(self): ...

class Shape(Protocol):
    def draw(self): ...
"""


@pytest.mark.parametrize(
    ("place", "text", "line"),
    [
        ("src/mien/export/packed.py", "import mien\n\nif method == 'new_one':\n    pass\n", 3),
        ("src/mien/export/packed.py", "# as in new_one\n", 1),
        ("src/mien/export/packed.py", "from mien.avatar.new_one.settings import PRESETS\n", 1),
        ("src/mien/export/packed.py", "from mien.avatar import (\n    NewOneConfig,\n)\n", 2),
        ("src/mien/avatar/old/avatar.py", "x = NewOne\n", 1),
        ("web/src/points.ts", "// new_one\n", 1),
        ("src/mien/avatar/new_one/avatar.py", "class NewOne:\n    name = 'new_one'\n", None),
        ("src/mien/avatar/new_one.py", "class NewOne:\n    name = 'new_one'\n", None),
        ("src/mien/lab/analysis/new_one/__init__.py", "method = 'new_one'\n", None),
        (
            "src/mien/export/packed.py",
            '"""The paper NewOne."""\nfrom mien.export.new_one_folder import NewOneFolder\n',
            None,
        ),
    ],
)
def test_names_of_methods_are_found(place: str, text: str, line: int | None) -> None:
    found = list(naming_faults({place: text}, METHODS, {}))
    expected = f"{place}:{line}: names the method new_one; ask what it is needed for of the avatar itself"
    assert found == ([] if line is None else [expected])


def test_allowed_places_may_name_methods_and_have_to() -> None:
    texts = {"a.py": "METHODS = ['old', 'new_one']\n", "b.py": "pass\n"}
    found = list(naming_faults(texts, METHODS, {"a.py": "a list", "b.py": "nothing"}))
    assert found == ["tests/seams.py: b.py names no method any more; take it out of MAY_NAME"]


@pytest.mark.parametrize(
    ("body", "found"),
    [
        ("class Own(Base):\n    def done(self): ...\n", "mien.b.Own.done overrides that of mien.a.Base"),
        ("class Own(Base):\n    size = 3\n    @property\n    def size(self): ...\n", "mien.b.Own.size overrides"),
        ("class Middle(Base): ...\n\nclass Own(Middle):\n    def done(self): ...\n", "mien.b.Own.done overrides"),
        (
            "class Own(Base):\n    def open(self): ...\n\nclass Last(Own):\n    def open(self): ...\n",
            "mien.b.Last.open overrides",
        ),
        ("class Own(Base):\n    def __init__(self): ...\n    def open(self): ...\n    def more(self): ...\n", None),
        ("class Own(Shape):\n    def draw(self): ...\n", None),
        ("from torch import nn\nclass Own(nn.Module):\n    def forward(self): ...\n", None),
        ("class Base:\n    def done(self): ...\n", None),
    ],
)
@pytest.mark.parametrize("way", ["from mien.a import Base, Shape", "from mien.door import Base, Shape"])
def test_overridden_methods_are_found(body: str, found: str | None, way: str) -> None:
    texts = {"src/mien/a.py": BASE, "src/mien/door.py": "from mien.a import Base, Shape\n"}
    faults = list(override_faults({**texts, "src/mien/b.py": f"{way}\n\n{body}"}))
    assert len(faults) == (found is not None)
    assert not faults or (faults[0].startswith("src/mien/b.py:") and str(found) in faults[0])


def test_a_base_class_by_its_module_and_of_a_generic_class_is_found() -> None:
    generic = "class Kept(Generic[T]):\n    def get(self): ...\n"
    user = "from mien import kept\n\nclass Own(kept.Kept[int]):\n    def get(self): ...\n"
    faults = list(override_faults({"src/mien/kept.py": generic, "src/mien/user.py": user}))
    assert len(faults) == 1


@pytest.mark.parametrize(("text", "count"), [
    ("from mien.face import _part\n", 1),
    ("from mien import _native\n_native.draw()\n", 0),
    ("from mien.face import loading\nloading._read(1)\nloading.read(1)\n", 1),
    ("import mien.face\nmien.face._part\n", 1),
    ("from mien import cli\nmonkeypatch.setattr(cli, '_run', None)\nmonkeypatch.setattr(cli, 'run', None)\n", 1),
    ("import pathlib\npathlib._x\nself._y\n", 0),
])  # fmt: skip
def test_private_names_of_mien_are_found_in_tests(text: str, count: int) -> None:
    assert len(list(private_faults({"tests/test_x.py": text}))) == count
