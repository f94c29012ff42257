"""Licences of everything that is installed beside mien, and of the models and data that mien uses.

`installed_licences` lists packages, `PARTS` what is inside mien's own files and inside packages. The facts are in
facts.toml. Nothing here is legal advice. `release/sbom.py` makes the SPDX document of mien's wheel from the same facts.
"""

import re
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import Distribution, distributions
from importlib.resources import files
from typing import Any

_FACTS: dict[str, Any] = tomllib.loads(files("mien.licences").joinpath("facts.toml").read_text(encoding="utf-8"))
_KINDS = {licence: kind for kind, licences in _FACTS["kinds"].items() for licence in licences}
PACKAGES: dict[str, tuple[str, str]] = _FACTS["packages"]
"""Name of a package -> its licence as an SPDX expression, and a note. They replace what its metadata says."""
_REQUIREMENT = re.compile(r"^\s*([A-Za-z0-9._-]+)\s*(?:\[([^\]]*)\])?")
_EXTRA = re.compile(r"""extra\s*==\s*['"]([^'"]+)['"]""")
_MEANINGS = {
    "public domain": "no conditions",
    "permissive": "keep its notices when you pass it on",
    "weak copyleft": "changes of its own files stay under its licence",
    "strong copyleft": "what you pass on together with it must be under its licence",
    "proprietary": "its maker's own terms; free to use, and not to be changed",
    "unknown": "read its licence before you use it",
}
"""Conditions of each kind, from the fewest conditions to the most."""
_ORDER = list(_MEANINGS)


@dataclass(frozen=True)
class Part:
    """Something under a licence of its own that is not a package: inside mien's files, or inside a package."""

    name: str
    licence: str
    """SPDX expression."""
    inside: str
    """The package that brings it. `mien` for what is in mien's own wheel."""
    used_for: str
    meaning: str = ""


PARTS = tuple(Part(**entry) for entry in _FACTS["parts"])


@dataclass(frozen=True)
class Licence:
    """An installed package."""

    name: str
    version: str
    declared: str
    """Licence in its metadata, word for word: the SPDX expression, else the classifiers, else the field `License`."""
    licence: str
    """SPDX expression, or what is declared if there is none for it."""
    kind: str
    used_for: str
    """Source of the package: an extra of mien, and the package that asks for it. "another program" if mien does not."""
    meaning: str


def installed_licences() -> list[Licence]:
    """All packages of this environment, sorted by name, whether mien asks for them or not."""
    found = {canonical(each.metadata["Name"]): each for each in distributions() if each.metadata["Name"]}
    reasons = _reasons(found)
    return [_licence(name, found[name], reasons.get(name, "another program")) for name in sorted(found)]


def canonical(name: str) -> str:
    """The name of a package as registries compare it (PEP 503)."""
    return re.sub(r"[-_.]+", "-", name).lower()


def kind_of(expression: str) -> str:
    """The kind of an SPDX expression: of "OR" the freest choice, of "AND" what asks for most."""
    parts = [part.strip(" ()") for part in re.split(r"\s+AND\s+", expression)]
    kinds = []
    for part in parts:
        choices = [_KINDS.get(choice.strip(" ()"), "unknown") for choice in re.split(r"\s+OR\s+", part)]
        kinds.append(min(choices, key=_ORDER.index))
    return max(kinds, key=_ORDER.index)


def _licence(name: str, package: Distribution, used_for: str) -> Licence:
    declared = _declared(package)
    known, note = PACKAGES.get(name, ("", ""))
    expression = known or _expression(declared, package)
    kind = kind_of(expression)
    meaning = f"{_MEANINGS[kind]}; {note}" if note else _MEANINGS[kind]
    return Licence(package.metadata["Name"], package.version, declared, expression, kind, used_for, meaning)


def _declared(package: Distribution) -> str:
    about = package.metadata
    if "License-Expression" in about:
        return about["License-Expression"]
    said = [entry.split(" :: ")[-1] for entry in about.get_all("Classifier") or [] if entry.startswith("License ::")]
    said = sorted(entry for entry in said if entry != "OSI Approved")
    return "; ".join(said) if said else (about["License"] if "License" in about else "") or "UNKNOWN"  # noqa: SIM401


def _expression(declared: str, package: Distribution) -> str:
    """The SPDX expression of what is declared. Classifiers side by side all apply."""
    if "License-Expression" in package.metadata:
        return declared
    first, *others = declared.splitlines()
    parts = []
    for part in [first] if others else first.removeprefix("DFSG approved; ").split("; "):  # tells who approves of it
        word = part.strip()
        parts.append(word if kind_of(word) != "unknown" else _FACTS["words"].get(word.lower(), word))
    return " AND ".join(dict.fromkeys(parts))


def _reasons(found: dict[str, Distribution]) -> dict[str, str]:
    """Why each package is there, for those that mien asks for, directly or through others."""
    reasons = {"mien": "is mien itself"}
    direct = [("base" if extra is None else extra, name, own) for name, own, extra in _requirements(found.get("mien"))]
    pending: list[tuple[str, frozenset[str], str]] = []
    for extra, name, own in sorted(direct, key=lambda each: (each[0] != "base", each[:2])):
        if name in found:
            reasons.setdefault(name, f"mien[{extra}]" if extra != "base" else "mien")
            pending.append((name, own, reasons[name]))
    followed = set(pending)
    while pending:
        asker, extras, root = pending.pop(0)
        for name, own, extra in _requirements(found[asker]):
            if name not in found or not (extra is None or extra in extras):
                continue
            reasons.setdefault(name, f"{root}, by {asker}")
            if (name, own, root) not in followed:
                followed.add((name, own, root))
                pending.append((name, own, root))
    return reasons


def _requirements(package: Distribution | None) -> Iterator[tuple[str, frozenset[str], str | None]]:
    """Name of each package that one asks for, the extras that it asks for of it, and the own extra that asks."""
    for line in (package.requires or []) if package is not None else []:
        text, _, marker = line.partition(";")
        match, extra = _REQUIREMENT.match(text), _EXTRA.search(marker)
        if match is not None:
            asked = frozenset(canonical(one.strip()) for one in (match.group(2) or "").split(",") if one.strip())
            yield canonical(match.group(1)), asked, canonical(extra.group(1)) if extra else None
