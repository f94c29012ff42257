"""Bad input is refused in one line. docs/bad_input.md lists for every command which test shows this."""

import errno
import os
import re
import resource
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch

import train_toy
from damage import edit_json
from mien.avatar import load_avatar, write_avatar
from mien.capture import write_capture
from mien.capture.video import write_video
from mien.cli import main
from mien.errors import UserError
from mien.evaluation import read_metrics
from mien.export import in_world, read_ply, write_ply
from mien.export.output import plan_output
from mien.export.pictures import write_pictures
from mien.storage import read_arrays, read_json, read_tensors, write_arrays, write_json, write_tensors
from mien.tracking import Scoring, write_scoring, write_tracking
from mien.training import read_run_config, read_training_summary
from mien.training.checkpoint import checkpoint_files
from mien.workspace import Workspace, open_workspace
from toy_scene import toy_sequence

pytestmark = pytest.mark.unchecked
DOCS = Path(__file__).parent.parent / "docs" / "bad_input.md"


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("workspace") / "runs" / "toy"
    train_toy.main(folder, train_toy.SETTINGS.steps)
    return folder


@contextmanager
def small_disk(size: int) -> Iterator[None]:
    """Limit the size of every file, as a full disk would."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


NOISE = np.random.default_rng(0).integers(0, 255, (4, 64, 64, 3), dtype=np.uint8)
WRITERS: dict[str, Callable[[Path], object]] = {
    "json": lambda folder: write_json(folder / "a.json", "x", 1, {"text": "x" * 2000}),
    "tensors": lambda folder: write_tensors(folder / "a.safetensors", {"a": torch.zeros(1000)}),
    "arrays": lambda folder: write_arrays(folder / "a.safetensors", {"a": np.zeros(1000)}),
    "capture": lambda folder: write_capture(folder / "capture", toy_sequence(3, 64)[1].capture),
    "tracking": lambda folder: write_tracking(folder / "tracking", toy_sequence(30, 32)[1].tracking),
    "video": lambda folder: write_video(folder / "a.mp4", list(NOISE), 25.0),
    "film": lambda folder: write_pictures(plan_output(folder / "a:b.mp4", 4), list(NOISE), 25.0),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_is_told_and_nothing_half_written_stays(name: str, tmp_path: Path) -> None:
    with small_disk(500), pytest.raises(UserError, match="free disk space") as error:
        WRITERS[name](tmp_path)
    assert str(tmp_path) in str(error.value)
    assert "\n" not in str(error.value)
    kept = [path for path in tmp_path.rglob("*") if path.is_file() and ".partial" not in str(path)]
    assert kept == [], "half-written files"
    WRITERS[name](tmp_path)


def test_a_full_disk_leaves_the_avatar_that_was_there(run_dir: Path, tmp_path: Path) -> None:
    avatar = load_avatar(run_dir)
    write_avatar(tmp_path, avatar)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with small_disk(500), pytest.raises(UserError, match="free disk space"):
        write_avatar(tmp_path, avatar)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_an_interrupted_write_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.safetensors"
    write_tensors(path, {"a": torch.ones(3)})
    with monkeypatch.context() as patched:
        patched.setattr("pathlib.Path.replace", _interrupt)
        with pytest.raises(KeyboardInterrupt):
            write_tensors(path, {"a": torch.zeros(3)})
    assert read_tensors(path)["a"].tolist() == [1, 1, 1]
    assert list(tmp_path.iterdir()) == [path]


def test_an_interrupted_scoring_is_written_the_next_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scoring = Scoring(np.zeros((2, 1, 8, 8), np.uint8), np.zeros((2, 1, 4), np.int64))
    with monkeypatch.context() as patched:
        patched.setattr("mien.tracking.scoring_files.write_arrays", _interrupt)
        with pytest.raises(KeyboardInterrupt):
            write_scoring(tmp_path / "scoring", scoring, "of a capture")
    assert list(tmp_path.iterdir()) == []
    write_scoring(tmp_path / "scoring", scoring, "of a capture")
    assert (tmp_path / "scoring" / "scoring.json").is_file()


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def tensors_file(header: bytes) -> bytes:
    return len(header).to_bytes(8, "little") + header + bytes(4)


JSON: dict[bytes, str] = {
    b"": "cannot be read as json", b"[1, 2": "cannot be read as json", b"[" * 100_000: "cannot be read as json",
    b'{"format": "x", "version": 1, "a": NaN}': "holds the number NaN",
    b'{"format": "x", "version": 9}': "version 9, expected 'x' version 1", b"[1]": "has format None",
}  # fmt: skip
TENSORS: dict[bytes, str] = {
    (1 << 62).to_bytes(8, "little") + b"{}": "header does not fit",
    tensors_file(b'{"__metadata__": [1]}'): "metadata is not an object",
    tensors_file(b'{"__metadata__": "x"}'): "metadata is not an object",
    tensors_file(b"[]"): "metadata is not an object", tensors_file(b"[" * 3000): "too deep",
    tensors_file(b'{"a": ' + b"9" * 400 + b"}"): "400 digits",
    tensors_file(b'{"a": {"dtype": "F32", "shape": [1000000000000], "data_offsets": [0, 4000000000000]}}'): "damaged",
    tensors_file(b'{"a": {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}, '
                 b'"b": {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}}'): "damaged",
    tensors_file(b'{"a": {"dtype": "BF16", "shape": [2], "data_offsets": [0, 4]}}'): "damaged",
}  # fmt: skip


@pytest.mark.parametrize(("data", "message"), [*JSON.items(), *TENSORS.items()])
def test_bad_json_and_tensors(data: bytes, message: str, tmp_path: Path) -> None:
    """Damaged or foreign files are refused with the reason."""
    path = tmp_path / "a"
    path.write_bytes(data)
    arrays, tensors = (lambda: read_arrays(path)), (lambda: read_tensors(path))
    readers = [lambda: read_json(path, "x", 1)] if data in JSON else [arrays] if b"BF16" in data else [arrays, tensors]
    for read in readers:
        with pytest.raises(UserError, match=message):
            read()


def test_huge_files_are_not_read(tmp_path: Path) -> None:
    path = tmp_path / "a"
    for data, size, read in ((b"", 1 << 30, lambda: read_json(path, "x", 1)),
                             (tensors_file(b"{}"), 1 << 40, lambda: read_arrays(path))):  # fmt: skip
        path.write_bytes(data)
        os.truncate(path, size)
        with pytest.raises(UserError, match="and at most"):
            read()


def test_an_edited_json_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_json(path, "x", 1, {"psnr": 31.5})
    assert read_json(path, "x", 1) == {"format": "x", "version": 1, "psnr": 31.5}
    path.write_text(path.read_text().replace("31.5", "39.5"))
    with pytest.raises(UserError, match="damaged or edited"):
        read_json(path, "x", 1)
    edit_json(path, lambda content: None)
    assert read_json(path, "x", 1)["psnr"] == 39.5


def test_no_advice_to_delete_a_folder_that_holds_an_avatar(run_dir: Path, tmp_path: Path) -> None:
    readers = {"config.json": read_run_config, "metrics.json": read_metrics, "training.json": read_training_summary}
    with pytest.raises(UserError, match=r"metrics\.json: missing; run `mien evaluate` again"):
        read_metrics(tmp_path)
    for name, read in readers.items():
        (tmp_path / name).touch()
        with pytest.raises(UserError, match="cannot be read as json") as error:
            read(tmp_path)
        assert "delete its folder" not in str(error.value)
    with pytest.raises(UserError, match="delete this file, not its folder, and run `mien evaluate` again"):
        read_metrics(tmp_path)
    shutil.copytree(run_dir / "avatar", tmp_path / "avatar")
    for name in ("face_model.safetensors", "face_model.json", "avatar.safetensors", "avatar.json"):
        path = tmp_path / "avatar" / name
        path.write_bytes(path.read_bytes()[:40])
        with pytest.raises(
            UserError, match=rf"{name}: .*; delete the run's training.json, .* train it again with `mien train`"
        ):
            load_avatar(tmp_path)
    (tmp_path / "avatar" / "avatar.json").write_bytes((run_dir / "avatar" / "avatar.json").read_bytes())
    (tmp_path / "avatar" / "avatar.safetensors").unlink()
    with pytest.raises(UserError, match=r"avatar\.safetensors: missing; .* train it again"):
        load_avatar(tmp_path)


def test_a_damaged_avatar_is_made_again_as_advised(run_dir: Path, tmp_path: Path) -> None:
    shutil.copytree(run_dir, tmp_path, dirs_exist_ok=True)
    (tmp_path / "avatar" / "face_model.safetensors").unlink()
    (tmp_path / "avatar" / "avatar.safetensors").write_bytes(b"")
    (tmp_path / "training.json").unlink()
    train_toy.main(tmp_path, train_toy.SETTINGS.steps)
    for name in ("avatar.safetensors", "face_model.safetensors"):
        assert (tmp_path / "avatar" / name).read_bytes() == (run_dir / "avatar" / name).read_bytes()


def test_the_command_line_tells_damage_in_one_line(
    run_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = run_dir / "avatar" / "avatar.json"
    whole = path.read_bytes()
    try:
        path.write_bytes(whole[: len(whole) // 2])
        assert main(["export", str(run_dir.parent.parent), "--out", str(tmp_path / "a.ply")]) == 2
    finally:
        path.write_bytes(whole)
    shown = [line for line in capsys.readouterr().err.splitlines() if line.startswith("mien: ")]
    assert len(shown) == 1
    assert "avatar.json" in shown[0]
    assert not (tmp_path / "a.ply").exists()


def test_going_on_from_an_older_checkpoint_is_said(
    run_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for path in [run_dir / "config.json", *checkpoint_files(run_dir / "checkpoints")]:
        copy = tmp_path / path.relative_to(run_dir)
        copy.parent.mkdir(exist_ok=True)
        copy.write_bytes(path.read_bytes())
    older, newest = checkpoint_files(tmp_path / "checkpoints")
    damaged = bytearray(newest.read_bytes())
    damaged[-1] ^= 1
    newest.write_bytes(damaged)
    train_toy.main(tmp_path, train_toy.SETTINGS.steps)
    shown = capsys.readouterr()
    said = " ".join((shown.err + shown.out).split())
    assert "training continues from the older checkpoint" in said
    step = int(older.stem.removeprefix("step_"))
    assert f"at step {step} step {step + 1} step {step + 2}" in said
    result = "avatar/avatar.safetensors"
    assert (tmp_path / result).read_bytes() == (run_dir / result).read_bytes()


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "/x/a.png"), "/x/a.png: No space left"),
        (MemoryError("8 GiB"), "not enough memory"),
    ],
)
def test_a_full_disk_or_memory_anywhere_is_no_bug(
    error: Exception, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(_: object) -> None:
        raise error

    monkeypatch.setattr("mien.workspace.Workspace.sequence_names", fail)
    assert main(["track", str(tmp_path)]) == 2
    assert words in capsys.readouterr().err


def test_create_into_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`mien create` into a file says so and leaves the file alone."""
    write_video(tmp_path / "a.mp4", list(NOISE), 25.0)
    (tmp_path / "out").write_text("mine")
    assert main(["create", str(tmp_path / "a.mp4"), "--out", str(tmp_path / "out")]) == 2
    shown = capsys.readouterr().err
    assert "is a file" in shown
    assert "disk space" not in shown
    assert (tmp_path / "out").read_text() == "mine"


@pytest.mark.parametrize("place", ["runs", "sequences/other", "runs/new/deep"])
@pytest.mark.parametrize("command", ["create", "capture"])
def test_a_workspace_inside_a_workspace(
    run_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str, place: str
) -> None:
    """A workspace inside a workspace is refused, and nothing is written."""
    write_video(tmp_path / "a.mp4", list(NOISE), 25.0)
    outer = tmp_path / "outer"
    shutil.copytree(run_dir, outer / "runs/old")
    before = sorted(outer.rglob("*"))
    assert main([command, str(tmp_path / "a.mp4"), "--out", str(outer / place)]) == 2
    assert f"inside the workspace {outer}" in capsys.readouterr().err
    assert sorted(outer.rglob("*")) == before


@torch.no_grad()
def test_a_ply_with_nan_is_refused(run_dir: Path, tmp_path: Path) -> None:
    avatar, path = load_avatar(run_dir), tmp_path / "a.ply"
    write_ply(path, in_world(avatar.pose(avatar.subject).gaussians.timestep(0)))
    whole = path.read_bytes()
    start = whole.index(b"end_header\n") + len(b"end_header\n")
    path.write_bytes(whole[:start] + np.float32(np.nan).tobytes() + whole[start + 4 :])
    with pytest.raises(UserError, match="position of some Gaussians is NaN"):
        read_ply(path)


def test_every_row_of_the_table_names_a_test_that_exists() -> None:
    rows = [line for line in DOCS.read_text(encoding="utf-8").splitlines() if line.startswith("| `")]
    assert len(rows) >= 9 * 3
    for row in rows:
        named = re.findall(r"`(test_\w+)::(test_\w+)`", row)
        assert named, f"no test in: {row}"
        for file, test in named:
            source = (Path(__file__).parent / f"{file}.py").read_text(encoding="utf-8")
            assert f"def {test}(" in source, f"{file}.py has no {test}"


def test_a_file_in_place_of_a_workspace_and_a_workspace_without_runs_are_told_apart(tmp_path):
    (tmp_path / "video.mp4").write_bytes(b"x")
    with pytest.raises(UserError, match="is a file; give the folder of a workspace"):
        open_workspace(tmp_path / "video.mp4")
    (tmp_path / "me/runs").mkdir(parents=True)
    with pytest.raises(UserError, match="there is no run yet; make one with `mien train"):
        Workspace(tmp_path / "me").pick_run(None)
