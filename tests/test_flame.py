"""Head models in FLAME's schema are read from any of its files, posed as FLAME poses, and refused in clear words."""

import hashlib
import os
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from flame_like import (
    exact_landmarks,
    flame_like,
    posed_as_flame,
    shaped_as_flame,
    true_regions,
    write_npz,
    write_pickle,
)
from mien.commands.expression import with_expression
from mien.errors import UserError
from mien.face import FaceModel, FaceParams, load_face_model
from mien.face.flame import FlameFile, flame_face_model, read_flame
from mien.face.inert_pickle import read_inert_pickle
from mien.face.teeth import tooth_triangles, with_teeth
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle
from mien.tracking.fitting import layout_of
from mien.tracking.landmarks import with_regions_by_landmarks
from mien.tracking.pixels import texture_space


@pytest.fixture(scope="module")
def arrays() -> dict[str, np.ndarray]:
    return flame_like(load_face_model("anny"))


@pytest.fixture(scope="module")
def model(arrays, tmp_path_factory) -> FaceModel:
    path = write_npz(tmp_path_factory.mktemp("flame") / "head.npz", arrays)
    bare = flame_face_model(read_flame(path), "head")
    return replace(bare, landmarks=exact_landmarks(load_face_model("anny")))


# Posing ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "moved", ["nothing", "root", "neck", "jaw", "eyes", "identity", "expression", "offsets", "all"]
)
def test_poses_as_flame_does(moved, arrays, model):
    """Jaw, eyes and correctives move as in FLAME; its root and neck become the head's pose and an inverse neck.

    Joints follow identity, expression and offsets.
    """
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
    root, neck = (arrays["J_regressor"] @ shaped_as_flame(arrays, shape, offsets))[:2]
    origin = arrays["v_template"][0] - model.template[0].double().numpy()
    turn_root, turn_neck = matrix_from_axis_angle(torch.from_numpy(pose[:2])).numpy()
    rotation = axis_angle_from_matrix(torch.from_numpy(turn_root @ turn_neck)[None])
    face = FaceParams(
        identity=torch.from_numpy(shape[:identities]),
        expression=torch.from_numpy(shape[None, identities:]),
        joints=torch.from_numpy(np.concatenate([-pose[1:2], pose[2:]]))[None],
        head_rotation=rotation,
        head_translation=torch.from_numpy(turn_root @ (turn_neck @ (origin - neck) + neck - root) + root + shift)[None],
        vertex_offsets=torch.from_numpy(offsets),
    )
    double = torch.zeros((), dtype=torch.float64)
    expected = posed_as_flame(arrays, pose, shape, shift, offsets)
    assert np.abs(model.to(double)(face)[0].numpy() - expected).max() < 2e-6
    assert np.abs(model(face.to(torch.zeros(())))[0].numpy() - expected).max() < 5e-6


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
        with pytest.raises(UserError, match=message):
            with_expression(face, model, (assignment,))


def test_the_fit_knows_jaw_and_scale(model):
    layout = layout_of(model)
    column = layout.names.index("jaw_x")
    assert layout.lower[column] < 0 < layout.upper[column]
    assert not any(name.startswith("neck") for name in layout.names)
    # FLAME's coefficients are standard deviations, ARKit's 0..1.
    assert torch.all(layout.precision.diagonal()[layout.expression_columns] == 1)
    assert torch.all(layout.units[: len(layout.expression_index)] > 1)
    eyes = [layout.names.index(f"{side}_eye_y") for side in ("left", "right")]
    assert layout.precision[eyes[0], eyes[1]] < 0


# Files ----------------------------------------------------------------------------------------------------------------


def test_a_pickle_gives_what_an_archive_gives(arrays, model, tmp_path):
    read = flame_face_model(read_flame(write_pickle(tmp_path / "generic_model.pkl", arrays)), "head")
    assert read.content_hash == model.content_hash
    assert torch.equal(read.template, model.template)


class _Harm:
    def __init__(self, call, *arguments):
        self.call, self.arguments = call, arguments

    def __reduce__(self):
        return self.call, self.arguments


def test_a_pickle_runs_nothing(arrays, tmp_path):
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


def test_a_damaged_pickle_is_told(tmp_path):
    path = tmp_path / "model.pkl"
    for damage in (b"", b"no pickle", b"\x80\x02]q\x00.", b"\x80\x04\x95\xff\xff\xff\xff\xff\xff\xff\x7f."):
        path.write_bytes(damage)
        with pytest.raises(UserError, match=r"model\.pkl"):
            read_flame(path)


def _without(arrays, *names):
    return {name: value for name, value in arrays.items() if name not in names}


def _with(arrays, **values):
    return {**arrays, **values}


FAULTS = {
    "a key": (lambda a: _without(a, "posedirs"), "no 'posedirs'.*it needs"),
    "the chain": (lambda a: _without(a, "kintree_table"), "no 'kintree_table'"),
    "an embedding": (lambda a: {"lmk_face_idx": np.zeros(3)}, "landmark embedding: give the model itself"),
    "a body": (
        lambda a: _with(a, kintree_table=np.array([[-1, 0, 0, 0, 1], [0, 1, 2, 3, 4]])), "body models .* give a head"
    ),
    "other vertices": (lambda a: _with(a, weights=a["weights"][1:]), r"'weights' is float64 \[4172 5\].*\[4173 5\]"),
    "millimetres": (lambda a: _with(a, v_template=1000 * a["v_template"]), "a head in metres with y upwards is 0.1 to"),
    "mirrored": (lambda a: _with(a, v_template=a["v_template"] * [-1, 1, 1]), "[+]x to the subject's left"),
    "not finite": (lambda a: _with(a, posedirs=np.full_like(a["posedirs"], np.nan)), "'posedirs'.*not finite"),
    "no split": (lambda a: _without(a, "identities"), "64 directions.*add a number 'identities'"),
    "no expression": (lambda a: _with(a, identities=np.array(64)), "need at least one each"),
    "an index": (lambda a: _with(a, f=a["f"] + 1), "'f' has the index 4173, but only 4173 entries exist"),
    "weights": (lambda a: _with(a, weights=2 * a["weights"]), "'weights' of a vertex do not add up to 1"),
    "texture": (lambda a: _with(a, vt=np.zeros((4, 2)), ft=a["f"][1:]), "not texture coordinates"),
}  # fmt: skip


def test_what_is_missing_is_named_with_a_remedy(arrays, tmp_path):
    path = tmp_path / "head.npz"
    for change, message in FAULTS.values():
        with pytest.raises(UserError, match=message):
            read_flame(write_npz(path, change(arrays)))
    np.savez(path, allow_pickle=True, weights=np.array([_Harm(os.system, "true")], dtype=object))
    with pytest.raises(UserError, match=r"numpy\.savez"):
        read_flame(path)


# Regions and texture --------------------------------------------------------------------------------------------------


def test_regions_by_landmarks_are_about_the_true_ones(model):
    found, truth = with_regions_by_landmarks(model), true_regions(load_face_model("anny"))
    names = np.array(found.region_names)[found.face_regions.numpy()]
    # Regions with clear borders have many triangles; the others only have to exist.
    bounds = {"lips": 0.7, "eyes": 0.9, "ears": 0.8, "neck": 0.8, "eye_sockets": 0.8, "eyelids": 0.6, "mouth": 0.5,
              "scalp": 0.6, "nose": 0.5, "brows": 0.15, "irises": 0.5, "skin": 0.55}  # fmt: skip
    for name, bound in bounds.items():
        here, there = names == name, truth == name
        assert (here & there).sum() >= bound * (here | there).sum(), name
    # A fit to pixels uses nothing inside of the mouth or behind the eyes.
    assert not np.isin(names[np.isin(truth, ["eye_sockets"])], ["skin", "lips"]).any()


def test_the_texture_it_lacks_has_room_for_every_triangle(model):
    assert model.uv.min() >= 0
    assert model.uv.max() <= 1
    space = texture_space(model, 1024)
    shown = torch.unique(space.fragments.face_index)
    face = torch.from_numpy(true_regions(load_face_model("anny")) == "skin").nonzero()[:, 0]
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


def test_two_open_troughs() -> None:
    triangles = tooth_triangles()
    for part in (triangles[:84], triangles[84:]):
        edges = [tuple(sorted(edge)) for a, b, c in part.tolist() for edge in ((a, b), (b, c), (c, a))]
        counts = np.unique(edges, axis=0, return_counts=True)[1]
        assert (len(np.unique(part)), len(counts), len(part)) == (60, 143, 84)
        assert ((counts == 2).sum(), (counts == 1).sum()) == (109, 34)


def test_flame_with_teeth() -> None:
    flame = like_flame()
    found = with_teeth(flame, "flame2023.pkl")
    assert found.template.shape == (5143, 3)
    assert found.faces.shape == (10144, 3)
    assert found.uv is not None
    assert len(found.uv) == 5238
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


def test_other_models_have_no_place_for_them() -> None:
    with pytest.raises(UserError, match=r"m.npz: has 5,024 vertices and 9,976 triangles, and teeth belong to FLAME's"):
        with_teeth(like_flame(5024), "m.npz")
