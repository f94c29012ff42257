"""Prints the SPDX document for a pyproject.toml: `python -m mien.licences pyproject.toml > src/mien/sbom.spdx.json`."""

import json
import sys
import tomllib
from pathlib import Path

from mien.licences.spdx import requirements_of, spdx_document

project = tomllib.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))["project"]
print(json.dumps(spdx_document(project["version"], requirements_of(project)), indent=1))
