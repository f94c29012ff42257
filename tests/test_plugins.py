"""A package of a stranger adds a method, a format, a dataset and an engine by the recipes in CONTRIBUTING.md."""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from random import Random
from subprocess import CompletedProcess

import numpy as np
import pytest
import torch

from forked import ForkServer
from fuzzing import uses
from mien.avatar.methods import METHODS, Method, has_method, method_named, method_names
from mien.capture.store import read_capture_hash
from mien.cli import main
from mien.datasets import Dataset
from mien.datasets.dataset import TrackedSequence
from mien.datasets.writing import write_sequence
from mien.errors import UserError
from mien.face.loading import add_face_model
from mien.face.model import Landmarks
from mien.tracking.scoring_files import scoring_exists
from mien.training import read_sequence
from refusals import refuses
from shared_things import toy_workspace
from toy_package import blocks, entry_points, help_of, install, mien
from toy_scene import toy_face_model, toy_sequence

RECIPES = ("Add a method", "Add a format", "Add a dataset")
WORDS = ("mesh_points", "xyz", "puppet")

Mien = Callable[..., CompletedProcess[str]]
workspace = pytest.fixture(toy_workspace)


@pytest.fixture(scope="module")
def toys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Install `mien_toys`: what the recipes make, in one module, under names that mien may not have."""
    folder = tmp_path_factory.mktemp("toys")
    method = blocks(RECIPES[0], "python")[:-1]
    (ending,) = re.findall(r"`(METHOD = [^`]*)`", " ".join(Path("CONTRIBUTING.md").read_text("utf-8").split()))
    others = [blocks(each, "python")[0] for each in RECIPES[1:]]
    text = "\n".join([*method, f"from mien.avatar import Method\n{ending}\n", *others])
    points = re.sub(r"= mien_\w+:", "= mien_toys:", "".join(entry_points(each) for each in RECIPES))
    for word in WORDS:
        text = re.sub(rf'"(\.?){word}"', rf'"\g<1>{word}9"', text).replace(f"mien_{word}:", "mien_toys:")
        points = points.replace(f"{word} =", f"{word}9 =")
    install(folder, "mien_toys", text, points)
    return folder


@pytest.fixture(scope="module")
def cached(fork_server: ForkServer, toys: Path, tmp_path_factory: pytest.TempPathFactory) -> Mien:
    """Return a function that runs a command with that package, and with the toy face model `mine`."""
    cache, bare = tmp_path_factory.mktemp("cache"), toy_face_model()
    marks = Landmarks(torch.arange(478) % len(bare.faces), torch.full((478, 3), 1 / 3))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MIEN_CACHE", str(cache))
        add_face_model(replace(bare, name="mine", landmarks={"mediapipe": marks}), Path("/mine.npz"), "0")
    return partial(mien, fork_server, toys, MIEN_CACHE=str(cache))


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


def write(path: Path, arrays: dict[str, np.ndarray]) -> str:
    with path.open("wb") as file:
        np.savez(file, allow_pickle=True, **arrays)  # pyright: ignore[reportArgumentType]
    return str(path)


def assert_imported(folder: Path, path: str, arrays: dict[str, np.ndarray]) -> None:
    """Compare a sequence with the puppet that it was imported from."""
    sequence = read_sequence(folder)
    assert np.array_equal(sequence.capture.images[:, 0], arrays["images"])
    assert np.array_equal(sequence.capture.mattes[:, 0], arrays["mattes"])
    # The writer's own projection in float64, with the mesh posed by the plain formulas.
    model, fields = toy_face_model(), ("expression", "head_rotation", "head_translation")
    exact = model.to(torch.zeros((), dtype=torch.float64))
    given = {name: torch.from_numpy(arrays[name]).double() for name in fields}
    posed = exact.vertices_reference(replace(exact.neutral(5), **given))
    seen = posed.numpy() @ arrays["viewmat"][:3, :3].T.astype(float) + arrays["viewmat"][:3, 3]
    expected = (seen @ arrays["K"].T)[..., :2] / seen[..., 2:]
    found = sequence.tracking.cameras[0].project(model(sequence.tracking.face))[0]
    assert np.abs(found.numpy() - expected).max() < 1e-3
    assert scoring_exists(folder / "scoring", read_capture_hash(folder / "capture"))
    assert sequence.scoring.any()
    assert (sequence.scoring <= sequence.capture.mattes).all()
    settings = sequence.tracking.settings
    assert settings["imported"] == {"dataset": "puppet9", "from": path}
    assert len(settings["fingerprint"]) == 16


def test_footage_is_imported_an_avatar_trained_and_exported(cached: Mien, fork_server, tmp_path: Path) -> None:
    arrays, out, me = puppet(), str(tmp_path / "out"), tmp_path / "me.xyz9"
    path = write(tmp_path / "me.puppet9", arrays)
    export, of_file = ("export", out, "--out"), ("export", str(tmp_path / "me.mien"), "--out")
    imports = ("import", path, "--out", out, "--face-model", "mine")
    for line in (
        imports,
        ("train", out, "--method", "mesh_points9", "--method.rate.start", "0.01", "--steps", "2", "--split", "tail"),
        (*export, str(me)), (*export, str(tmp_path / "me.mien")),
        (*export, str(tmp_path / "talk.xyz9"), "--series", "me"), (*of_file, str(tmp_path / "again.xyz9")),
    ):  # fmt: skip
        done = cached(*line)
        assert done.returncode == 0, done.stderr
        assert line != imports or "me.puppet9: a puppet" in done.stderr
    assert_imported(Path(out) / "sequences/me", path, arrays)
    assert [each.name for each in (Path(out) / "sequences").iterdir() if not each.name.endswith(".lock")] == ["me"]
    assert len(me.read_text().splitlines()) == len(toy_face_model().template)
    assert (tmp_path / "again.xyz9").read_text() == me.read_text()
    assert len(list(tmp_path.glob("talk_*.xyz9"))) == 5
    assert '"kind": "mesh_points9"' in (Path(out) / "runs/mesh_points9/avatar/avatar.json").read_text()
    (tmp_path / "a.txt").touch()
    names = "gaussian_avatars, headgas, mono_gaussian_avatar, point_avatar, textured_mesh, mesh_points9"
    for line, told in (
        (imports, "sequences/me: is there already; delete it"),
        (("import", str(tmp_path / "a.txt"), "--out", str(tmp_path / "b")), "puppet9 (a .puppet"),
        ((*export, str(tmp_path / "a.abc")), " or .xyz9, or --format"),
        (("train", out, "--method", "nerf"), f"give one of {names} instead"),
    ):
        refused = cached(*line)
        assert refused.returncode == 2
        assert told in refused.stderr
    # Without the package, its avatar is refused with the remedy.
    gone = mien(fork_server, tmp_path, *export, str(tmp_path / "b.ply"))
    assert gone.returncode == 2
    assert re.search("no method 'mesh_points9'; give one of .*, or install the package that adds it", gone.stderr)


def test_help_names_what_packages_add(fork_server: ForkServer, toys: Path) -> None:
    for command, shown in (("train", "textured_mesh, mesh_points9 (compared"), ("export", ".xyz9 files get numbers")):
        assert shown in help_of(fork_server, toys, command)


FAULTS: dict[str, tuple[Callable[[dict[str, np.ndarray]], object], str]] = {
    "model": (lambda a: a.update(expression=np.zeros((5, 9), np.float32)), "'expression' has the shape [5, 9]"),
    "pickle": (lambda a: a.update(K=np.array([{}], object)), "'K': holds object, not plain numbers"),
    "nan": (lambda a: a.update(expression=np.full((5, 2), np.nan, np.float32)), "'expression' holds numbers that"),
    "behind": (lambda a: a.update(viewmat=np.eye(4)), "in frame 0 the head is behind every camera"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_damage_of_a_dataset_is_told_in_one_line_and_leaves_nothing(cached: Mien, fault: str, tmp_path: Path) -> None:
    arrays = puppet()
    damage, told = FAULTS[fault]
    damage(arrays)
    path, out = write(tmp_path / "me.puppet9", arrays), tmp_path / "out"
    done = cached("import", path, "--out", str(out), "--face-model", "mine")
    assert done.returncode == 2, done.stderr
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("mien: ")]
    assert told in line
    assert path in line
    assert [each for each in out.rglob("*") if each.is_file() and not each.name.endswith(".lock")] == []


def test_a_sequence_that_cannot_be_read_back_is_refused(tmp_path: Path) -> None:
    """The reader's own checks may be too few. Nothing is left, and the message names the place that was read."""
    model, toy = toy_sequence(5, 32)
    capture = replace(toy.capture, timestamps=toy.capture.timestamps[::-1].copy())
    dataset = Dataset("toy", "a toy", "sequences", lambda path: None, lambda path, model: [])
    folder = tmp_path / "sequences/clip"
    with pytest.raises(
        UserError, match=r"^me \(clip\): incomplete or damaged \(.*impossible times.*\); copy the files"
    ):
        write_sequence(folder, TrackedSequence(capture, toy.tracking, model), dataset, Path("me"))
    assert list((tmp_path / "sequences").iterdir()) == []
    write_sequence(folder, TrackedSequence(toy.capture, toy.tracking, model), dataset, Path("me"))
    assert [path.name for path in (tmp_path / "sequences").iterdir()] == ["clip"]
    uses.use_sequences(tmp_path, [TrackedSequence(toy.capture, toy.tracking, model)], Random(0))
    assert (tmp_path / "I/sequences/toy/scoring/scoring.json").is_file()


DATASET = "from mien.datasets import Dataset\nIT = Dataset({!r}, 'twice', 'avatar', lambda path: {}, print)\n"
EXPORT, IMPORT = "export {run} --out {here}/a.none9", "import {here}/F --out {here}/O"
METHOD = "from mien.avatar import Method\nIT = Method('mien_none9:Toy', 'mien_none9:TypoConfig')\n"
TRAIN = "train {run} --method none9 --run new --steps 2"
WRONG = (
    ("methods", METHOD, TRAIN, "mien_none9:TypoConfig: cannot be imported"),
    (
        "formats",
        "from mien.formats.format import Format\nIT = Format('none9', 'pose', print, ('.ply',))",
        EXPORT,
        "the format 'none9': .ply is taken by another format",
    ),
    ("datasets", DATASET.format("none9", "''"), IMPORT, "recognised as gaussian-avatars and none9; choose one with"),
    ("datasets", DATASET.format("none9", "path.no"), IMPORT, "/F: the dataset 'none9' fails (AttributeError("),
    ("datasets", "IT = 1", IMPORT + " --dataset none9", "mien-none9 adds it to mien.datasets, and it is no Dataset"),
)


@pytest.mark.parametrize(("group", "code", "line", "told"), WRONG)
def test_a_package_that_is_wrong_is_named(
    fork_server: ForkServer, workspace: Path, tmp_path: Path, group: str, code: str, line: str, told: str
) -> None:
    install(tmp_path, "mien_none9", code, f"[mien.{group}]\nnone9 = mien_none9:IT\n")
    (tmp_path / "F").mkdir()
    (tmp_path / "F/point_cloud.ply").touch()
    done = mien(fork_server, tmp_path, *line.format(run=workspace, here=tmp_path).split())
    assert done.returncode == 2
    assert told in done.stderr


@pytest.mark.parametrize("code", ["from mien.formats import NO_SUCH_NAME as IT", "raise SystemExit(3)"])
def test_a_package_that_cannot_be_imported_is_named_and_everything_else_works(
    fork_server: ForkServer, toys: Path, workspace: Path, tmp_path: Path, code: str
) -> None:
    points = "[mien.formats]\nnone9 = mien_none9:IT\n[mien.datasets]\nnone9 = mien_none9:IT\n"
    install(tmp_path, "mien_none9", code, points)
    install(tmp_path, "mien_toys", (toys / "mien_toys.py").read_text(), "[mien.formats]\nxyz9 = mien_toys:XYZ\n")
    out = ("export", str(workspace), "--out")
    quiet = (("create", "--help"), (*out, str(tmp_path / "me.ply"), "--format", "ply"))
    named = (("export", "--help"), ("import", "--help"), (*out, str(tmp_path / "me.xyz9")))
    for line in (*quiet, *named):
        done = mien(fork_server, tmp_path, *line)
        told = [text for text in done.stderr.splitlines() if text.startswith("warning: ")]
        assert done.returncode == 0, done.stderr
        assert len(told) == (line in named)
        assert all("mien_none9:IT: mien-none9 adds it to mien." in text for text in told)
        assert all(text.endswith("; update or uninstall mien-none9; mien goes on without it") for text in told)
    assert (tmp_path / "me.xyz9").exists()
    imports = ("import", str(tmp_path), "--out", "O")
    for line in ((*out, str(tmp_path / "a.none9"), "--format", "none9"), (*imports, "--dataset", "none9")):
        refused = mien(fork_server, tmp_path, *line)
        (told,) = refused.stderr.splitlines()
        assert (refused.returncode, told[:39]) == (2, "mien: mien_none9:IT: mien-none9 adds it")


def test_methods_of_packages_are_found_by_name(fork_server: ForkServer, tmp_path: Path) -> None:
    code = "from mien.avatar.methods import Method\nOWN = Method('nowhere:Toy', 'nowhere:ToyConfig')\n"
    points = "[mien.methods]\nheadgas = mien_toys_a:OWN\ntoy = mien_toys_a:OWN\ntwice = mien_toys_a:OWN\n"
    install(tmp_path, "mien_toys_a", code, points)
    install(tmp_path, "mien_toys_b", code, "[mien.methods]\ntwice = mien_toys_b:OWN\n")
    process = fork_server.call("test_plugins:methods_are_found_by_name", path=[tmp_path])
    assert process.wait() == 0, process.stderr


def methods_are_found_by_name() -> None:
    asked = {"mien.methods": lambda: pytest.fail("read")}  # libraries read groups of their own
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("importlib.metadata.entry_points", lambda group: asked.get(group, tuple)())
        assert main(["train", "gone"]) == 2
        assert main(["train", "gone", "--method", "headgas"]) == 2
        with pytest.raises(pytest.fail.Exception, match="read"):
            main(["train", "gone", "--method", "nerf"])
    assert method_names() == [*METHODS, "toy", "twice"]
    assert (has_method("toy"), has_method("nerf")) == (True, False)
    assert method_named("toy") == Method("nowhere:Toy", "nowhere:ToyConfig")
    for part in ("config", "avatar"):
        refuses("^nowhere:Toy(Config)?: cannot be imported .*; update or uninstall", getattr, method_named("toy"), part)
    assert method_named("headgas") is METHODS["headgas"], "mien's own come first"
    refuses("mien-toys-. and mien-toys-. both add 'twice' to mien.methods; uninstall", method_named, "twice")
    refuses("no method 'nerf'; give one of gaussian_avatars, .*, toy, twice, or", method_named, "nerf")
