"""The whole avatar in a .glb file: equal arrays and pictures, damage, the validator, and programs of others."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from damage import nested
from mien import runtime
from mien.avatar.baking import as_array, bake_rig, make_portable
from mien.avatar.methods import METHODS
from mien.camera import Camera
from mien.cli import main
from mien.formats.glb import EXTENSION, MeshModel, read_glb_avatar, write_glb
from mien.formats.shared.glb_file import GlbWriter, read_glb
from mien.formats.vrm import BODY, LICENCE, write_vrm
from mien.render import rasterize
from mien.runtime.named import visemes
from needs import NO_THREE_VRM, NO_VALIDATOR
from refusals import complaint, refuses
from shared_things import MadeOnce, toy_workspace
from splat_readers import read_spz
from test_glb import expect_valid, mesh_model
from test_runtime import new_avatar
from toy_scene import toy_camera
from web_case import WEB, browse, bundle, drawn_head, likeness, package, picture, run_node, script, served

METHOD = "gaussian_avatars"


def written(method: str, folder: Path) -> tuple[Path, runtime.PortableAvatar]:
    avatar = new_avatar(method)
    portable, model = make_portable(avatar, toy_camera(64), "toy"), avatar.face_model
    mesh = MeshModel(bake_rig(model, avatar.subject), *map(as_array, (model.faces, model.uv, model.uv_faces)))
    write_glb(folder / f"{method}.glb", portable, mesh, 32)
    return folder / f"{method}.glb", portable


@pytest.fixture(scope="module")
def glb(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(METHOD, tmp_path_factory.mktemp("glb"))[0]


def rewritten(source: Path, path: Path, edit: Any) -> Path:
    """Write a .glb file again whose json was edited. Its buffer stays."""
    read = read_glb(source)
    edit(read.content)
    writer = GlbWriter(read.content.pop("accessors"), read.content.pop("bufferViews"), [read.buffer], len(read.buffer))
    read.content.pop("buffers")
    writer.write(path, read.content)
    return path


@pytest.mark.unchecked
@pytest.mark.parametrize("method", METHODS)
def test_the_whole_avatar_comes_back(method: str, tmp_path: Path) -> None:
    """The .mien files of both avatars have the same bytes, so all arrays are equal.
    Besides KHR_gaussian_splatting, which it does not know yet, the validator only notes the extension and its views."""
    path, portable = written(method, tmp_path)
    read = read_glb_avatar(path)
    content = read_glb(path).content
    assert EXTENSION in content["extensionsUsed"]
    assert "extensionsRequired" not in content
    for name, avatar in (("a.mien", portable), ("b.mien", read)):
        runtime.write_portable(tmp_path / name, avatar)
    assert (tmp_path / "a.mien").read_bytes() == (tmp_path / "b.mien").read_bytes()
    expect_valid(path)


def test_export_reads_a_glb(tmp_path: Path, made_once: MadeOnce, capsys: pytest.CaptureFixture[str]) -> None:
    """From a .glb, which ends as in training, come the .mien and the pose at rest with the workspace's bytes."""
    workspace = str(toy_workspace(made_once))
    for name, options in (("a.mien", ("--sharp-cut",)), ("a.glb", ()), ("a.spz", ())):
        assert main(["export", workspace, "--out", str(tmp_path / name), *options]) == 0
    for name in ("b.mien", "b.spz", "b.html"):
        assert main(["export", str(tmp_path / "a.glb"), "--out", str(tmp_path / name)]) == 0
    for ending in ("mien", "spz"):
        assert (tmp_path / f"b.{ending}").read_bytes() == (tmp_path / f"a.{ending}").read_bytes()
    assert main(["export", str(tmp_path / "gone.glb"), "--out", str(tmp_path / "c.mien")]) == 2
    assert "gone.glb: no such file" in capsys.readouterr().err


def test_foreign_and_damaged_files_are_refused(glb: Path, tmp_path: Path) -> None:
    path = tmp_path / "a.glb"

    def extension(**parts: Any) -> Any:
        return lambda content: content["extensions"][EXTENSION].update(parts)

    def tensor(**parts: Any) -> Any:
        return lambda content: content["extensions"][EXTENSION]["tensors"]["baked.means"].update(parts)

    def view(**parts: Any) -> Any:
        return lambda content: content["bufferViews"][-1].update(parts)

    def avatar(**parts: Any) -> Any:
        return lambda content: content["extensions"][EXTENSION]["avatar"].update(parts)

    for told, *edits in (
        ("has no avatar of mien", lambda content: content.pop("extensions"),
         lambda content: content.update(extensions=[1]), lambda content: content["extensions"].update({EXTENSION: 3})),
        ("version is 9; 1 is expected", extension(version=9)),
        ("avatar names it 0 times", extension(avatar={"format": "other", "version": 1})),
        ("does not match its checksum", avatar(sha256="0")),
        ("avatar names the array", extension(tensors={})),
        ("its bufferView has|belongs to another", tensor(bufferView=0)),
        ("is damaged, or not a .glb file", lambda content: content.update(extras=nested(90))),
        ("is damaged", extension(avatar=[]), extension(avatar={}), extension(tensors=[]), tensor(shape=[-1, 3]),
         tensor(shape=[2**40, 3]), tensor(shape="3"), tensor(dtype="object"), tensor(dtype=["float32"]),
         tensor(bufferView=99999), tensor(bufferView="0"), view(byteLength=10**12), view(byteOffset=-4)),
    ):  # fmt: skip
        for edit in edits:
            rewritten(glb, path, edit)
            refuses(told, read_glb_avatar, path)
    path.write_bytes(b"glTF is not here")
    refuses("is damaged, or not a .glb file", read_glb_avatar, path)


def test_check_tells_each_mistake(glb: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Arrays first, all of them; then what they mean. A file under the other name of the extension is read as well."""
    path = tmp_path / "a.glb"

    def told(edit: Any) -> list[str]:
        rewritten(glb, path, edit)
        code, lines = main(["check", str(path)]), capsys.readouterr()
        assert code == (2 if "mistakes" in lines.err else 0)
        return lines.out.splitlines()

    def renamed(content: Any) -> None:
        content["extensions"]["EXT_gaussian_avatar"] = content["extensions"].pop(EXTENSION)

    def many(content: Any) -> None:
        found = content["extensions"][EXTENSION]
        tensors, baked = found["tensors"], found["avatar"]["content"]["baked"]
        tensors["baked.means"]["shape"][0] += 1
        tensors["baked.face_index"]["dtype"] = "int64"
        tensors["baked.attributes.sh"]["bufferView"] = 99999
        tensors["more"] = {"dtype": "float32", "shape": [0]}
        baked["faces"] = {"tensor": "gone"}
        found["version"] = 2

    for edit in (lambda content: None, renamed):
        assert told(edit) == [f"{path}: follows docs/spec/README.md"]
    n = len(read_glb_avatar(glb).baked.attributes.opacity_logits)
    assert told(many) == [
        "version is 2; 1 is expected", "tensors.baked.attributes.sh: list index out of range",
        "tensors.baked.face_index: dtype is 'int64'; float32 or int32 is expected",
        f"tensors.baked.means: its shape [{n + 1}, 3] needs {12 * n + 12} bytes, and its bufferView has {12 * n}",
        "avatar names the array gone, which tensors lacks", "tensors.baked.faces: avatar names it 0 times",
        "tensors.more: avatar names it 0 times",
    ]  # fmt: skip
    data = bytearray(glb.read_bytes())
    read = read_glb(glb)
    view = read.content["extensions"][EXTENSION]["tensors"]["baked.means"]["bufferView"]
    at = len(data) - len(read.buffer) + read.content["bufferViews"][view]["byteOffset"]
    data[at : at + 4] = np.float32(np.nan).tobytes()
    path.write_bytes(data)
    assert main(["check", str(path)]) == 2
    checksum, number = capsys.readouterr().out.splitlines()
    assert "does not match its checksum" in checksum
    assert "baked.means" in number


WIDE = 256
PAGE = '<link rel="icon" href="data:,"><body></body>'
OPEN = f"""(async () => {{
  const {{ open }} = await import("./vrm.bundle.js");
  const {{ vrm, shown }} = (window.opened = await open("drawn.vrm", {WIDE}));
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
    package("@pixiv/three-vrm", NO_THREE_VRM)
    path = tmp_path_factory.mktemp("vrm")
    portable = drawn_head(3000)
    write_vrm(path / "drawn.vrm", portable, mesh_model(portable), 128)
    bundle(WEB / "tests" / "vrm.mjs", path / "vrm.bundle.js")
    (path / "index.html").write_text(PAGE)
    return path


def middle(moved: np.ndarray, rest: np.ndarray) -> tuple[float, float]:
    rows, columns = np.nonzero(np.abs(moved - rest).max(-1) > 20)
    assert len(rows) > 20, "nothing has moved"
    return float(rows.mean() / WIDE), float(columns.mean() / WIDE)


def test_three_vrm_opens_the_file_and_moves_the_face(folder: Path) -> None:
    shown = [[], [{"aa": 1}], [{"blinkLeft": 1}], [{"browInnerUp": 1}], [{"happy": 1}], [{}, [3, 0, 0]],
             [{}, [-3, 0, 0]], [{}, None, 0.5]]  # fmt: skip
    with served(folder) as address:
        steps = [OPEN, *(f"opened.shown(...{json.dumps(given)})" for given in shown)]
        told = browse(f"{address}/index.html", steps, (WIDE, WIDE))
    assert told["messages"] == []
    about, *addresses = told["results"]
    meta = [about["meta"][name] for name in ("authors", "licenseUrl", "avatarPermission", "thumbnailImage")]
    assert meta == [["drawn"], LICENCE, "onlyAuthor", 512]
    presets = "aa ih ou ee oh happy angry sad relaxed surprised neutral blink blinkLeft blinkRight lookUp lookDown"
    assert set(about["presets"]) == {*presets.split(), "lookLeft", "lookRight"}
    assert {"jawOpen", "eyeLookUpLeft", "mouthPucker"} < set(about["custom"])
    assert len(about["custom"]) == 50
    bones = {name: np.array(place) for name, place in about["bones"].items()}
    assert {*BODY, "head", "leftEye", "rightEye", "rightHand"} <= set(bones)
    assert 1.4 < bones["head"][1] < 1.7
    assert 0 < bones["rightFoot"][1] < 0.15
    np.testing.assert_allclose(bones["leftHand"] * [-1, 1, 1], bones["rightHand"], atol=1e-6)
    rest, aa, wink, brows, happy, left, right, turned = (255 * picture(address)[..., :3] for address in addresses)
    assert middle(aa, rest)[0] > 0.55, "the mouth is below the middle"
    row, column = middle(wink, rest)
    assert column > 0.52, "their left eye is at the right of the picture"
    assert row < 0.55
    assert middle(brows, rest)[0] < 0.5 < middle(happy, rest)[0]
    assert middle(left, right)[0] < 0.55, "eyes look aside"
    assert np.abs(turned - rest).max(-1).mean() > 3, "the head turns with its bone"


def test_looks_to_a_side_turn_the_eyes_there_and_the_validator_finds_no_error(folder: Path) -> None:
    """lookLeft of VRM is to the person's own left: the left eye looks out, and the right one in."""
    content = read_glb(folder / "drawn.vrm").content
    names, binds = content["meshes"][0]["extras"]["targetNames"], {}
    for name, expression in content["extensions"]["VRMC_vrm"]["expressions"]["preset"].items():
        binds[name] = {names[bind["index"]]: bind["weight"] for bind in expression.get("morphTargetBinds", [])}
    assert binds["lookLeft"] == {"eyeLookOutLeft": 1, "eyeLookInRight": 1}
    assert (binds["oh"], binds["neutral"]) == (visemes()["O"], {})
    assert {node["mesh"] for node in content["nodes"] if "mesh" in node} == {0}
    looks = content["extensions"]["VRMC_vrm"]["lookAt"]
    assert looks["rangeMapHorizontalInner"] == {"inputMaxValue": pytest.approx(30), "outputScale": 1}
    assert 13 < looks["rangeMapVerticalUp"]["inputMaxValue"] < 14.1
    package("gltf-validator", NO_VALIDATOR)
    issues = run_node("validate.mjs", folder / "drawn.vrm")["issues"]["messages"]
    # It does not know VRM, its thumbnail, and hands and feet.
    known = ("UNSUPPORTED_EXTENSION", "UNUSED_OBJECT", "NODE_EMPTY")
    assert [one for one in issues if one["severity"] < 2 or one["code"] not in known] == []


def test_export_writes_a_vrm_and_a_glb(tmp_path: Path, made_once: MadeOnce, capsys: pytest.CaptureFixture[str]) -> None:
    """A face model without ARKit's names has its own expressions, and no presets but neutral."""
    line = ["export", str(toy_workspace(made_once)), "--out", str(tmp_path / "a.vrm")]
    assert main(line) == 0
    assert "2 expressions in VRM 1.0" in capsys.readouterr().err
    vrm = read_glb(tmp_path / "a.vrm").content["extensions"]["VRMC_vrm"]
    assert list(vrm["expressions"]["custom"]) == ["drop", "swell"]
    assert list(vrm["expressions"]["preset"]) == ["neutral"]
    assert "lookAt" not in vrm
    assert "--set is an option of ply, spz, sog or usd, not of vrm" in complaint(capsys, *line, "--set", "drop=1")
    assert main([*line[:-1], str(tmp_path / "a.glb")]) == 0
    assert read_glb(tmp_path / "a.glb").content["meshes"][0]["extras"]["targetNames"] == ["drop", "swell"]


SHOWN, AWAY, FOV = 256, 1.0, 24.0
CANVAS = f'<link rel="icon" href="data:,"><canvas id="view" width="{SHOWN}" height="{SHOWN}"></canvas>'


@pytest.mark.parametrize("sh", [1, 4])
def test_playcanvas_shows_the_same_head(sh: int, tmp_path: Path) -> None:
    """A drawn head, from in front, in version 4. The reader refuses version 3.
    The engine lets each Gaussian fade to nothing at the edge of its square, so pictures differ by more than what .spz
    loses: 37.5 and 35.8 dB here, and 36.1 dB on a filmed head. Mirrored heads have less than 25."""
    package("fzstd")
    bundle(WEB / "tests/playcanvas.mjs", tmp_path / "playcanvas.js", "--log-level=error")
    (tmp_path / "page.html").write_text(CANVAS)
    runtime.write_portable(tmp_path / "a.mien", drawn_head(3000, sh=sh))
    out = str(tmp_path / "4.spz")
    assert main(["export", str(tmp_path / "a.mien"), "--out", out, "--spz-version", "4"]) == 0
    draw = "const { draw } = await import('./playcanvas.js'), view = document.getElementById('view');"
    draw += f" return draw(view, '4.spz', {SHOWN}, {AWAY}, {FOV});"
    with served(tmp_path) as address:
        (theirs,) = browse(f"{address}/page.html", [script(draw)], size=(400, 400))["results"]
    focal, viewmat = 0.5 * SHOWN / math.tan(math.radians(FOV) / 2), torch.diag(torch.tensor([1.0, -1, -1, 1]))
    viewmat[2, 3] = AWAY
    K = torch.tensor([[focal, 0, SHOWN / 2], [0, focal, SHOWN / 2], [0, 0, 1]])
    drawn = rasterize(read_spz(tmp_path / "4.spz"), Camera(K, viewmat, SHOWN, SHOWN), torch.ones(3)).image
    ours = drawn.detach().clamp(0, 1).numpy()
    assert likeness(theirs, ours) >= 34
    assert likeness(theirs, ours[:, ::-1]) < 25
