"""The SPDX 2.3 document of mien's wheel: what is in it, and what it asks for, with licences.

It has no date and no version of what it asks for, because pip chooses these; `mien licenses --json` lists what is
installed. `python release/sbom.py > src/mien/sbom.spdx.json` writes what wheels carry (PEP 770).
"""

import json
import re
import tomllib
from pathlib import Path
from typing import Any

from mien.licences import PACKAGES, PARTS, canonical

_CREATED = "2026-11-26T00:00:00Z"
"""The format asks for a date. It is fixed, so that two builds give the same bytes."""
_LICENCES = {
    "numpy": "BSD-3-Clause",
    "safetensors": "Apache-2.0",
    "jaxtyping": "MIT",
    "lazy-loader": "BSD-3-Clause",
    "tyro": "MIT",
    "rich": "MIT",
    "torch": "BSD-3-Clause",
    "filelock": "MIT",
    "mediapipe": "Apache-2.0",
    "ai-edge-litert": "Apache-2.0",
    "pillow": "MIT-CMU",
    "jinja2": "BSD-3-Clause",
    "gsplat": "Apache-2.0",
    "viser": "MIT",
    "zstandard": "BSD-3-Clause",
    "submitit": "MIT",
    "ray": "Apache-2.0",
    "fsspec": "BSD-3-Clause",
    "s3fs": "BSD-3-Clause",
    "segno": "BSD-3-Clause",
    "starlette": "BSD-3-Clause",
    "uvicorn": "BSD-3-Clause",
}
"""Licences of what mien asks for, beside those of `PACKAGES`."""


def spdx_document(version: str, requirements: dict[str, str]) -> dict[str, Any]:
    """The document.

    Args:
        version: Version of mien.
        requirements: Name of each package that mien or an extra asks for, and that extra, or "" for mien itself.
    """
    packages = [_package("mien", version, "Apache-2.0", f"pkg:pypi/mien@{version}")]
    relations = [_relation("SPDXRef-DOCUMENT", "DESCRIBES", "mien")]
    for part in PARTS:
        if part.inside == "mien":
            packages.append(_package(part.name, None, part.licence, None, part.used_for))
            relations.append(_relation("SPDXRef-mien", "CONTAINS", part.name))
    for name in sorted(requirements):
        licence = PACKAGES[name][0] if name in PACKAGES else _LICENCES[name]
        packages.append(_package(name, None, licence, f"pkg:pypi/{name}"))
        kind = "OPTIONAL_DEPENDENCY_OF" if requirements[name] else "DEPENDENCY_OF"
        relations.append(_relation(f"SPDXRef-{_identifier(name)}", kind, "mien"))
    names = sorted({word for each in packages for word in re.findall(r"LicenseRef-[\w.-]+", each["licenseDeclared"])})
    return {
        "spdxVersion": "SPDX-2.3",
        "dataLicense": "CC0-1.0",
        "SPDXID": "SPDXRef-DOCUMENT",
        "name": f"mien-{version}",
        "documentNamespace": f"https://spdx.org/spdxdocs/mien-{version}",
        "creationInfo": {"created": _CREATED, "creators": [f"Tool: mien-{version}"]},
        "packages": packages,
        "relationships": relations,
        "hasExtractedLicensingInfos": [
            {
                "licenseId": name,
                "name": name.removeprefix("LicenseRef-"),
                "extractedText": "See the package's own files.",
            }
            for name in names
        ],
    }


def _package(name: str, version: str | None, licence: str, purl: str | None, comment: str = "") -> dict[str, Any]:
    package: dict[str, Any] = {
        "name": name,
        "SPDXID": f"SPDXRef-{_identifier(name)}",
        "downloadLocation": "NOASSERTION",
        "filesAnalyzed": False,
        "licenseConcluded": licence,
        "licenseDeclared": licence,
        "copyrightText": "NOASSERTION",
    }
    if version is not None:
        package["versionInfo"] = version
    if purl is not None:
        kind = {"referenceCategory": "PACKAGE-MANAGER", "referenceType": "purl"}
        package["externalRefs"] = [kind | {"referenceLocator": purl}]
    if comment:
        package["comment"] = comment
    return package


def _relation(source: str, kind: str, name: str) -> dict[str, str]:
    target = f"SPDXRef-{_identifier(name)}"
    return {"spdxElementId": source, "relationshipType": kind, "relatedSpdxElement": target}


def _identifier(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9.-]+", "-", name)


def requirements_of(project: dict[str, Any]) -> dict[str, str]:
    """The requirements in the table `project` of a pyproject.toml, by name, with the extra that asks for each."""
    lists = {"": project["dependencies"], **project["optional-dependencies"]}
    found: dict[str, str] = {}
    for extra, lines in lists.items():
        for line in lines:
            found.setdefault(canonical(re.split(r"[\s<>=!~;\[]", line, maxsplit=1)[0]), extra)
    return found


if __name__ == "__main__":
    project = tomllib.loads((Path(__file__).resolve().parents[1] / "pyproject.toml").read_text(encoding="utf-8"))[
        "project"
    ]
    print(json.dumps(spdx_document(project["version"], requirements_of(project)), indent=1))
