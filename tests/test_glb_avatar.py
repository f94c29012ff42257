"""The whole avatar in a .glb file: equal arrays and pictures for all methods, the command, damage, the validator."""

from pathlib import Path
from typing import Any

import pytest

from damage import nested
from mien import runtime
from mien.avatar import METHODS, as_array, bake_rig, make_portable
from mien.cli import main
from mien.export import MeshModel, read_glb, read_glb_avatar, write_glb
from mien.export.glb_avatar import EXTENSION
from mien.export.glb_file import GlbWriter
from needs import NO_VALIDATOR
from refusals import refuses
from shared_things import MadeOnce, toy_workspace
from test_runtime import new_avatar
from toy_scene import toy_camera
from web_case import package, run_node

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


def expect_valid(path: Path) -> None:
    """Let the validator of glTF look at a .glb file. It calls the names of attributes that it does not know wrong."""
    package("gltf-validator", NO_VALIDATOR)
    issues = run_node("validate.mjs", path)["issues"]["messages"]
    unknown = [one for one in issues if "KHR_gaussian" in one["pointer"] + one["message"]]
    assert {one["code"] for one in unknown} <= {"MESH_PRIMITIVE_INVALID_ATTRIBUTE", "UNSUPPORTED_EXTENSION"}
    tensors = read_glb(path).content["extensions"][EXTENSION]["tensors"].values()
    views = {f"/bufferViews/{tensor['bufferView']}" for tensor in tensors if "bufferView" in tensor}
    assert {one["pointer"] for one in issues if one["code"] == "UNUSED_OBJECT"} == views
    others = [one for one in issues if one not in unknown and one["pointer"] not in views]
    assert [(one["code"], one["severity"]) for one in others] == [("UNSUPPORTED_EXTENSION", 2)]
    assert EXTENSION in others[0]["message"]


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
        ("has version 9 of MIEN_gaussian_avatar, expected 1", extension(version=9)),
        ("has format 'other' version 1", extension(avatar={"format": "other", "version": 1})),
        ("does not match its checksum", extension(tensors={}), avatar(sha256="0")),
        ("is damaged|checksum", tensor(bufferView=0)),
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
