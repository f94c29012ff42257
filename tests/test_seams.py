"""`seams.py` and `sizes.py` find what they are meant for and nothing else; the native module is what its stub says."""

import ast
from pathlib import Path

import mien
from mien import _native
from seams import MethodNames, naming_faults, override_faults, private_faults
from sizes import cpp_faults, python_faults

METHODS = [MethodNames("old", ("OldAvatar", "OldConfig")), MethodNames("new_one", ("NewOne", "NewOneConfig"))]
NAMES = {
    "src/mien/a.py": ("import mien\n\nif method == 'new_one':\n    pass\n", 3),
    "src/mien/b.py": ("from mien.avatar import (\n    NewOneConfig,\n)\n", 2),
    "src/mien/avatar/old/avatar.py": ("x = NewOne\n", 1),
    "web/src/points.ts": ("// new_one\n", 1),
    "src/mien/avatar/new_one/avatar.py": ("class NewOne:\n    name = 'new_one'\n", None),
    "src/mien/lab/analysis/new_one/__init__.py": ("method = 'new_one'\n", None),
    "src/mien/c.py": ('"""The paper NewOne."""\nfrom mien.export.new_one_folder import NewOneFolder\n', None),
    "list.py": ("METHODS = ['old', 'new_one']\n", None),
    "idle.py": ("pass\n", None),
}
"""Files, and the lines that name a method and may not."""
BASE = """
class Base(nn.Module, ABC):
    def __init__(self): ...
    @abstractmethod
    def open(self): ...
    def done(self): ...
    def forward(self): ...
class Shape(Protocol):
    def draw(self): ...
"""
OWN = """from mien import a
from mien.door import Base, Shape
from torch import nn
class Own(Base):
    def __init__(self): ...
    def open(self): ...
    def done(self): ...
class Last(Own, Shape, nn.Module):
    def open(self): ...
    def draw(self): ...
    def forward(self): ...
class Far(a.Base[int]):
    def done(self): ...
"""
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
CPP = """
namespace {{

struct Counter {{
  template <typename T>
  explicit Counter(const std::pair<T, int>& first,
                   int second) : first_(first), second_{{second}} {{
    {member}
  }}
}};

}}  // namespace

int counted({parameters}) {{
  {body}
}}
"""


def test_what_seams_finds() -> None:
    told = "names the method new_one; ask what it is needed for of the avatar itself"
    texts = {place: text for place, (text, _) in NAMES.items()}
    found = list(naming_faults(texts, METHODS, {"list.py": "", "idle.py": ""}))
    expected = [f"{place}:{line}: {told}" for place, (_, line) in NAMES.items() if line]
    assert found == [*expected, "tests/seams.py: idle.py names no method any more; take it out of MAY_NAME"]
    door = "from mien.a import Base, Shape\n"
    faults = override_faults({"src/mien/a.py": BASE, "src/mien/door.py": door, "src/mien/b.py": OWN})
    assert [fault.split(",")[0] for fault in faults] == [
        "src/mien/b.py:7: mien.b.Own.done overrides that of mien.a.Base",
        "src/mien/b.py:9: mien.b.Last.open overrides that of mien.b.Own",
        "src/mien/b.py:11: mien.b.Last.forward overrides that of mien.a.Base",
        "src/mien/b.py:13: mien.b.Far.done overrides that of mien.a.Base",
    ]
    assert sorted(fault.split(":")[1] for fault in private_faults({"t.py": PRIVATE})) == ["1", "4", "6", "9"]


def test_what_sizes_finds() -> None:
    place = Path("file")
    python = "def fits():\n" + 59 * "    pass\n" + "def count():\n" + 60 * "    pass\n"
    assert list(python_faults(place, python)) == ["file:61: count has 61 lines; at most 60"]
    for lines in (57, 58, 59):
        body = ["if (a) {", *["  b();"] * (lines - 2), "}"]
        parameters = ", ".join(f"const Array<float, nb::shape<-1, 3>>& p{i}" for i in range(lines - 48))
        text = CPP.format(member="\n    ".join(body), body="\n  ".join(body), parameters=parameters)
        sizes = {6: lines + 3, 13 + lines: lines + 2}
        expected = [f"file:{line}: {size} lines; at most 60" for line, size in sizes.items() if size > 60]
        many = [f"file:{13 + lines}: counted has 11 parameters; at most 10"] if lines == 59 else []
        assert list(cpp_faults(place, text)) == expected + many


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
