"""`mien licenses`: kinds of licences do not change unseen, and its list is that of an independent program."""

import json
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path

import pytest

from mien.cli import main
from mien.licences import PARTS, installed_licences, spdx_document
from mien.licences.facts import PACKAGES
from mien.licences.installed import canonical, kind_of
from mien.licences.spdx import requirements_of

ROOT = Path(__file__).resolve().parents[1]
KINDS = Path(__file__).parent / "licence_kinds.json"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_no_package_has_changed_the_kind_of_its_licence():
    """A new package, or another licence, is looked at by a person, who then changes `licence_kinds.json`."""
    recorded = {name: kind for kind, names in json.loads(KINDS.read_text()).items() for name in names}
    found = {canonical(each.name): each.kind for each in installed_licences()}
    changed = {name: kind for name, kind in found.items() if recorded.get(name, "not recorded") != kind}
    assert changed == {}, "look at these licences, and record their kinds in tests/licence_kinds.json"


def test_no_licence_is_unknown_and_so_none_forbids_commercial_use():
    assert [each for each in installed_licences() if each.kind == "unknown"] == []
    assert [part for part in PARTS if kind_of(part.licence) == "unknown"] == []


@pytest.mark.parametrize(
    ("expression", "kind"),
    [
        ("MIT", "permissive"),
        ("MIT-0", "public domain"),
        ("MIT OR GPL-2.0-or-later", "permissive"),
        ("BSD-3-Clause AND LGPL-2.1-or-later", "weak copyleft"),
        ("MPL-2.0 AND MIT", "weak copyleft"),
        ("Apache-2.0 AND (MIT OR LicenseRef-NVIDIA-Proprietary)", "permissive"),
        ("GPL-2.0-or-later", "strong copyleft"),
        ("CC-BY-NC-4.0", "unknown"),
        ("MIT AND CC-BY-NC-4.0", "unknown"),
    ],
)
def test_kinds_of_expressions(expression: str, kind: str):
    assert kind_of(expression) == kind


def test_every_package_is_named_with_what_brings_it(capsys: pytest.CaptureFixture[str]):
    assert main(["licenses", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    rows = {canonical(each["name"]): each for each in listed["packages"]}
    assert rows["mien"]["licence"] == "Apache-2.0"
    assert rows["numpy"]["used_for"] == "mien"
    assert rows["torch"]["used_for"] == "mien[create]"
    assert rows["kiwisolver"]["used_for"] == "mien[create], by matplotlib"
    assert rows["viser"]["used_for"] == "mien[viewer]"
    parts = {each["name"]: each for each in listed["parts"]}
    assert parts["x264 and x265"]["licence"] == "GPL-2.0-or-later"
    assert "pip install --no-binary av av" in parts["x264 and x265"]["meaning"]
    assert main(["licenses"]) == 0
    assert "keep its notices when you pass it on" in capsys.readouterr().out


def test_the_list_is_that_of_pip_licenses(capsys: pytest.CaptureFixture[str]):
    """Row by row: the same packages and versions, and what both read as the declared licence."""
    theirs = json.loads(run(["-m", "piplicenses", "--format=json", "--with-system", "--from=mixed"]))
    assert main(["licenses", "--json"]) == 0
    ours = {canonical(each["name"]): each for each in json.loads(capsys.readouterr().out)["packages"]}
    assert {canonical(row["Name"]) for row in theirs} == set(ours)
    for row in theirs:
        own = ours[canonical(row["Name"])]
        assert row["Version"] == own["version"]
        if row["License"] != "UNKNOWN" and canonical(row["Name"]) not in PACKAGES:
            assert row["License"] == own["declared"], row["Name"]


def run(words: Sequence[str]) -> str:
    return subprocess.run([sys.executable, *words], capture_output=True, text=True, check=True).stdout


def test_the_bill_of_materials_in_the_wheel_is_up_to_date():
    written = json.loads((ROOT / "src/mien/sbom.spdx.json").read_text(encoding="utf-8"))
    expected = spdx_document(PROJECT["version"], requirements_of(PROJECT))
    assert written == expected, "run: python -m mien.licences pyproject.toml > src/mien/sbom.spdx.json"
    assert {"numpy", "torch", "mediapipe", "nanobind", "mien"} <= {each["name"] for each in written["packages"]}


def test_mediapipe_is_older_than_its_statistics():
    """From 0.10.35 on, mediapipe declares that it sends usage metrics to its maker (docs/platforms.md)."""
    from importlib.metadata import version

    asked = next(line for line in PROJECT["optional-dependencies"]["create"] if line.startswith("mediapipe"))
    pinned = asked.partition(";")[0].removeprefix("mediapipe==").strip()
    assert tuple(map(int, pinned.split("."))) < (0, 10, 35)
    assert version("mediapipe") == pinned
    assert f"mediapipe=={pinned} " in (ROOT / "requirements/lock.txt").read_text(encoding="utf-8")
