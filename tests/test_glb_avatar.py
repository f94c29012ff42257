"""The whole avatar in a .glb file: equal arrays and pictures for all methods, the command, damage, the validator."""

import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from damage import flip_or_cut, nested
from mien import runtime
from mien.avatar import METHODS, as_array, bake_rig, make_portable
from mien.cli import main
from mien.errors import UserError
from mien.export import MeshModel, read_glb, read_glb_avatar, write_glb
from mien.export.glb_avatar import EXTENSION
from mien.export.glb_file import GlbWriter
from needs import NO_VALIDATOR
from shared_things import MadeOnce, toy_workspace
from test_runtime import new_avatar
from toy_scene import toy_camera
from web_case import WEB, run_node

METHOD = "gaussian_avatars"


def written(method: str, folder: Path) -> tuple[Path, runtime.PortableAvatar]:
    """Return a .glb file of a toy avatar, and the avatar."""
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
    """The .mien files of both avatars have the same bytes, so all arrays are equal, and so are pictures.

    Besides KHR_gaussian_splatting, which it does not know yet, the validator only notes the extension and its views.
    """
    path, portable = written(method, tmp_path)
    read = read_glb_avatar(path)
    for name, avatar in (("a.mien", portable), ("b.mien", read)):
        runtime.write_portable(tmp_path / name, avatar)
    assert (tmp_path / "a.mien").read_bytes() == (tmp_path / "b.mien").read_bytes()
    pictures = []
    for one in (runtime.Avatar(portable), runtime.Avatar(read)):
        posed = one.pose({one.expression_names[0]: 0.7}, head_rotation=(0.1, 0.2, 0))
        pictures.append(one.render(posed)[0])
    np.testing.assert_array_equal(*pictures)
    assert pictures[0].std() > 0.01
    expect_valid(path)


def expect_valid(path: Path) -> None:
    """Let the validator of glTF look at a .glb file. It calls the names of attributes that it does not know wrong."""
    if not (WEB / "node_modules" / "gltf-validator").is_dir():
        pytest.skip(NO_VALIDATOR)
    issues = run_node("validate.mjs", path)["issues"]["messages"]
    unknown = [one for one in issues if "KHR_gaussian" in one["pointer"] + one["message"]]
    assert {one["code"] for one in unknown} <= {"MESH_PRIMITIVE_INVALID_ATTRIBUTE", "UNSUPPORTED_EXTENSION"}
    tensors = read_glb(path).content["extensions"][EXTENSION]["tensors"].values()
    views = {f"/bufferViews/{tensor['bufferView']}" for tensor in tensors if "bufferView" in tensor}
    assert {one["pointer"] for one in issues if one["code"] == "UNUSED_OBJECT"} == views
    others = [one for one in issues if one not in unknown and one["pointer"] not in views]
    assert [(one["code"], one["severity"]) for one in others] == [("UNSUPPORTED_EXTENSION", 2)]
    assert EXTENSION in others[0]["message"]


def test_the_extension_is_used_but_not_required(glb: Path) -> None:
    content = read_glb(glb).content
    assert EXTENSION in content["extensionsUsed"]
    assert "extensionsRequired" not in content
    header = content["extensions"][EXTENSION]["avatar"]
    assert header["format"] == "mien.baked"
    assert header["content"]["baked"]["kind"] == "MeshBound"
    described = content["extensions"][EXTENSION]["tensors"]["baked.means"]
    data = read_glb(glb).bytes_of(described["bufferView"])
    expected = read_glb_avatar(glb).baked
    assert isinstance(expected, runtime.MeshBound)
    np.testing.assert_array_equal(np.frombuffer(data, "<f4").reshape(described["shape"]), expected.means)


def test_export_reads_a_glb(tmp_path: Path, made_once: MadeOnce, capsys: pytest.CaptureFixture[str]) -> None:
    """From a .glb, which ends as in training, come the .mien and the pose at rest with the workspace's bytes."""
    workspace = str(toy_workspace(made_once))
    for name, options in (("a.mien", ("--sharp-cut",)), ("a.glb", ()), ("a.spz", ())):
        assert main(["export", workspace, "--out", str(tmp_path / name), *options]) == 0
    for name in ("b.mien", "b.spz", "b.html"):
        assert main(["export", str(tmp_path / "a.glb"), "--out", str(tmp_path / name)]) == 0
    for ending in ("mien", "spz"):
        assert (tmp_path / f"b.{ending}").read_bytes() == (tmp_path / f"a.{ending}").read_bytes()
    assert main(["export", str(tmp_path / "a.mien"), "--out", str(tmp_path / "c.ply")]) == 0
    capsys.readouterr()
    for line, told in (
        (
            ["a.glb", "--out", "a.glb"],
            "cannot write .glb from a file; export the workspace, or use .mien, .html, .packed, .ply",
        ),
        (["a.mien", "--out", "a.mien"], "is the file that is read"),
        (["a.glb", "--out", "c.mien", "--set", "drop=1"], "leave --run, --set, --series, --neutral and --every out"),
        (["gone.glb", "--out", "c.mien"], "gone.glb: no such file"),
    ):
        assert main(["export", *(str(tmp_path / word) if "." in word else word for word in line)]) == 2
        assert told in capsys.readouterr().err


def test_foreign_and_damaged_files_are_refused(glb: Path, tmp_path: Path) -> None:
    """Files without the extension, of another version, or whose extension cannot be, are refused in one line."""
    path = tmp_path / "a.glb"

    def extension(**parts: Any) -> Any:
        return lambda content: content["extensions"][EXTENSION].update(parts)

    def tensor(**parts: Any) -> Any:
        return lambda content: content["extensions"][EXTENSION]["tensors"]["baked.means"].update(parts)

    for edit, told in (
        (lambda content: content.pop("extensions"), "has no avatar of mien"),
        (lambda content: content.update(extensions=[1]), "has no avatar of mien"),
        (lambda content: content["extensions"].update({EXTENSION: 3}), "has no avatar of mien"),
        (extension(version=9), "has version 9 of MIEN_gaussian_avatar, expected 1"),
        (extension(avatar=[]), "is damaged"),
        (extension(avatar={}), "is damaged"),
        (extension(avatar={"format": "other", "version": 1}), "has format 'other' version 1"),
        (extension(tensors=[]), "is damaged"),
        (extension(tensors={}), "does not match its checksum"),
        (tensor(shape=[-1, 3]), "is damaged"),
        (tensor(shape=[2**40, 3]), "is damaged"),
        (tensor(shape="3"), "is damaged"),
        (tensor(dtype="object"), "is damaged"),
        (tensor(dtype=["float32"]), "is damaged"),
        (tensor(bufferView=99999), "is damaged"),
        (tensor(bufferView=0), "is damaged|checksum"),
        (tensor(bufferView="0"), "is damaged"),
        (lambda content: content["bufferViews"].clear(), "is damaged"),
        (lambda content: content["bufferViews"][-1].update(byteLength=10**12), "is damaged"),
        (lambda content: content["bufferViews"][-1].update(byteOffset=-4), "is damaged"),
        (lambda content: content["extensions"][EXTENSION]["avatar"].update(sha256="0"), "does not match its checksum"),
    ):
        rewritten(glb, path, edit)
        with pytest.raises(UserError, match=told) as refusal:
            read_glb_avatar(path)
        assert "\n" not in str(refusal.value)
    rewritten(glb, path, lambda content: content.update(extras=nested(90)))
    with pytest.raises(UserError, match="is damaged, or not a .glb file"):
        read_glb_avatar(path)
    path.write_bytes(b"glTF is not here")
    with pytest.raises(UserError, match="is damaged, or not a .glb file"):
        read_glb_avatar(path)


def test_random_damage_never_crashes(glb: Path, tmp_path: Path) -> None:
    """Damage outside the avatar may pass; then the avatar is the same."""
    content, expected = glb.read_bytes(), read_glb_avatar(glb)
    dice, path, refused = random.Random(0), tmp_path / "a.glb", 0
    for _ in range(60):
        path.write_bytes(flip_or_cut(content, dice))
        try:
            read = read_glb_avatar(path)
        except UserError:
            refused += 1
            continue
        np.testing.assert_array_equal(read.baked.attributes.sh, expected.baked.attributes.sh)  # type: ignore[union-attr]
    assert refused > 15
