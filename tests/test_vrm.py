"""A .vrm file: what @pixiv/three-vrm makes of it in a real browser, and the validator."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mien.cli import main
from mien.export import read_glb, write_vrm
from mien.export.vrm import BODY, LICENCE
from mien.runtime.named import visemes
from needs import NO_THREE_VRM, NO_VALIDATOR
from shared_things import MadeOnce, toy_workspace
from test_glb import mesh_model
from web_case import WEB, browse, bundle, drawn_head, picture, run_node, served

SIDE = 256
PAGE = '<link rel="icon" href="data:,"><body></body>'
OPEN = f"""(async () => {{
  const {{ open }} = await import("./vrm.bundle.js");
  const {{ vrm, shown }} = (window.opened = await open("drawn.vrm", {SIDE}));
  const {{ expressionManager: manager, humanoid, meta }} = vrm;
  return {{
    meta: {{ ...meta, thumbnailImage: meta.thumbnailImage?.naturalWidth }},
    presets: Object.keys(manager.presetExpressionMap), custom: Object.keys(manager.customExpressionMap),
    bones: Object.fromEntries(Object.keys(humanoid.humanBones).map((name) => [name,
      humanoid.getRawBoneNode(name).getWorldPosition(vrm.scene.position.clone()).toArray()])),
  }};
}})()"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a .vrm file, and a page that opens it."""
    if not (WEB / "node_modules" / "@pixiv" / "three-vrm").is_dir():
        pytest.skip(NO_THREE_VRM)
    path = tmp_path_factory.mktemp("vrm")
    portable = drawn_head(3000)
    write_vrm(path / "drawn.vrm", portable, mesh_model(portable), 128)
    bundle(WEB / "tests" / "vrm.mjs", path / "vrm.bundle.js")
    (path / "index.html").write_text(PAGE)
    return path


def shown(*given: Any) -> str:
    return f"opened.shown(...{json.dumps(given)})"


def middle(moved: np.ndarray) -> tuple[float, float]:
    """Return where pictures differ, as shares of height and width, in the mean."""
    rows, columns = np.nonzero(moved.max(-1) > 20)
    assert len(rows) > 20, "nothing has moved"
    return float(rows.mean() / len(moved)), float(columns.mean() / moved.shape[1])


def test_three_vrm_opens_the_file_and_moves_the_face(folder: Path) -> None:
    steps = [OPEN, shown(), shown({"aa": 1}), shown({"blinkLeft": 1}), shown({"browInnerUp": 1}), shown({"happy": 1}),
             shown({}, [3, 0, 0]), shown({}, [-3, 0, 0]), shown({}, None, 0.5)]  # fmt: skip
    with served(folder) as address:
        told = browse(f"{address}/index.html", steps, (SIDE, SIDE))
    assert told["messages"] == []
    about, *addresses = told["results"]
    assert about["meta"]["authors"] == ["drawn"]
    assert about["meta"]["licenseUrl"] == LICENCE
    assert about["meta"]["avatarPermission"] == "onlyAuthor"
    assert about["meta"]["thumbnailImage"] == 512
    presets = (
        "aa ih ou ee oh happy angry sad relaxed surprised neutral blink blinkLeft blinkRight lookUp lookDown lookLeft"
    )
    assert set(about["presets"]) == {*presets.split(), "lookRight"}
    assert {"jawOpen", "eyeLookUpLeft", "mouthPucker"} <= set(about["custom"])
    assert len(about["custom"]) == 50
    bones = {name: np.array(place) for name, place in about["bones"].items()}
    assert {*BODY, "head", "leftEye", "rightEye", "rightHand"} <= set(bones)
    assert 1.4 < bones["head"][1] < 1.7
    assert 0 < bones["rightFoot"][1] < 0.15
    np.testing.assert_allclose(bones["leftHand"] * [-1, 1, 1], bones["rightHand"], atol=1e-6)

    rest, aa, wink, brows, happy, left, right, turned = (255 * picture(address)[..., :3] for address in addresses)
    row, column = middle(np.abs(aa - rest))
    assert row > 0.55, "the mouth is below the middle"
    row, column = middle(np.abs(wink - rest))
    assert column > 0.52, "their left eye is at the right of the picture"
    assert row < 0.55
    assert middle(np.abs(brows - rest))[0] < 0.5
    assert middle(np.abs(happy - rest))[0] > 0.5
    assert middle(np.abs(left - right))[0] < 0.55, "eyes look aside"
    assert np.abs(turned - rest).max(-1).mean() > 3, "the head turns with its bone"


def test_looks_to_a_side_turn_the_eyes_there(folder: Path) -> None:
    """lookLeft of VRM is to the person's own left: the left eye looks out, and the right one in."""
    content = read_glb(folder / "drawn.vrm").content
    names, binds = content["meshes"][0]["extras"]["targetNames"], {}
    for name, expression in content["extensions"]["VRMC_vrm"]["expressions"]["preset"].items():
        binds[name] = {names[bind["index"]]: bind["weight"] for bind in expression.get("morphTargetBinds", [])}
    assert binds["lookLeft"] == {"eyeLookOutLeft": 1, "eyeLookInRight": 1}
    assert binds["oh"] == visemes()["O"]
    assert binds["neutral"] == {}
    assert {node["mesh"] for node in content["nodes"] if "mesh" in node} == {0}
    looks = content["extensions"]["VRMC_vrm"]["lookAt"]
    assert looks["rangeMapHorizontalInner"] == {"inputMaxValue": pytest.approx(30), "outputScale": 1}
    assert 13 < looks["rangeMapVerticalUp"]["inputMaxValue"] < 14.1


def test_export_writes_a_vrm(tmp_path: Path, made_once: MadeOnce, capsys: pytest.CaptureFixture[str]) -> None:
    """A face model without ARKit's names has its own expressions, and no presets but neutral."""
    workspace, out = str(toy_workspace(made_once)), str(tmp_path / "a.vrm")
    assert main(["export", workspace, "--out", out]) == 0
    assert "2 expressions in VRM 1.0" in capsys.readouterr().err
    vrm = read_glb(tmp_path / "a.vrm").content["extensions"]["VRMC_vrm"]
    assert list(vrm["expressions"]["custom"]) == ["drop", "swell"]
    assert list(vrm["expressions"]["preset"]) == ["neutral"]
    assert "lookAt" not in vrm
    assert main(["export", workspace, "--out", out, "--set", "drop=1"]) == 2
    assert "leave --set and --series out" in capsys.readouterr().err


def test_the_validator_finds_no_error_in_a_vrm(folder: Path) -> None:
    if not (WEB / "node_modules" / "gltf-validator").is_dir():
        pytest.skip(NO_VALIDATOR)
    issues = run_node("validate.mjs", folder / "drawn.vrm")["issues"]["messages"]
    told = {
        "UNSUPPORTED_EXTENSION": "it does not know VRM",
        "UNUSED_OBJECT": "the thumbnail",
        "NODE_EMPTY": "hands, feet",
    }
    assert [one for one in issues if one["severity"] < 2 or one["code"] not in told] == []
