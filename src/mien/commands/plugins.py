"""`mien plugins`: what mien has, and what other packages add to it."""

import json
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from mien.machine.terminal import show

if TYPE_CHECKING:
    from mien.plugins import Added


@dataclass(frozen=True)
class Command:
    """List methods, formats and datasets: mien's own, and those of other packages, with their faults."""

    json: bool = False
    """Print an object for programs instead of a list."""

    def run(self) -> None:
        """Print the list."""
        from mien.avatar.methods import METHODS, Method
        from mien.datasets.dataset import Dataset
        from mien.datasets.registry import datasets
        from mien.formats.format import Format
        from mien.formats.registry import formats
        from mien.plugins import added

        found = {
            "methods": (list(METHODS), added("mien.methods", Method)),
            "formats": ([each.name for each in formats()], added("mien.formats", Format)),
            "datasets": ([each.name for each in datasets()], added("mien.datasets", Dataset)),
        }
        rows = {
            group: {"own": _without(names, others), "added": list(map(asdict, others))}
            for group, (names, others) in found.items()
        }
        if self.json:
            show(json.dumps(rows, indent=1))
            return
        for group, (names, others) in found.items():
            show(f"{group}: {', '.join(_without(names, others))}")
            for each in others:
                state = f"left out: {each.fault}" if each.fault else each.place
                show(f"  {each.name}, added by {each.package} {each.version} ({state})")
        groups = [f'"mien.{group}"' for group in found]
        show(f"Packages add to these by entry points of the groups {', '.join(groups[:-1])} and {groups[-1]}.")


def _without(names: list[str], others: "list[Added]") -> list[str]:
    """Mien's own names."""
    taken = {each.name for each in others}
    return [name for name in names if name not in taken]
