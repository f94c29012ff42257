"""Limits that no other tool checks: lines of functions in Python and C++, parameters in C++, lines of a file of tests.

`make lint` runs this file in the repository's root; ruff (PLR0913) counts the parameters of Python's functions. C++ is
not parsed: the layout that clang-format gives it tells where a function begins and ends."""

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

MOST_LINES = 60
MOST_PARAMETERS = 10
MOST_LINES_OF_TESTS = 400
_COMMENT_OR_STRING = re.compile(r'//[^\n]*|/\*.*?\*/|"(?:\\.|[^"\\\n])*"', re.DOTALL)
_TEMPLATE_ARGUMENTS = re.compile(r"<[^<>()]*>")
_NOT_A_FUNCTION = re.compile(r"\s*(?:namespace|class|struct|union|enum|extern)\b[^()]*\{|[^(]*=[^(]*\{")
_HEAD = re.compile(r"(\w+)\(([^()]*(?:\([^()]*\)[^()]*)*)\)(?: const| noexcept| override| ->[^{;]*)* (?:\{|:[^:])")
"""A name, what is in its round brackets, and the begin of a body or of a constructor's initialisers."""


def python_faults(path: Path, text: str) -> Iterator[str]:
    """Yield a message for each function of a Python file that has too many lines."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            lines = (node.end_lineno or node.lineno) - node.lineno + 1
            if lines > MOST_LINES:
                yield f"{path}:{node.lineno}: {node.name} has {lines} lines; at most {MOST_LINES}"


def cpp_faults(path: Path, text: str) -> Iterator[str]:
    """Yield a message for each function of a C++ file that has too many lines or parameters."""
    rows, inside = text.split("\n"), -1
    for first, row in enumerate(rows):
        indent = row[: len(row) - len(row.lstrip())]
        if first <= inside or not row.strip() or len(indent) > 4:
            continue
        # The end of what begins here: the first row that is not further in.
        end = next((i for i in range(first + 1, len(rows)) if re.match(rf"{indent}\S", rows[i])), first)
        head = "\n".join(rows[first:end])
        if rows[end] != indent + "}" or "(" not in head or _NOT_A_FUNCTION.match(head):
            continue
        inside = end
        if end - first + 1 > MOST_LINES:
            yield f"{path}:{first + 1}: {end - first + 1} lines; at most {MOST_LINES}"
    plain = _blanked(_COMMENT_OR_STRING, text)
    for _ in range(3):  # arguments within arguments
        plain = _blanked(_TEMPLATE_ARGUMENTS, plain)
    for found in _HEAD.finditer(plain):
        count = sum(len(one.split()) > 1 for one in found[2].split(","))
        if count > MOST_PARAMETERS and found[1] not in ("if", "for", "while", "switch"):
            line = plain.count("\n", 0, found.start()) + 1
            yield f"{path}:{line}: {found[1]} has {count} parameters; at most {MOST_PARAMETERS}"


def _blanked(pattern: re.Pattern[str], text: str) -> str:
    """The text without what the pattern finds; line breaks stay."""
    return pattern.sub(lambda found: "\n" * found[0].count("\n"), text)


def main() -> int:
    """Check every source file, and report what exceeds a limit."""
    faults, count = [], 0
    for folder in ("src", "tests", "examples", "benchmarks", "native"):
        for path in sorted(Path(folder).rglob("*")):
            check = {".py": python_faults, ".cpp": cpp_faults, ".h": cpp_faults}.get(path.suffix)
            if check is not None:
                text = path.read_text()
                faults += check(path, text)
                count += 1
                if folder == "tests" and (lines := text.count("\n")) > MOST_LINES_OF_TESTS:
                    faults.append(f"{path}: {lines} lines; at most {MOST_LINES_OF_TESTS} in a file of tests")
    print("\n".join(faults) or f"Sizes: {count} files checked, nothing exceeds a limit.")
    return bool(faults)


if __name__ == "__main__":
    sys.exit(main())
