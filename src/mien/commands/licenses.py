"""`mien licenses`: what is installed, under which terms."""

import json
from dataclasses import asdict, dataclass

from mien.machine.terminal import show


@dataclass(frozen=True)
class Command:
    """List every installed package, model and part with its licence, who uses it, and what that means for you."""

    json: bool = False
    """Print a list of objects for programs instead of a table."""

    def run(self) -> None:
        """Print the list."""
        from mien.licences import PARTS, installed_licences

        packages = installed_licences()
        present = {package.name.lower() for package in packages}
        parts = [part for part in PARTS if part.inside in present]
        if self.json:
            show(json.dumps({"packages": list(map(asdict, packages)), "parts": list(map(asdict, parts))}, indent=1))
            return
        rows = [(each.name, each.version, each.licence, each.used_for, each.meaning) for each in packages]
        rows += [(each.name, f"in {each.inside}", each.licence, each.used_for, each.meaning) for each in parts]
        widths = [max(len(row[column]) for row in rows) for column in range(3)]
        for name, version, licence, used_for, meaning in rows:
            first = f"{name:<{widths[0]}}  {version:<{widths[1]}}  {licence}"
            show(f"{first}\n    {used_for}{f': {meaning}' if meaning else ''}")
        show(f"{len(packages)} packages, {len(parts)} parts. This is no legal advice; `--json` is for programs.")
