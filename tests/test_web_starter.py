"""The starter: a page of one's own with vite, from the package as npm packs it."""

import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest

from mien.export import write_packed
from test_web_element import LOADED, script, served
from web_case import WEB, browse, build, chromium, drawn_head, violations

PRESS = """
const buttons = [...document.querySelectorAll("nav button")];
const jaw = avatar.viewer.avatar.expression_names.indexOf("jawOpen");
buttons.find((button) => /surprise/i.test(button.textContent)).click();
return [buttons.length, avatar.viewer.face.expression[jaw]];
"""


def npm(folder: Path, *arguments: str | Path) -> None:
    command = [shutil.which("npm") or "npm", *map(str, arguments), "--no-audit", "--no-fund"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_the_starter_is_built_from_the_packed_package_and_shows_an_avatar(tmp_path: Path) -> None:
    chromium()
    package, starter = tmp_path / "package", tmp_path / "starter"
    package.mkdir()
    build(package / "dist")
    shutil.copy(WEB / "package.json", package)
    npm(package, "pack", "--ignore-scripts", "--pack-destination", tmp_path)
    (packed,) = tmp_path.glob("mien-web-*.tgz")
    shutil.copytree(WEB / "examples" / "starter", starter)
    npm(starter, "install", packed)
    write_packed(starter / "public" / "me.packed", drawn_head(3000))
    npm(starter, "run", "build")
    with served(starter / "dist") as address:
        told = browse(address, [script(LOADED, PRESS)], size=(640, 480), screenshots=[str(tmp_path / "page.png")])
        assert violations(address, (390, 844)) == []
    (count, jaw), shown = told["results"][0], cv2.imread(str(tmp_path / "page.png"))
    assert told["messages"] == []
    assert count >= 6
    assert jaw > 0.1
    assert shown is not None
    assert len(np.unique(shown.reshape(-1, 3), axis=0)) > 500, "a head in many colours is drawn"
