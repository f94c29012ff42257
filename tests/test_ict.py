"""ICT-FaceKit is read from its folder or a packed copy, and other files are refused in one line."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mien.errors import UserError
from mien.face.ict import NEUTRAL, PACKED_KEYS, read_ict
from mien.face.model_files import default_name, read_model_file
from mien.face.obj_files import read_obj, read_obj_positions

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
    path.write_bytes(SMALL)
    positions, quads = read_obj(path)
    assert positions.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.5]]
    assert quads.tolist() == [[0, 1, 2, 3], [0, 1, 2, -1]]
    assert np.array_equal(read_obj_positions(path, 4), positions)


@pytest.mark.parametrize(
    "text", [b"", b"v 0 0\nf 1 2 3\n", b"v a b c\nf 1 2 3\n", b"v 0 0 0\nf 1 x 3\n", b"v 0 0 0\nf 1 2\n", b"\xff\x00"]
)
def test_a_damaged_obj_is_told_in_one_line(text: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_bytes(text)
    with pytest.raises(UserError, match="cannot be read as .obj") as told:
        read_obj(path)
    assert "\n" not in str(told.value)
    path.write_bytes(SMALL)
    with pytest.raises(UserError, match="4 vertices instead of 5"):
        read_obj_positions(path, 5)


def test_the_folder_and_the_packed_copy_have_one_name(tmp_path: Path) -> None:
    (tmp_path / "FaceXModel").mkdir()
    (tmp_path / "FaceXModel" / NEUTRAL).write_bytes(SMALL)
    assert default_name(tmp_path / "FaceXModel") == default_name(_packed(tmp_path)) == "ict"
    for path in (tmp_path / "FaceXModel", tmp_path / "packed.npz"):
        with pytest.raises(UserError, match=r"has 4 vertices and \d faces, and ICT-FaceKit Light has 26,719"):
            read_model_file(path, "ict")
        with pytest.raises(UserError, match="without --teeth"):
            read_model_file(path, "ict", teeth=True)


FAULTS: dict[str, dict[str, Any]] = {
    "objects": {"expression_names": np.array(["a", 1], dtype=object)},
    "names": {"expression_names": np.array(["jawOpen"])},
    "identity": {"identity": np.zeros(3)},
    "corners": {"f_quad": np.zeros((1, 4))},
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_does_not_fit_is_told_in_one_line(fault: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="cannot be read as ICT-FaceKit") as told:
        read_ict(_packed(tmp_path, **FAULTS[fault]))
    assert "\n" not in str(told.value)


def test_a_key_that_is_missing_is_named(tmp_path: Path) -> None:
    path = _packed(tmp_path)
    with np.load(path, allow_pickle=False) as found:
        np.savez(path.with_name("b.npz"), **{key: found[key] for key in PACKED_KEYS if key != "identity"})
    with pytest.raises(UserError, match="has no 'identity'"):
        read_ict(path.with_name("b.npz"))


def test_the_published_model_is_read(test_data: Path) -> None:
    whole = read_ict(test_data / "face_models" / "ict_facekit_light_f16.npz")
    assert whole.template.shape == (26719, 3)
    assert len(whole.identity) == 100
    assert {"browInnerUp_L", "jawOpen", "PupilDilate_R"} <= whole.expression.keys()
