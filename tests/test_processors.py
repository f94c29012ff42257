"""The table of docs/reproducibility.md shows no difference for equal bytes, and the right amount otherwise."""

import importlib.util
from pathlib import Path

import numpy as np

_FILE = Path(__file__).parents[1] / "benchmarks" / "processors.py"


def test_the_table_tells_differences(tmp_path: Path) -> None:
    spec = importlib.util.spec_from_file_location("processors", _FILE)
    assert spec is not None
    assert spec.loader is not None
    processors = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(processors)
    pictures, vertices, landmarks = np.zeros((2, 8, 8, 3)), np.zeros((2, 5, 3)), np.zeros((2, 4, 2))
    for name, shift in (("here", 0.0), ("isa-avx2", 0.0), ("old", 0.01)):
        np.savez(
            tmp_path / f"{name}.npz", trained=pictures + shift, rendered=pictures, clip=pictures + 0.1,
            vertices=vertices, landmarks=landmarks + shift,
        )  # fmt: skip
    rows = processors.format_table(tmp_path, ["here", "isa-avx2", "old"]).splitlines()
    assert rows[2] == "| the machine as it is | | | 20.0 dB | | |"
    assert rows[3] == "| `MIEN_ISA=avx2` | same bytes | same bytes | 20.0 dB | same bytes | same bytes |"
    assert rows[4].endswith("| same bytes | 40.0 dB | 20.9 dB | same bytes | 0.014 px (most 0.014) |")
