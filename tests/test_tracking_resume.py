"""An interrupted tracking continues to the same numbers, and damaged pieces are made again."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from mien.capture import write_capture
from mien.cli import main
from mien.tracking import Tracking, TrackingSettings, track_subject
from mien.tracking.fitting import StageCache
from mien.tracking.landmarks import stages
from mien.tracking.pixels import refine
from mien.tracking.settings import PhotometricSettings
from photometric_case import PhotometricCase, assert_alike, make_photometric_case, make_textured_model

FAST = TrackingSettings(photometric=PhotometricSettings(texture_size=128, keyframes=4, shared_steps=1))
"""Settings with an unknown focal length, so that it has to be stored as well."""


@pytest.fixture(scope="module")
def case() -> PhotometricCase:
    return make_photometric_case(timesteps=8)


@pytest.fixture(autouse=True)
def few_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stages, "FRAMES_AT_ONCE", 5)
    monkeypatch.setattr(refine, "_FRAMES_AT_ONCE", 3)


@pytest.fixture(scope="module")
def expected(case: PhotometricCase) -> Tracking:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(stages, "FRAMES_AT_ONCE", 5)
        patched.setattr(refine, "_FRAMES_AT_ONCE", 3)
        return track_subject([case.capture], case.model, FAST)[0]


def stopped_after(pieces: int, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Collect the names of the pieces that are written; after this many, the next one stops the program."""
    write, names = StageCache._write, []

    def write_then_stop(self: StageCache, name: str, tensors: dict) -> None:
        if len(names) == pieces:
            raise KeyboardInterrupt
        write(self, name, tensors)
        names.append(name)

    monkeypatch.setattr(StageCache, "_write", write_then_stop)
    return names


@pytest.mark.parametrize(("pieces", "last"), [
    (1, "identity"), (2, "frames-0-0"), (4, "sequence-0"), (8, "step-0-0-equations-1"), (11, "round-1-shared-0"),
])  # fmt: skip
def test_goes_on_from_every_piece(case, expected, tmp_path, monkeypatch, capsys, pieces: int, last: str):
    keep = tmp_path / "kept"
    with monkeypatch.context() as patched:
        names = stopped_after(pieces, patched)
        with pytest.raises(KeyboardInterrupt):
            track_subject([case.capture], case.model, FAST, keep)
        assert names[-1] == last
    before = {path.name for path in keep.iterdir()}
    written = stopped_after(99, monkeypatch)
    found = track_subject([case.capture], case.model, FAST, keep)[0]
    assert not before & {f"{name}.safetensors" for name in written}, "what was finished is done again"
    assert "continues where it was interrupted" in capsys.readouterr().err
    assert_alike(expected, found)
    assert not keep.exists()


SLOWLY = """
import sys, time
import mien.commands.stages.tracking as stage
from mien.cli import main
from mien.tracking.fitting import StageCache
from photometric_case import make_textured_model

def slowly(self, name, tensors):
    write(self, name, tensors)
    print(name, flush=True)
    time.sleep(0.3)

write, StageCache._write = StageCache._write, slowly
stage.face_model_of = lambda choice: make_textured_model()
sys.exit(main(sys.argv[1:]))
"""


def test_killed_tracking_goes_on(case, tmp_path, monkeypatch, capsys):
    """A tracking that was killed, not asked to stop, ends with the same file after the same command."""
    monkeypatch.undo()  # the other process still fits as many frames at once
    model = make_textured_model()
    monkeypatch.setattr("mien.commands.stages.tracking.face_model_of", lambda choice: model)
    command = ["--overlay", "none", "--tracking.photometric.texture-size", "64"]
    for name in ("killed", "undisturbed"):
        write_capture(tmp_path / name / "sequences/clip/capture", case.capture)
    assert main(["track", str(tmp_path / "undisturbed"), *command]) == 0
    arguments = [sys.executable, "-c", SLOWLY, "track", str(tmp_path / "killed"), *command]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parent) as process:
        assert process.stdout is not None
        while process.stdout.readline() != "round-0-looks\n":
            assert process.poll() is None
        process.send_signal(signal.SIGKILL)
        assert process.wait(timeout=60) == -signal.SIGKILL
    sequences = tmp_path / "killed/sequences"
    assert not (sequences / "clip/tracking/tracking.json").exists()
    assert len(list(sequences.glob(".tracking-*/*.safetensors"))) >= 5
    capsys.readouterr()
    assert main(["track", str(tmp_path / "killed"), *command]) == 0
    assert "continues where it was interrupted" in capsys.readouterr().err
    assert not list(sequences.glob(".tracking-*"))
    files = [tmp_path / name / "sequences/clip/tracking/tracking.safetensors" for name in ("killed", "undisturbed")]
    assert files[0].read_bytes() == files[1].read_bytes()
    assert (sequences / "clip/tracking/report.html").is_file()
    assert not (sequences / "clip/tracking/overlay.mp4").exists()


def test_damaged_pieces_are_made_anew(case, expected, tmp_path, monkeypatch, capsys):
    keep = tmp_path / "kept"
    with monkeypatch.context() as patched:
        stopped_after(11, patched)
        with pytest.raises(KeyboardInterrupt):
            track_subject([case.capture], case.model, FAST, keep)
    for name in ("sequence-1", "round-0"):
        whole = (keep / f"{name}.safetensors").read_bytes()
        (keep / f"{name}.safetensors").write_bytes(whole[: len(whole) // 2])
    assert_alike(expected, track_subject([case.capture], case.model, FAST, keep)[0])
    assert "round-0.safetensors: is damaged, so this part" in capsys.readouterr().err


def test_pieces_are_the_same_made_or_read(tmp_path):
    cache, odd = StageCache(tmp_path / "kept"), torch.arange(6.0).reshape(2, 3).T[1:]
    made = cache.get_or_compute("odd", lambda: {"odd": odd})
    read = cache.get_or_compute("odd", lambda: pytest.fail("it was kept"))
    assert torch.equal(made["odd"], read["odd"])
    assert made["odd"].stride() == read["odd"].stride()
    cache.drop("od")
    assert cache.read("odd") is None
    assert StageCache(None).get_or_compute("odd", lambda: {"odd": odd})["odd"].is_contiguous()
    cache.forget()
    assert not (tmp_path / "kept").exists()
