"""Three rules of CONTRIBUTING.md that no other tool checks: naming methods, overriding, and the private names of mien.

`make lint` runs this file in the repository's root. No file names a method but those of the method and those in
`MAY_NAME`. No class in src/mien overrides a method that a base class in src/mien implements. What may be overridden:
abstract methods, methods of protocols, methods with two underscores, and methods of other packages' classes, such as
torch's `forward`. No test uses a private name of mien: a test that does breaks with every change of what it tests.
"""

import ast
import importlib
import io
import pkgutil
import re
import sys
import tokenize
from collections.abc import Iterable, Iterator, Mapping
from functools import cached_property
from pathlib import Path
from types import FunctionType

import mien
from mien.avatar.methods import METHODS

MAY_NAME = {
    "src/mien/avatar/methods.py": "the list of methods",
    "src/mien/avatar/point_avatar/avatar.py": "uses the deformation network that its successor took over",
    "src/mien/lab/analysis/registry.py": "the list of analyses, one for the paper of each method",
    "src/mien/lab/benchmarking/__init__.py": "the list of benchmarks of training steps",
    "src/mien/lab/benchmarking/train_step.py": "measures the step of one method",
    "src/mien/lab/benchmarking/method_steps.py": "measures the steps of two methods",
    "src/mien/formats/registry.py": "the list of formats; one is named after the program whose files it reads",
    "src/mien/datasets/registry.py": "the list of datasets; one is named after the program whose files it reads",
    "src/mien/datasets/gaussian_avatars.py": "reads the files of that method's own program",
    "src/mien/formats/gaussian_avatars.py": "the files of that method's own program become its avatars",
}
"""Files that may name a method although they are not its own, and why."""
OWN = ("src/mien/avatar/{}/", "src/mien/avatar/{}.py", "src/mien/lab/analysis/{}.py", "src/mien/lab/analysis/{}_")
"""Files of a method itself."""


def naming_faults(texts: Mapping[str, str]) -> Iterator[str]:
    """Yield a message for each file that names a method and may not, and for each of `MAY_NAME` that names none.

    A method's name counts anywhere in a file, also in comments. Its classes count in code alone, since papers that
    docstrings cite are written like them.
    """
    idle = set(MAY_NAME)
    for place, text in texts.items():
        for name, method in METHODS.items():
            line = _line_of(place, text, name, (method.avatar_class.split(":")[1], method.config.__name__))
            if line is None or place.startswith(tuple(own.format(name) for own in OWN)):
                continue
            idle.discard(place)
            if place not in MAY_NAME:
                yield f"{place}:{line}: names the method {name}; ask what it is needed for of the avatar itself"
    yield from (f"tests/seams.py: {place} names no method any more; take it out of MAY_NAME" for place in sorted(idle))


def _line_of(place: str, text: str, name: str, classes: tuple[str, ...]) -> int | None:
    """The first line that names a method, or its classes in code."""
    found = re.search(rf"\b{name}\b", text)
    if found is not None:
        return text.count("\n", 0, found.start()) + 1
    if not place.endswith(".py") or not any(one in text for one in classes):
        return None
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return next((token.start[0] for token in tokens if token.type == tokenize.NAME and token.string in classes), None)


_METHODS = (FunctionType, property, cached_property, classmethod, staticmethod)


def classes_of_mien() -> list[type]:
    """Return every class in src/mien."""
    names = [each.name for each in pkgutil.walk_packages(mien.__path__, "mien.") if not each.name.endswith("__main__")]
    everything = [value for name in names for value in vars(importlib.import_module(name)).values()]
    return list(
        dict.fromkeys(one for one in everything if isinstance(one, type) and one.__module__.startswith("mien."))
    )


def override_faults(classes: Iterable[type]) -> Iterator[str]:
    """Yield a message for each method that a class overrides although a base class of its package implements it."""
    for one in classes:
        bases = [base for base in one.__mro__[1:] if base.__module__.split(".")[0] == one.__module__.split(".")[0]]
        for name, method in vars(one).items():
            if isinstance(method, _METHODS) and not re.fullmatch("__.*__", name):
                over = next((base for base in bases if _implements(base, name)), None)
                if over is not None:
                    place = f"{one.__module__}.{one.__qualname__}.{name}"
                    yield f"{place} overrides that of {over.__module__}.{over.__qualname__}, which is not abstract"


def _implements(base: type, name: str) -> bool:
    method = vars(base).get(name)
    is_abstract = getattr(method, "__isabstractmethod__", False) or getattr(base, "_is_protocol", False)
    return isinstance(method, _METHODS) and not is_abstract


_PRIVATE = re.compile(r"_[a-zA-Z]\w*")


def private_faults(texts: Mapping[str, str]) -> Iterator[str]:
    """Yield a message for each private name of a module or class of mien that a test imports, reads or replaces."""
    for place, text in texts.items():
        tree = ast.parse(text)
        ours: set[str] = set()
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom | ast.Import):
                module = getattr(node, "module", None) or ""
                for name in node.names:
                    if not f"{module}.{name.name}".strip(".").startswith("mien"):
                        continue
                    ours.add(name.asname or name.name.partition(".")[0])
                    if _PRIVATE.fullmatch(name.name) and name.name != "_native":
                        yield f"{place}:{node.lineno}: imports {name.name} of {module}; use what the room offers"
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and _PRIVATE.fullmatch(node.attr) and node.attr != "_native":
                if ast.unparse(node.value).partition(".")[0] in ours:
                    yield f"{place}:{node.lineno}: uses {ast.unparse(node)}; use what the room offers"
            elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("setattr") and len(node.args) > 1:
                owner, name = node.args[:2]
                replaced = ast.literal_eval(name) if isinstance(name, ast.Constant) else ""
                if ast.unparse(owner).partition(".")[0] in ours and _PRIVATE.fullmatch(str(replaced)):
                    yield f"{place}:{node.lineno}: replaces {replaced}; use what the room offers"


def main() -> int:
    """Check every source file, and report what breaks a rule."""
    python = {str(path): path.read_text() for path in sorted(Path("src/mien").rglob("*.py"))}
    scripts = {str(path): path.read_text() for path in sorted(Path("web/src").glob("*.ts"))}
    tests = {str(path): path.read_text() for path in sorted(Path("tests").rglob("*.py"))}
    faults = [*naming_faults(python | scripts), *override_faults(classes_of_mien())]
    faults += private_faults(tests)
    print("\n".join(faults) or f"Seams: {len(python | scripts | tests)} files checked; methods stay in their folders.")
    return bool(faults)


if __name__ == "__main__":
    sys.exit(main())
