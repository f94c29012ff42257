"""The package as npm packs it, and the starter: a page of one's own with vite, built from the package."""

import json
import shutil
import subprocess
import tarfile
from pathlib import Path

import numpy as np
import pytest

from mien.export import write_packed
from test_web_element import LOADED
from web_case import WEB, browse, drawn_head, node, picture, script, served, violations

PRESS = """
const buttons = [...document.querySelectorAll("nav button")];
const jaw = avatar.viewer.avatar.expression_names.indexOf("jawOpen");
buttons.find((button) => /surprise/i.test(button.textContent)).click();
avatar.viewer.draw();
return [buttons.length, avatar.viewer.face.expression[jaw], avatar.viewer.canvas.toDataURL()];
"""


def npm(folder: Path, *arguments: str | Path) -> str:
    command = [shutil.which("npm") or "npm", *map(str, arguments)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def packed(built: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package, packed, with the types that its script makes."""
    folder = tmp_path_factory.mktemp("package")
    for name in ("package.json", "README.md", "LICENSE"):
        shutil.copy(WEB / name, folder)
    shutil.copytree(built, folder / "dist")
    npm(WEB, "run", "types", "--", "--outDir", folder / "dist" / "types")
    npm(folder, "pack", "--ignore-scripts")
    (found,) = folder.glob("mien-web-*.tgz")
    return found


def test_the_package_has_what_it_promises(packed: Path) -> None:
    """Every file that package.json names is built, with types, and nothing else goes to a registry."""
    package = json.loads((WEB / "package.json").read_text())
    assert "dependencies" not in package
    readme = (WEB / "README.md").read_text()
    assert "](" not in readme.replace("](https://", ""), "links to files of the repository lead nowhere on npm"
    assert (WEB / "LICENSE").read_text() == (WEB.parent / "LICENSE").read_text()
    with tarfile.open(packed) as archive:
        files = {name.removeprefix("package/") for name in archive.getnames()}
    wanted = {path.removeprefix("./") for export in package["exports"].values() for path in export.values()}
    assert wanted <= files
    beside = {"README.md", "LICENSE", "package.json"}
    assert beside <= files
    assert all(path.startswith("dist/") for path in files - beside)


@pytest.mark.parametrize("is_built", [True, False])
def test_packing_leaves_what_was_there(is_built: bool, tmp_path: Path) -> None:
    """`npm pack` builds the package, and removes the build if there was none before."""
    node()
    scripts = json.loads((WEB / "package.json").read_text())["scripts"] | {
        "build": "mkdir -p dist && touch dist/mien.js"
    }
    (tmp_path / "package.json").write_text(
        json.dumps({"name": "a", "version": "1.0.0", "files": ["dist"], "scripts": scripts})
    )
    if is_built:
        (tmp_path / "dist").mkdir()
    (made,) = json.loads(npm(tmp_path, "pack", "--json"))
    assert (tmp_path / "dist").exists() == is_built
    assert not (tmp_path / ".dist_stays").exists()
    assert {entry["path"] for entry in made["files"]} == {"package.json", "dist/mien.js"}


def test_the_starter_is_built_from_the_packed_package_and_shows_an_avatar(packed: Path, tmp_path: Path) -> None:
    starter = Path(shutil.copytree(WEB / "examples" / "starter", tmp_path / "starter"))
    npm(starter, "install", packed, "--no-audit", "--no-fund")
    write_packed(starter / "public" / "me.packed", drawn_head(500))
    npm(starter, "run", "build")
    with served(starter / "dist") as address:
        told = browse(address, [script(LOADED, PRESS)], size=(640, 480))
        assert violations(address, (390, 844), (), "", LOADED) == [], "before and after its avatar is there"
    (count, jaw, shown) = told["results"][0]
    assert told["messages"] == []
    assert count >= 6
    assert jaw > 0.1
    assert len(np.unique(picture(shown).reshape(-1, 4), axis=0)) > 500, "a head in many colours is drawn"
