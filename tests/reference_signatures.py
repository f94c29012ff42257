"""Compute signatures of tiny versions of the reference captures.

`python tests/reference_signatures.py` rewrites the file.
"""

import json
from pathlib import Path

from mien.lab.synthetic import ReferenceCapture
from mien.lab.synthetic.references import REFERENCES
from mien.lab.synthetic.signature import signature_of

_FILE = Path(__file__).with_suffix(".json")


def stored_signatures() -> dict[str, dict[str, dict[str, list[float]]]]:
    """Return the stored signatures by reference, sequence and part."""
    return json.loads(_FILE.read_text(encoding="utf-8"))


def drawn_signatures(reference: ReferenceCapture) -> dict[str, dict[str, list[float]]]:
    """Return the signatures by sequence and part, as this machine draws them."""
    return {scene.recipe.name: signature_of(scene) for scene in reference.tiny().scenes()}


if __name__ == "__main__":
    drawn = {name: drawn_signatures(reference) for name, reference in REFERENCES.items()}
    _FILE.write_text(json.dumps(drawn, separators=(",", ":")).replace('},"', '},\n"') + "\n", encoding="utf-8")
