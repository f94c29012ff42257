"""One .glb file: its container, its mesh with morph targets and skin, its texture, its Gaussians, and the validator."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mien import runtime
from mien.driving.motion import ARKIT_NAMES
from mien.face import load_face_model
from mien.formats.glb import EXTENSION, MeshModel, joint_positions, morph_targets, read_glb_avatar, write_glb
from mien.formats.shared.glb_file import Glb, GlbWriter, read_glb
from mien.formats.shared.texture import Shot, Surface, bake_texture
from mien.runtime.named import LOOK_ANGLE, within_lids
from mien.runtime.posing import SH_C0, rig_points
from mien.runtime.rotation import matrix_from_axis_angle
from needs import NO_VALIDATOR
from refusals import refuses
from web_case import drawn_head, package, run_node

SIZE = 64
SPLATS = "KHR_gaussian_splatting"


def mesh_model(portable: runtime.PortableAvatar) -> MeshModel:
    baked, model = portable.baked, load_face_model("anny")
    assert isinstance(baked, runtime.MeshBound)
    return MeshModel(baked.rig, baked.faces, model.uv.numpy(), model.uv_faces.numpy().astype(np.int32))


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


portable = pytest.fixture(scope="module")(lambda: drawn_head(3000, sh=4))
glb = pytest.fixture(scope="module")(lambda written: read_glb(written))


@pytest.fixture(scope="module")
def written(portable: runtime.PortableAvatar, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("glb") / "drawn.glb"
    write_glb(path, portable, mesh_model(portable), SIZE)
    return path


def array_of(glb: Glb, accessor: int) -> np.ndarray:
    """Return the values of an accessor, [n] or [n, c], as engines read them."""
    kinds = {5126: "<f4", 5125: "<u4", 5123: "<u2", 5121: "u1"}
    one = glb.content["accessors"][accessor]
    width, kind = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}[one["type"]], kinds[one["componentType"]]
    values = np.zeros((one["count"], width), kind)
    if "bufferView" in one:
        values[:] = np.frombuffer(glb.bytes_of(one["bufferView"]), kind).reshape(values.shape)
    if "sparse" in one:
        rows, changed = one["sparse"]["indices"], one["sparse"]["values"]
        index = np.frombuffer(glb.bytes_of(rows["bufferView"]), kinds[rows["componentType"]])
        values[index] = np.frombuffer(glb.bytes_of(changed["bufferView"]), kind).reshape(-1, width)
    return values[:, 0] if width == 1 else values


def attribute(glb: Glb, name: str, mesh: int = 0) -> np.ndarray:
    return array_of(glb, glb.content["meshes"][mesh]["primitives"][0]["attributes"][name])


def at_rest(portable: runtime.PortableAvatar, **changed: float) -> runtime.Face:
    expression, zero = portable.neutral.expression.copy(), np.zeros(3, np.float32)
    for name, value in changed.items():
        expression[portable.expression_names.index(name)] += value
    return runtime.Face(expression, portable.neutral.joints, zero, zero)


def corners(glb: Glb, values: np.ndarray) -> np.ndarray:
    """Return values of the mesh's vertices at the corners of all triangles."""
    return values[array_of(glb, glb.content["meshes"][0]["primitives"][0]["indices"])]


def corners_of(portable: runtime.PortableAvatar, points: np.ndarray) -> np.ndarray:
    return points[mesh_model(portable).faces.reshape(-1)]


def test_arrays_come_back(tmp_path: Path) -> None:
    random, writer = np.random.default_rng(0), GlbWriter()
    rows = random.standard_normal((70_000, 3)).astype(np.float32)
    rows[random.random(70_000) < 0.9] = 0
    nothing = np.zeros((5, 3), np.float32)
    words = np.arange(7, dtype="<u2")
    indices = [writer.accessor(rows, bounds=True), writer.sparse(rows), writer.sparse(nothing), writer.accessor(words)]
    writer.write(tmp_path / "a.glb", {"asset": {"version": "2.0"}})
    read = read_glb(tmp_path / "a.glb")
    for index, expected in zip(indices, (rows, rows, nothing, words), strict=True):
        np.testing.assert_array_equal(array_of(read, index), expected)
    assert read.content["accessors"][0]["min"] == rows.min(0).tolist()
    assert all(view["byteOffset"] % 4 == 0 for view in read.content["bufferViews"])


def test_the_mesh_and_its_morph_targets_are_those_of_the_rig(glb: Glb, portable: runtime.PortableAvatar) -> None:
    model = mesh_model(portable)
    rig, rest = model.rig, at_rest(portable)
    shape = rig_points(rig, rest)
    np.testing.assert_array_equal(corners(glb, attribute(glb, "POSITION")), corners_of(portable, shape))
    uv = corners(glb, attribute(glb, "TEXCOORD_0")) * [1, -1] + [0, 1]
    np.testing.assert_allclose(uv, model.uv[model.uv_faces.reshape(-1)], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(attribute(glb, "NORMAL"), axis=1), 1, atol=1e-5)
    mesh = glb.content["meshes"][0]
    names, targets = mesh["extras"]["targetNames"], mesh["primitives"][0]["targets"]
    assert names == [name for name in ARKIT_NAMES if name not in ("mouthClose", "tongueOut")]
    for name in ("jawOpen", "mouthSmileLeft", "eyeBlinkRight"):
        expected = rig_points(rig, at_rest(portable, **{name: 1})) - shape
        found = corners(glb, array_of(glb, targets[names.index(name)]["POSITION"]))
        np.testing.assert_allclose(found, corners_of(portable, expected), atol=2e-6)
        assert np.abs(found).max() > 1e-3
    joints = rest.joints.copy()
    joints[portable.joint_names.index("left_eye"), 0] += within_lids(np.array([LOOK_ANGLE, 0, 0], np.float32))[0]
    expected = rig_points(rig, replace(rest, joints=joints)) - shape
    np.testing.assert_allclose(morph_targets(portable, rig, rest)["eyeLookDownLeft"], expected, atol=2e-6)


def test_joints_of_the_skin_turn_as_the_face_model_does(glb: Glb, portable: runtime.PortableAvatar) -> None:
    skin, nodes, rig = glb.content["skins"][0], glb.content["nodes"], mesh_model(portable).rig
    assert [nodes[joint]["name"] for joint in skin["joints"]] == list(rig.joint_names)
    inverse = array_of(glb, skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1).astype(float)
    angles = np.array([0.1, 0.3, 0.05])
    parents = {child: number for number, node in enumerate(nodes) for child in node.get("children", [])}

    def world(number: int) -> np.ndarray:
        local = np.eye(4)
        local[:3, 3] = nodes[number]["translation"]
        if nodes[number]["name"] == "left_eye":
            local[:3, :3] = matrix_from_axis_angle(angles[None])[0]
        return world(parents[number]) @ local if number in parents else local

    moves = np.stack([world(joint) @ bind for joint, bind in zip(skin["joints"], inverse, strict=True)])
    weights, joints = attribute(glb, "WEIGHTS_0"), attribute(glb, "JOINTS_0")
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-6)
    points = np.concatenate([attribute(glb, "POSITION"), np.ones((len(weights), 1))], axis=1)
    moved = np.einsum("vj,vjab,vb->va", weights, moves[joints], points)[:, :3]
    rest = at_rest(portable)
    turned = rest.joints.astype(float)
    turned[portable.joint_names.index("left_eye")] += angles
    flat_rig = replace(rig, pose_basis=None)
    expected = rig_points(flat_rig, replace(rest, joints=turned.astype(np.float32)))
    expected += rig_points(rig, rest) - rig_points(flat_rig, rest)
    np.testing.assert_allclose(corners(glb, moved), corners_of(portable, expected), atol=5e-5)
    assert np.abs(moved - points[:, :3]).max() > 1e-3
    # The pivot of an eye is where the eye is, also if the person at rest has an open mouth.
    positions, points = joint_positions(rig, at_rest(portable, jawOpen=1)), rig_points(rig, rest)
    assert positions.shape == rig.joint_template.shape
    for eye in (rig.joint_names.index(name) for name in ("left_eye", "right_eye")):
        assert np.abs(points[rig.skinning_weights[:, eye] > 0.99].mean(0) - positions[eye]).max() < 0.01


def test_the_gaussians_are_those_at_rest(glb: Glb, portable: runtime.PortableAvatar) -> None:
    expected = runtime.pose(portable.baked, at_rest(portable))
    primitive = glb.content["meshes"][1]["primitives"][0]
    assert primitive["mode"] == 0
    assert primitive["extensions"] == {SPLATS: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}}
    assert SPLATS in glb.content["extensionsUsed"]
    same = {"POSITION": expected.means, f"{SPLATS}:SCALE": expected.scales, f"{SPLATS}:OPACITY": expected.opacities}
    for place, (degree, k) in enumerate([(0, 0), (1, 0), (1, 1), (1, 2)]):
        same[f"{SPLATS}:SH_DEGREE_{degree}_COEF_{k}"] = expected.sh[:, place]
    for name, values in same.items():
        np.testing.assert_array_equal(attribute(glb, name, 1), values)
    turned = attribute(glb, f"{SPLATS}:ROTATION", 1)
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1), 1, atol=1e-6)
    cosines = (turned[:, [3, 0, 1, 2]] * expected.quats).sum(1) / np.linalg.norm(expected.quats, axis=1)
    np.testing.assert_allclose(cosines, 1, atol=1e-5)
    assert isinstance(portable.baked, runtime.MeshBound)
    np.testing.assert_array_equal(attribute(glb, "_TRIANGLE", 1), portable.baked.face_index)
    # Programs without splats show points in 8 bits of linear light. In sRGB, they are half grey plus the harmonic.
    shown = attribute(glb, "COLOR_0", 1) / 255
    srgb = np.where(shown[:, :3] <= 0.0031308, 12.92 * shown[:, :3], 1.055 * shown[:, :3] ** (1 / 2.4) - 0.055)
    truth = np.clip(0.5 + expected.sh[:, 0] / np.sqrt(4 * np.pi), 0, 1)
    assert truth.std() > 0.1
    np.testing.assert_allclose(srgb, truth, atol=0.5 * 12.92 / 255 + 1e-6)
    np.testing.assert_allclose(srgb[truth > 0.2], truth[truth > 0.2], atol=0.01)
    np.testing.assert_allclose(shown[:, 3], expected.opacities, atol=0.5 / 255 + 1e-6)
    assert "do not move" in glb.content["asset"]["extras"]["mien"]["animates"]
    assert glb.content["scenes"][0]["nodes"] == [0, 1]
    assert glb.content["nodes"][glb.content["scenes"][1]["nodes"][0]]["mesh"] == 1


def test_the_same_avatar_gives_the_same_bytes(written: Path, portable: runtime.PortableAvatar, tmp_path: Path) -> None:
    expect_valid(written)
    write_glb(tmp_path / "again.glb", portable, mesh_model(portable), SIZE)
    assert (tmp_path / "again.glb").read_bytes() == written.read_bytes()
    baked = portable.baked
    assert isinstance(baked, runtime.MeshBound)
    broken = replace(portable, baked=replace(baked, means=baked.means * np.float32(np.nan)))
    refuses("hold NaN or infinity", write_glb, tmp_path / "b.glb", broken, mesh_model(portable), SIZE)


def test_the_mesh_alone_is_small_and_the_same(glb: Glb, portable: runtime.PortableAvatar, tmp_path: Path) -> None:
    path = tmp_path / "mesh.glb"
    write_glb(path, portable, mesh_model(portable), SIZE, mesh_only=True)
    alone = read_glb(path)
    assert alone.content["scenes"] == glb.content["scenes"][:1]
    assert alone.content["extensionsUsed"] == ["KHR_materials_unlit"]
    for name in alone.content["meshes"][0]["primitives"][0]["attributes"]:
        np.testing.assert_array_equal(attribute(alone, name), attribute(glb, name))
    assert alone.content["skins"] == glb.content["skins"]
    refuses("has no avatar of mien", read_glb_avatar, path)
    package("gltf-validator", NO_VALIDATOR)
    assert run_node("validate.mjs", path)["issues"]["messages"] == []


def test_the_texture_has_the_colors_of_the_surface_and_not_of_what_is_seen_through_it() -> None:
    """Faint red skin in front of an opaque dark core, as of a mouth behind the nape, stays red in the texture.
    Its upper half is green as well, and its right half blue."""
    vertices = np.array([[-0.1, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0], [-0.1, 0.1, 0]], np.float32)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    surface = Surface(faces, torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]]), faces)
    grid = np.stack(np.meshgrid(*[np.linspace(-0.1, 0.1, 30)] * 2), -1).reshape(-1, 2)
    n = len(grid)
    skin = np.stack([np.full(n, 0.9), *np.where(grid[:, ::-1].T > 0, 0.9, 0.1)], axis=1)
    colors = (np.concatenate([skin, np.zeros((n, 3))]) - 0.5) / SH_C0

    def painted(depth: float) -> np.ndarray:
        means = np.concatenate([np.pad(grid, ((0, 0), (0, 1)), constant_values=-z) for z in (0, depth)])
        gaussians = runtime.Gaussians(
            means.astype(np.float32), np.eye(1, 4, dtype=np.float32).repeat(2 * n, 0),
            np.full((2 * n, 3), 0.004, np.float32), np.repeat([0.1, 0.99], n).astype(np.float32),
            colors[:, None].astype(np.float32), None,
        )  # fmt: skip
        return bake_texture(surface, [Shot(torch.from_numpy(vertices), gaussians, views=((0, 0),))], 16)

    texture = painted(0.05)
    for part, color in ((texture[:7, :7], [0.9, 0.9, 0.1]), (texture[9:, 9:], [0.9, 0.1, 0.9])):
        np.testing.assert_allclose(np.median(part, axis=(0, 1)), color, atol=0.05)
    assert np.median(painted(0.0)[..., 0]) < 0.7, "a core at the surface itself is seen, and painted"
