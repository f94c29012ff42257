"""Hostile files in datasets: pickles that would run code, archives that unpack to gigabytes, links, odd numbers."""

import io
import pickle
import zipfile
from pathlib import Path
from random import Random

import numpy as np
import pytest

from dataset_writers import npz, write_frame
from fuzzing.dataset_faults import RunsCode
from mien.datasets.arrays import read_npy, read_some_arrays
from mien.datasets.content import inner, numbers, read_object
from mien.datasets.metrical_tracker import read_tracker_frames
from mien.errors import UserError
from toy_scene import toy_face_model


def frame() -> dict[str, dict[str, np.ndarray]]:
    six = np.array([[1.0, 0, 0, 0, 1, 0]], np.float32)
    return {
        "flame": {"exp": np.zeros((1, 100)), "shape": np.zeros((1, 300)), "jaw": six, "eyes": np.tile(six, (1, 2))},
        "opencv": {"R": np.eye(3)[None], "t": np.zeros((1, 3)), "K": np.eye(3)[None]},
    }


def refused(path: Path) -> str:
    with pytest.raises(UserError) as told:
        read_tracker_frames([path], toy_face_model())
    assert "\n" not in str(told.value)
    assert str(path) in str(told.value)
    return str(told.value)


def test_a_checkpoint_runs_nothing(tmp_path: Path) -> None:
    content = frame()
    content["flame"]["exp"] = RunsCode(tmp_path / "ran")  # type: ignore[assignment]
    write_frame(tmp_path / "0.frame", content)
    assert "'flame.exp' should have the shape [1, 100], here is nothing" in refused(tmp_path / "0.frame")
    assert not (tmp_path / "ran").exists()


def test_a_checkpoint_that_unpacks_to_much_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "0.frame"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", bytes(200 << 20))
    assert path.stat().st_size < 1 << 20
    assert "data.pkl has more than 8,388,608 bytes" in refused(path)


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
    assert words in refused(tmp_path / "0.frame")


def test_random_damage_to_the_pickle_of_a_checkpoint(tmp_path: Path) -> None:
    whole, dice, path = pickle.dumps(frame(), protocol=2), Random(1), tmp_path / "0.frame"
    for _ in range(300):
        data = bytearray(whole)
        for _ in range(dice.randint(1, 4)):
            data[dice.randrange(len(data))] = dice.randrange(256)
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("a/data.pkl", bytes(data[: dice.choice([len(data), dice.randrange(len(data))])]))
        try:
            read_tracker_frames([path], toy_face_model())  # a changed number may be as good as the one before
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
    (tmp_path / "e.npz").write_bytes(npz({"a": np.array([np.nan])}))
    with pytest.raises(UserError, match="'a' holds NaN"):
        read_some_arrays(tmp_path / "e.npz", ("a",))
    for text in ("[1]", "{", '{"a": 1e999}x', "[" * 100_000):
        (tmp_path / "f.json").write_text(text)
        with pytest.raises(UserError):
            read_object(tmp_path / "f.json")
