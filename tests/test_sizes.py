"""The limits of `sizes.py` hold for what they are meant for, and the native module is what its stub says."""

import ast
from pathlib import Path

import pytest

import mien
from mien import _native
from sizes import cpp_faults, python_faults

PLACE = Path("file")
STUB = Path(mien.__file__).with_name("_native.pyi")
PYTHON = """
class Counter:
    def count(self):
        {body}
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


@pytest.mark.parametrize(("lines", "count"), [(59, 0), (60, 1)])
def test_long_functions_of_python_are_found(lines: int, count: int) -> None:
    faults = list(python_faults(PLACE, PYTHON.format(body="\n        ".join(["pass"] * lines))))
    assert len(faults) == count
    assert not count or faults == ["file:3: count has 61 lines; at most 60"]


@pytest.mark.parametrize("lines", [57, 58, 59])
def test_long_functions_of_cpp_are_found(lines: int) -> None:
    body = ["if (a) {", *["  b();"] * (lines - 2), "}"]
    text = CPP.format(member="\n    ".join(body), body="\n  ".join(body), parameters="")
    sizes = {6: lines + 3, 13 + lines: lines + 2}
    expected = [f"file:{line}: {size} lines; at most 60" for line, size in sizes.items() if size > 60]
    assert list(cpp_faults(PLACE, text)) == expected


@pytest.mark.parametrize(("count", "found"), [(10, 0), (11, 1)])
def test_many_parameters_of_cpp_are_found(count: int, found: int) -> None:
    parameters = ", ".join(f"const Array<float, nb::shape<-1, 3>>& p{i}" for i in range(count))
    faults = list(cpp_faults(PLACE, CPP.format(member="", body="call(1, 2, 3);", parameters=parameters)))
    assert faults == ["file:14: counted has 11 parameters; at most 10"] * found


def test_the_stub_lists_what_the_native_module_has() -> None:
    body = ast.parse(STUB.read_text()).body
    functions = {node.name: node.args.args for node in body if isinstance(node, ast.FunctionDef)}
    classes = {node.name: node for node in body if isinstance(node, ast.ClassDef)}
    constants = {
        node.target.id for node in body if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
    }
    assert {*functions, *classes, *constants} == {name for name in dir(_native) if not name.startswith("_")}
    for name, node in classes.items():
        fields = [
            one.target.id for one in node.body if isinstance(one, ast.AnnAssign) and isinstance(one.target, ast.Name)
        ]
        assert fields == list(getattr(getattr(_native, name), "_fields", ())), name
        assert len(fields) <= 10
    for name, given in functions.items():
        signature = getattr(_native, name).__doc__.splitlines()[0]
        assert all(f"{one.arg}: " in signature for one in given), signature
        assert signature.count(": ") == len(given), signature
