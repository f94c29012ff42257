"""Print how many rooms src/mien has, how many pairs of which one imports the other, and how many circles they make.

A room is a package, or a file beside the packages. Imports for types alone do not count. A circle is a set of rooms of
which each reaches each other by imports. `make lint` runs this file.
"""

import sys
from collections.abc import Mapping

import grimp


def imports_of_rooms(package: str) -> dict[str, set[str]]:
    """The other rooms that each room of a package imports from."""
    graph = grimp.build_graph(package, exclude_type_checking_imports=True)
    room = {}
    for module in graph.modules - {package}:
        above = module.rpartition(".")[0]
        room[module] = module if above == package or graph.find_children(module) else above
    imports: dict[str, set[str]] = {name: set() for name in room.values()}
    for module, name in room.items():
        imports[name] |= {room[other] for other in graph.find_modules_directly_imported_by(module) if other in room}
    return {name: others - {name} for name, others in imports.items()}


def circles(imports: Mapping[str, set[str]]) -> list[list[str]]:
    """The sets of rooms that reach each other."""
    reached = {name: set(others) for name, others in imports.items()}
    for between in imports:
        for others in reached.values():
            if between in others:
                others |= reached[between]
    found = {tuple(sorted(n for n in reached[name] if name in reached[n])) for name in imports if name in reached[name]}
    return sorted([*circle] for circle in found)


if __name__ == "__main__":
    imports = imports_of_rooms(sys.argv[1])
    in_circles = circles(imports)
    print(f"{len(imports)} rooms, {sum(map(len, imports.values()))} pairs, {len(in_circles)} circles", end="")
    print("".join(f"\n  {', '.join(circle)}" for circle in in_circles))
