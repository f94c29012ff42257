"""GNM and ICT-FaceKit: a head in GNM's schema is posed as GNM poses, ICT is read, and what does not fit is told."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gnm_like import gnm_like, posed_as_gnm, write_gnm
from mien.face import FaceModel, FaceParams, load_face_model
from mien.face.models.gnm import gnm_face_model, read_gnm
from mien.face.models.ict import NEUTRAL, PACKED_KEYS, read_ict, read_obj, read_obj_positions
from mien.face.models.model_files import default_name, read_model_file
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle
from refusals import refuses

arrays = pytest.fixture(scope="module")(lambda: gnm_like(load_face_model("anny")))


@pytest.fixture(scope="module")
def model(arrays: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> FaceModel:
    return gnm_face_model(read_gnm(write_gnm(tmp_path_factory.mktemp("gnm") / "gnm_head.npz", arrays)), "gnm_head")


@pytest.mark.parametrize("moved", ["nothing", "neck", "head", "eyes", "identity", "expression", "all"])
def test_poses_as_gnm_does(moved: str, arrays: dict[str, Any], model: FaceModel) -> None:
    """GNM's neck and head become the head's pose and an inverse neck; joints follow identity."""
    random = np.random.default_rng(4)
    rotations = 0.3 * random.normal(size=(4, 3))
    identity, expression = (
        random.normal(size=len(arrays[f"{name}_basis"])) for name in ("vertex_identity", "expression")
    )
    turned = {"neck": [0], "head": [1], "eyes": [2, 3], "all": [0, 1, 2, 3]}.get(moved, [])
    rotations[[joint for joint in range(4) if joint not in turned]] = 0
    identity *= moved in ("identity", "all")
    expression *= moved in ("expression", "all")
    shift = np.array([0.1, -0.2, -0.9])
    neck, head = (arrays["template_joint_positions"] + np.tensordot(identity, arrays["joint_identity_basis"], 1))[:2]
    origin = arrays["template_vertex_positions"][0] - model.template[0].numpy()
    turn_neck, turn_head = matrix_from_axis_angle(torch.from_numpy(rotations[:2])).numpy()
    place = turn_neck @ (turn_head @ (origin - head) + head - neck) + neck + shift
    face = FaceParams(
        identity=torch.from_numpy(identity), expression=torch.from_numpy(expression[None]),
        joints=torch.from_numpy(np.stack([-rotations[1], *rotations[2:]]))[None],
        head_rotation=axis_angle_from_matrix(torch.from_numpy(turn_neck @ turn_head)[None]),
        head_translation=torch.from_numpy(place)[None],
    )  # fmt: skip
    expected = posed_as_gnm(arrays, rotations, identity, expression, shift)
    assert np.abs(model.to(torch.zeros((), dtype=torch.float64))(face)[0].numpy() - expected).max() < 2e-6


def test_the_order_of_joints_is_read_by_their_names(arrays: dict[str, Any], model: FaceModel, tmp_path) -> None:
    swapped = [1, 3, 0, 2]  # not its own inverse
    names = ("joint_names", "template_joint_positions", "skinning_weights")
    changed = {**arrays, **{name: arrays[name][swapped] for name in names}} | {
        "joint_parent_indices": np.array([2, 0, -1, 0], np.int32),
        "joint_identity_basis": arrays["joint_identity_basis"][:, swapped],
    }
    path = write_gnm(tmp_path / "other.npz", changed)
    assert default_name(path) == "other"
    assert read_model_file(path, "gnm_head").content_hash == model.content_hash


GNM_FAULTS = {
    "a key": (lambda a: {"skinning_weights": None}, "has no 'skinning_weights'"),
    "other joints": (lambda a: {"joint_names": np.array(["a", "b", "c", "d"])}, "GNM Head has neck, head"),
    "a chain": (lambda a: {"joint_parent_indices": np.array([-1, 0, 0, 1])}, "'joint_parent_indices'"),
    "a group": (lambda a: {"vertex_group_names": np.array([f"x{n}" for n in range(9)])}, "no group"),
    "correctives": (
        lambda a: {"pose_correctives_regressor": a["pose_correctives_regressor"] + 1},
        "has pose correctives",
    ),
    "names": (lambda a: {"expression_names": np.array(["a"] * 26)}, "26 different names"),
    "objects": (lambda a: {"joint_names": np.array(list("abcd"), dtype=object)}, "not plain numbers"),
}


def test_what_does_not_fit_gnm_is_named_with_a_remedy(arrays: dict[str, Any], tmp_path: Path) -> None:
    for fault, (change, message) in GNM_FAULTS.items():
        changed = {name: value for name, value in {**arrays, **change(arrays)}.items() if value is not None}
        refuses(message, read_model_file, write_gnm(tmp_path / f"{fault}.npz", changed), "gnm_head")
    refuses("without --teeth", read_model_file, write_gnm(tmp_path / "gnm_head.npz", arrays), "gnm_head", teeth=True)


SMALL = b"# a comment\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0.5\nvt 0 0\nf 1/1/1 2/1/1 3/1/1 4/1/1\nf 1 2 3\n"


def _packed(folder: Path, **changed: Any) -> Path:
    arrays = {
        "v": np.zeros((4, 3), np.float32), "f_quad": np.array([[0, 1, 2, -1]], np.int32),
        "identity": np.zeros((2, 4, 3), np.float16), "expression": np.zeros((2, 4, 3), np.float16),
        "expression_names": np.array(["jawOpen", "jawLeft"]), **changed,
    }  # fmt: skip
    np.savez(folder / "packed.npz", **arrays)
    return folder / "packed.npz"


def test_faces_of_three_and_four_corners_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    for text in (
        b"", b"v 0 0\nf 1 2 3\n", b"v a b c\nf 1 2 3\n", b"v 0 0 0\nf 1 x 3\n", b"v 0 0 0\nf 1 2\n", b"\xff\x00",
    ):  # fmt: skip
        path.write_bytes(text)
        refuses("cannot be read as .obj", read_obj, path)
    path.write_bytes(SMALL)
    positions, quads = read_obj(path)
    assert positions.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.5]]
    assert quads.tolist() == [[0, 1, 2, 3], [0, 1, 2, -1]]
    assert np.array_equal(read_obj_positions(path, 4), positions)
    refuses("4 vertices instead of 5", read_obj_positions, path, 5)


def test_the_folder_and_the_packed_copy_have_one_name(tmp_path: Path, test_data: Path) -> None:
    (tmp_path / "FaceXModel").mkdir()
    (tmp_path / "FaceXModel" / NEUTRAL).write_bytes(SMALL)
    assert default_name(tmp_path / "FaceXModel") == default_name(_packed(tmp_path)) == "ict"
    for path in (tmp_path / "FaceXModel", tmp_path / "packed.npz"):
        refuses(r"has 4 vertices and \d faces, and ICT-FaceKit Light has 26,719", read_model_file, path, "ict")
        refuses("without --teeth", read_model_file, path, "ict", teeth=True)
    # The published model is read.
    whole = read_ict(test_data / "face_models" / "ict_facekit_light_f16.npz")
    assert (whole.template.shape, len(whole.identity)) == ((26719, 3), 100)
    assert {"browInnerUp_L", "jawOpen", "PupilDilate_R"} <= whole.expression.keys()


def test_what_does_not_fit_ict_is_told_in_one_line(tmp_path: Path) -> None:
    faults: tuple[dict[str, Any], ...] = (
        {"expression_names": np.array(["a", 1], dtype=object)}, {"expression_names": np.array(["jawOpen"])},
        {"identity": np.zeros(3)}, {"f_quad": np.zeros((1, 4))},
    )  # fmt: skip
    for fault in faults:
        refuses("cannot be read as ICT-FaceKit", read_ict, _packed(tmp_path, **fault))
    with np.load(_packed(tmp_path)) as packed:
        found = dict(packed)
    np.savez(tmp_path / "b.npz", **{key: found[key] for key in PACKED_KEYS if key != "identity"})
    refuses("has no 'identity'", read_ict, tmp_path / "b.npz")
