"""An interrupted tracking continues to the same numbers, and damaged pieces are made again."""

import os
import signal
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from mien.capture import write_capture
from mien.cli import main
from mien.commands.stages import tracking as stage
from mien.tracking import TrackingSettings, track_subject
from mien.tracking.fitting import StageCache
from mien.tracking.landmarks import stages
from mien.tracking.pixels import refine
from mien.tracking.settings import PhotometricSettings
from photometric_case import assert_alike, make_photometric_case, make_textured_model

FAST = TrackingSettings(photometric=PhotometricSettings(texture_size=64, keyframes=4, shared_steps=1))
"""Settings with an unknown focal length, so that it has to be stored as well."""


def stops_after(piece: str, written: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Collect the names of the pieces that are written from now on, and stop the program after one of them."""
    write = StageCache.write

    def write_then_stop(self: StageCache, name: str, tensors: dict) -> None:
        write(self, name, tensors)
        written.append(name)
        if name == piece:
            raise KeyboardInterrupt

    monkeypatch.setattr(StageCache, "write", write_then_stop)


@pytest.mark.unchecked
def test_goes_on_from_every_piece(tmp_path, monkeypatch, capsys):
    """One tracking is stopped again and again. At last, two of its pieces are damaged."""
    monkeypatch.setattr(stages, "FRAMES_AT_ONCE", 5)
    monkeypatch.setattr(refine, "FRAMES_AT_ONCE", 3)
    case, keep = make_photometric_case(timesteps=8), tmp_path / "kept"
    expected = track_subject([case.capture], case.model, FAST)[0]
    for piece in ("identity", "frames-0-0", "sequence-0", "step-0-0-equations-1", "round-1-shared-0", "lids"):
        before, written = {path.stem for path in keep.glob("*")}, []
        with monkeypatch.context() as patched:
            stops_after(piece, written, patched)
            with pytest.raises(KeyboardInterrupt):
                track_subject([case.capture], case.model, FAST, keep)
        assert written[-1] == piece
        assert not before & set(written), "what was finished is done again"
        assert ("continues where it was interrupted" in capsys.readouterr().err) == bool(before)
    for name in ("sequence-1", "round-0"):
        whole = (keep / f"{name}.safetensors").read_bytes()
        (keep / f"{name}.safetensors").write_bytes(whole[: len(whole) // 2])
    assert_alike(expected, track_subject([case.capture], case.model, FAST, keep)[0])
    assert "round-0.safetensors: is damaged, so this part" in capsys.readouterr().err
    assert not keep.exists()


def track_until_killed(piece: str, *words: str) -> None:
    """Run `mien track` in a process that is killed after a piece of its fit."""
    write = StageCache.write

    def write_then_die(self: StageCache, name: str, tensors: dict) -> None:
        write(self, name, tensors)
        if name == piece:
            os.kill(os.getpid(), signal.SIGKILL)

    StageCache.write = write_then_die
    stage.face_model_of = lambda choice: make_textured_model()
    main(["track", *words])


@pytest.mark.unchecked
def test_killed_tracking_goes_on(tmp_path, monkeypatch, capsys, fork_server):
    """A tracking that was killed, not asked to stop, ends with the same file after the same command."""
    monkeypatch.setattr(stage, "face_model_of", lambda choice: make_textured_model())
    pixels = {"texture-size": 64, "keyframes": 3, "shared-steps": 1}
    command = ["--overlay", "none", *(f"--tracking.photometric.{name}={value}" for name, value in pixels.items())]
    capture = replace(make_photometric_case(timesteps=3).capture, name="clip")
    for name in ("killed", "undisturbed"):
        write_capture(tmp_path / name / "sequences/clip/capture", capture)
    assert main(["track", str(tmp_path / "undisturbed"), *command]) == 0
    function, folder = f"{Path(__file__).stem}:track_until_killed", tmp_path / "killed"
    assert fork_server.call(function, "round-0-looks", str(folder), *command).wait() == -signal.SIGKILL
    sequences = folder / "sequences"
    assert not (sequences / "clip/tracking/tracking.json").exists()
    assert len(list(sequences.glob(".tracking-*/*.safetensors"))) >= 5
    capsys.readouterr()
    assert main(["track", str(folder), *command]) == 0
    assert "continues where it was interrupted" in capsys.readouterr().err
    assert not list(sequences.glob(".tracking-*"))
    files = [tmp_path / name / "sequences/clip/tracking/tracking.safetensors" for name in ("killed", "undisturbed")]
    assert files[0].read_bytes() == files[1].read_bytes()
    assert (sequences / "clip/tracking/report.html").is_file()
    assert not (sequences / "clip/tracking/overlay.mp4").exists()


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
