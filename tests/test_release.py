"""Releases: what the source distribution holds, and the licences of what is used."""

import json
import re
import subprocess
import sys
import tarfile
import tomllib
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
from scikit_build_core.build import build_sdist

from mien.cli import main
from mien.licences import PACKAGES, PARTS, canonical, installed_licences, kind_of

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "release"))
import make  # noqa: E402  # pyright: ignore[reportMissingImports]
from sbom import requirements_of, spdx_document  # noqa: E402  # pyright: ignore[reportMissingImports]


def test_the_source_distribution_is_small_and_has_what_a_wheel_is_built_from(tmp_path: Path, monkeypatch) -> None:
    """Tests, pictures, MediaPipe's code for pages and the network that only pages need would make it too large."""
    make.copy_tracked(tmp_path / "source")
    assert {path.stat().st_mode & 0o777 for path in (tmp_path / "source").rglob("*.py")} == {0o644}
    monkeypatch.chdir(tmp_path / "source")
    archive = tmp_path / build_sdist(str(tmp_path))
    assert archive.stat().st_size < make.MOST_SDIST_BYTES == 5_000_000
    with tarfile.open(archive) as tar:
        names = {name.partition("/")[2] for name in tar.getnames()}
    landmarker = "src/mien/formats/shared/landmarker/face_landmarker.task.xz"
    needed = {"pyproject.toml", "CMakeLists.txt", "native/bindings.cpp", f"{landmarker}.1"}
    assert {*needed, "src/mien/capture/data/selfie_segmentation.tflite.xz"} <= names
    unneeded = ("tests/", "web/", ".ci/", "benchmarks/", "docs/images/", "docs/pictures/", "docs/log.md", "build/")
    assert not [name for name in names if name.startswith((*unneeded, f"{landmarker}.2")) or "/vision_" in name]


PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


@pytest.fixture
def listed(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """What the command tells of each package and part."""
    assert main(["licenses", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    return {canonical(each["name"]): each for each in (*told["parts"], *told["packages"])}


def test_no_package_has_changed_the_kind_of_its_licence_and_kinds_are_read_from_expressions():
    """A new package, or another licence, is looked at by a person, who then changes `licence_kinds.json`.

    What is neither recorded nor locked was installed beside mien, such as the engines of batches.
    """
    kinds = json.loads((ROOT / "tests/licence_kinds.json").read_text())
    recorded = {name: kind for kind, names in kinds.items() for name in names}
    locked = re.findall(r"^([\w.-]+)==", (ROOT / "requirements/lock.txt").read_text(), re.M)
    looked_at = {*recorded, *map(canonical, locked)}
    found = {canonical(each.name): each.kind for each in installed_licences() if canonical(each.name) in looked_at}
    changed = {name: kind for name, kind in found.items() if recorded.get(name, "not recorded") != kind}
    assert changed == {}, "look at these licences, and record their kinds in tests/licence_kinds.json"
    assert "unknown" not in {*found.values(), *(kind_of(part.licence) for part in PARTS)}
    for expression, kind in {
        "MIT": "permissive", "MIT-0": "public domain", "MIT OR GPL-2.0-or-later": "permissive",
        "BSD-3-Clause AND LGPL-2.1-or-later": "weak copyleft", "MPL-2.0 AND MIT": "weak copyleft",
        "Apache-2.0 AND (MIT OR LicenseRef-NVIDIA-Proprietary)": "permissive",
        "GPL-2.0-or-later": "strong copyleft", "MIT AND CC-BY-NC-4.0": "unknown",
    }.items():  # fmt: skip
        assert kind_of(expression) == kind, expression


def test_every_package_is_named_with_what_brings_it_as_pip_licenses_lists_it(listed: dict[str, Any], capsys):
    used = {name: listed[name]["used_for"] for name in ("numpy", "torch", "kiwisolver", "viser")}
    assert list(used.values()) == ["mien", "mien[create]", "mien[create], by matplotlib", "mien[viewer]"]
    x264 = listed[canonical("x264 and x265")]
    assert (listed["mien"]["licence"], x264["licence"]) == ("Apache-2.0", "GPL-2.0-or-later")
    assert "pip install --no-binary av av" in x264["meaning"]
    assert main(["licenses"]) == 0
    assert "keep its notices when you pass it on" in capsys.readouterr().out
    # Row by row: the same packages and versions, and what both read as the declared licence.
    command = [sys.executable, "-m", "piplicenses", "--format=json", "--with-system", "--from=mixed"]
    theirs = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    assert {canonical(row["Name"]) for row in theirs} == {name for name, own in listed.items() if "version" in own}
    for row in theirs:
        own = listed[canonical(row["Name"])]
        assert row["Version"] == own["version"]
        if row["License"] != "UNKNOWN" and canonical(row["Name"]) not in PACKAGES:
            assert row["License"] == own["declared"], row["Name"]


def test_the_bill_of_materials_is_up_to_date_and_mediapipe_older_than_its_statistics():
    written = json.loads((ROOT / "src/mien/sbom.spdx.json").read_text(encoding="utf-8"))
    expected = spdx_document(PROJECT["version"], requirements_of(PROJECT))
    assert written == expected, "run: python release/sbom.py > src/mien/sbom.spdx.json"
    assert {"numpy", "torch", "mediapipe", "nanobind", "mien"} <= {each["name"] for each in written["packages"]}
    # From 0.10.35 on, mediapipe declares that it sends usage metrics to its maker (docs/platforms.md).
    asked = next(line for line in PROJECT["optional-dependencies"]["create"] if line.startswith("mediapipe"))
    pinned = asked.partition(";")[0].removeprefix("mediapipe==").strip()
    assert tuple(map(int, pinned.split("."))) < (0, 10, 35)
    assert version("mediapipe") == pinned
    assert f"mediapipe=={pinned} " in (ROOT / "requirements/lock.txt").read_text(encoding="utf-8")
