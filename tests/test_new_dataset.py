"""A stranger adds a dataset from a package: the steps of CONTRIBUTING.md, "Add a dataset", to the letter."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from random import Random

import numpy as np
import pytest
import torch

from forked import ForkServer
from fuzzing import uses
from mien.capture import read_capture_hash
from mien.datasets import Dataset, TrackedSequence, datasets, write_sequence
from mien.errors import UserError
from mien.face import Landmarks, add_face_model
from mien.plugins import plugins
from mien.tracking import scoring_exists
from mien.training import read_sequence
from toy_package import blocks, entry_points, install, mien
from toy_scene import toy_face_model, toy_sequence

WORD = "puppet"


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return a folder for MIEN_CACHE with the toy face model `mine`."""
    folder = tmp_path_factory.mktemp("cache")
    bare = toy_face_model()
    marks = Landmarks(torch.arange(478) % len(bare.faces), torch.full((478, 3), 1 / 3))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MIEN_CACHE", str(folder))
        add_face_model(replace(bare, name="mine", landmarks={"mediapipe": marks}), Path("/mine.npz"), "0")
    return str(folder)


def follow(folder: Path) -> None:
    """Follow the recipe under another name, so that mien itself may have puppets."""
    (code,) = blocks("Add a dataset", "python")
    points = entry_points("Add a dataset").replace(WORD, f"{WORD}9")
    install(folder, f"mien_{WORD}9", code.replace(WORD, f"{WORD}9"), points)


def puppet() -> dict[str, np.ndarray]:
    """Return the arrays of a puppet, whose camera looks from the side and has no pixel of symmetry."""
    _, sequence = toy_sequence(5, 32)
    camera, face = sequence.tracking.cameras[0], sequence.tracking.face
    K = np.array([[40.0, 0, 15], [0, 36.0, 17.5], [0, 0, 1]])
    return {
        "images": sequence.capture.images[:, 0], "mattes": sequence.capture.mattes[:, 0], "K": K,
        "viewmat": camera.viewmat.numpy(), "expression": face.expression.numpy(),
        "head_rotation": face.head_rotation.numpy() + np.array([0.1, 0.3, -0.2], np.float32),
        "head_translation": face.head_translation.numpy(),
    }  # fmt: skip


def write(path: Path, arrays: dict[str, np.ndarray]) -> Path:
    with path.open("wb") as file:
        np.savez(file, allow_pickle=True, **arrays)  # pyright: ignore[reportArgumentType]
    return path


def test_a_dataset_is_imported_and_trained_on(fork_server: ForkServer, tmp_path: Path, cache: str) -> None:
    follow(tmp_path)
    arrays, out = puppet(), tmp_path / "out"
    path = write(tmp_path / f"me.{WORD}9", arrays)
    line = ("import", str(path), "--out", str(out), "--face-model", "mine")
    done = mien(fork_server, tmp_path, *line, MIEN_CACHE=cache)
    assert done.returncode == 0, done.stderr
    assert f"me.{WORD}9: a {WORD}9" in done.stderr
    folder = out / "sequences/me"
    sequence = read_sequence(folder)
    assert np.array_equal(sequence.capture.images[:, 0], arrays["images"])
    assert np.array_equal(sequence.capture.mattes[:, 0], arrays["mattes"])
    camera, face = sequence.tracking.cameras[0], sequence.tracking.face
    # The writer's own projection in float64, with the mesh posed by the plain formulas.
    model = toy_face_model()
    given = {name: torch.from_numpy(arrays[name]).double() for name in ("expression", "head_rotation")}
    posed = model.to(torch.zeros((), dtype=torch.float64)).vertices_reference(
        replace(
            model.neutral(5).to(torch.zeros((), dtype=torch.float64)),
            head_translation=torch.from_numpy(arrays["head_translation"]).double(),
            **given,
        )
    )
    seen = posed.numpy() @ arrays["viewmat"][:3, :3].T.astype(float) + arrays["viewmat"][:3, 3]
    expected = (seen @ arrays["K"].T)[..., :2] / seen[..., 2:]
    assert np.abs(camera.project(model(face))[0].numpy() - expected).max() < 1e-3
    assert scoring_exists(folder / "scoring", read_capture_hash(folder / "capture"))
    assert sequence.scoring.any()
    assert (sequence.scoring <= sequence.capture.mattes).all()
    settings = sequence.tracking.settings
    assert settings["imported"] == {"dataset": f"{WORD}9", "from": str(path)}
    assert len(settings["fingerprint"]) == 16
    trained = mien(fork_server, tmp_path, "train", str(out), "--steps", "2", "--split", "tail", MIEN_CACHE=cache)
    assert trained.returncode == 0, trained.stderr
    again = mien(fork_server, tmp_path, *line, MIEN_CACHE=cache)
    assert (again.returncode, "sequences/me: is there already; delete it" in again.stderr) == (2, True)
    assert [each.name for each in (out / "sequences").iterdir() if not each.name.startswith(".me.lock")] == ["me"]


FAULTS: dict[str, tuple[Callable[[dict[str, np.ndarray]], object], str]] = {
    "missing": (lambda a: a.pop("K"), "has no 'K'"),
    "axes": (lambda a: a.update(mattes=a["mattes"][:4]), "'mattes' has the shape [4, 32, 32]"),
    "model": (lambda a: a.update(expression=np.zeros((5, 9), np.float32)), "'expression' has the shape [5, 9]"),
    "empty": (lambda a: a.update(images=a["images"][:0]), "'images' has the shape [0, 32, 32, 3]"),
    "pickle": (lambda a: a.update(K=np.array([{}], object)), "'K': holds object, not plain numbers"),
    "nan": (lambda a: a.update(expression=np.full((5, 2), np.nan, np.float32)), "expression holds NaN"),
    "mirrored": (lambda a: a.update(K=a["K"] * [[-1], [1], [1]]), "camera '0' is not valid (focal lengths -40 and 36"),
    "behind": (lambda a: a.update(viewmat=np.eye(4)), "in frame 0 the head is behind every camera"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_damage_is_told_in_one_line_and_leaves_nothing(
    fork_server: ForkServer, fault: str, tmp_path: Path, cache: str
) -> None:
    follow(tmp_path)
    arrays = puppet()
    damage, told = FAULTS[fault]
    damage(arrays)
    path, out = write(tmp_path / f"me.{WORD}9", arrays), tmp_path / "out"
    done = mien(fork_server, tmp_path, "import", str(path), "--out", str(out), "--face-model", "mine", MIEN_CACHE=cache)
    assert done.returncode == 2, done.stderr
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("mien: ")]
    assert told in line
    assert str(path) in line
    assert [each for each in out.rglob("*") if each.is_file() and not each.name.endswith(".lock")] == []


def test_a_sequence_that_cannot_be_read_back_is_refused(tmp_path: Path) -> None:
    """The reader's own checks may be too few. Nothing is left, and the message names the place that was read."""
    model, toy = toy_sequence(5, 32)
    capture = replace(toy.capture, timestamps=toy.capture.timestamps[::-1].copy())
    dataset = Dataset("toy", "a toy", "sequences", lambda path: None, lambda path, model: [])
    folder = tmp_path / "sequences/clip"
    with pytest.raises(UserError, match=r"^me \(clip\): timestamps holds impossible numbers; copy the files"):
        write_sequence(folder, TrackedSequence(capture, toy.tracking, model), dataset, Path("me"))
    assert list((tmp_path / "sequences").iterdir()) == []
    write_sequence(folder, TrackedSequence(toy.capture, toy.tracking, model), dataset, Path("me"))
    assert [path.name for path in (tmp_path / "sequences").iterdir()] == ["clip"]
    uses.use_sequences(tmp_path, [TrackedSequence(toy.capture, toy.tracking, model)], Random(0))
    assert (tmp_path / "I/sequences/toy/scoring/scoring.json").is_file()


def test_what_is_not_recognised_is_told(fork_server: ForkServer, tmp_path: Path) -> None:
    follow(tmp_path)
    (tmp_path / "a.txt").touch()
    path = write(tmp_path / f"me.{WORD}9", puppet())
    out = ("--out", str(tmp_path / "out"))
    unknown = mien(fork_server, tmp_path, "import", str(tmp_path / "a.txt"), *out)
    assert unknown.returncode == 2
    assert "is no dataset that mien knows; give one of gaussian-avatars (" in unknown.stderr
    assert f"{WORD}9 (a .{WORD}9 file)" in unknown.stderr
    run = mien(fork_server, tmp_path, "import", str(path), *out, "--run", "a")
    assert (run.returncode, "holds sequences, which are no run; leave --run out" in run.stderr) == (2, True)


TWICE = "from mien.datasets import Dataset\n{} = Dataset({!r}, 'twice', 'avatar', lambda path: 'it', print)\n"


@pytest.mark.parametrize(
    ("code", "told"),
    [
        ("TOY = 1", "and it is no Dataset; update or uninstall mien-toy"),
        (TWICE.format("TOY", "gaussian-avatars"), "the dataset 'toy': gaussian-avatars is taken by another dataset"),
        (TWICE.format("TOY", "toy"), "is recognised as gaussian-avatars and toy; choose one with --dataset NAME"),
    ],
)
def test_a_package_that_is_wrong_is_named(fork_server: ForkServer, code: str, told: str, tmp_path: Path) -> None:
    install(tmp_path, "mien_toy", code, "[mien.datasets]\ntoy = mien_toy:TOY\n")
    (tmp_path / "F").mkdir()
    (tmp_path / "F/point_cloud.ply").touch()
    done = mien(fork_server, tmp_path, "import", str(tmp_path / "F"), "--out", str(tmp_path / "out"))
    assert done.returncode == 2
    assert told in done.stderr


def test_no_dataset_recognises_what_is_none(tmp_path: Path) -> None:
    """An empty folder, a file, a missing path and a pipe are none of them."""
    (tmp_path / "a.txt").touch()
    for path in (tmp_path, tmp_path / "a.txt", tmp_path / "gone", Path("/dev/null")):
        assert [each.name for each in datasets() if each.recognises(path) is not None] == []
    assert len({each.name for each in datasets()}) == len(datasets())
    assert plugins("mien.datasets", Dataset) == {}
