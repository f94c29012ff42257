"""The sub-rooms of tracking: few arrows between them, none in a circle, and only doors are imported from outside."""

import ast
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import mien.tracking

ROOT = Path(str(mien.tracking.__file__)).parent
CONSTANTS = "constants"
"""A folder that is no sub-room: the constants of all of them, which import nothing."""
ROOMS = sorted(path.name for path in ROOT.iterdir() if (path / "__init__.py").is_file() and path.name != CONSTANTS)
MAX_ARROWS = 12


def imported(path: Path) -> Iterator[str]:
    """Full names of the modules that a file imports from."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def arrows() -> set[tuple[str, str]]:
    """Pairs of sub-rooms of which the first imports the second."""
    found = set()
    for room in ROOMS:
        for path in (ROOT / room).rglob("*.py"):
            for name in imported(path):
                parts = name.split(".")
                if parts[:2] == ["mien", "tracking"] and len(parts) > 2 and parts[2] in set(ROOMS) - {room}:
                    found.add((room, parts[2]))
    return found


def test_sub_rooms_are_the_six_of_the_design():
    assert ROOMS == ["descent", "eyelids", "fitting", "landmarks", "pixels", "report"]


def test_few_arrows_and_no_circle():
    found = arrows()
    assert len(found) <= MAX_ARROWS, sorted(found)
    graph = {room: {other for first, other in found if first == room} for room in ROOMS}
    assert list(TopologicalSorter(graph).static_order()), "raises CycleError where sub-rooms import each other"


def test_files_that_all_sub_rooms_may_use_import_none_of_them():
    """What stands beside the sub-rooms is below all of them or above all of them."""
    below = {"constants", "settings", "tracking", "neck_line", "neck_cut"}
    for path in (*ROOT.glob("*.py"), *(ROOT / CONSTANTS).glob("*.py")):
        rooms = {name.split(".")[2] for name in imported(path) if name.startswith("mien.tracking.")} & set(ROOMS)
        stem = CONSTANTS if path.parent.name == CONSTANTS else path.stem
        assert stem not in below or not rooms, f"{path.name} imports {sorted(rooms)}"
    for room in ROOMS:
        for path in (ROOT / room).rglob("*.py"):
            beside = {name.split(".")[2] for name in imported(path) if name.startswith("mien.tracking.")} - set(ROOMS)
            assert beside <= below, f"{room}/{path.name} imports {sorted(beside - below)}"


def test_only_doors_are_imported_from_outside():
    """In tests, files of a sub-room may be imported as well."""
    for path in ROOT.parent.rglob("*.py"):
        for name in imported(path):
            parts = name.split(".")
            if parts[:2] == ["mien", "tracking"] and len(parts) > 3:
                inside = path.is_relative_to(ROOT / parts[2])
                assert inside, f"{path.relative_to(ROOT.parent)} imports {name}, which is behind a door"
