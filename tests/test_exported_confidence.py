"""`mien export` gives a .mien file the confidence of the run, and the viewer takes it from there."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import train_toy
from mien.avatar import load_avatar
from mien.cli import main
from mien.commands.stages.viewing import _of_file
from mien.runtime import read_portable
from mien.training import read_coverage
from mien.training.footage.filmed import FILE
from toy_workspace import write_toy_workspace


@pytest.mark.parametrize("unseen", ["trained", "filled"])
def test_a_mien_file_and_the_viewer_have_the_confidence_of_the_run(
    unseen: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train_toy, "SETTINGS", replace(train_toy.SETTINGS, steps=2, unseen=unseen))
    write_toy_workspace(tmp_path / "me")
    run = tmp_path / "me" / "runs" / "toy"
    covered = read_coverage(run, load_avatar(run).face_model)
    assert covered is not None
    assert covered.seen.unique().numel() > 1
    path = tmp_path / "me.mien"
    assert main(["export", str(tmp_path / "me"), "--out", str(path)]) == 0
    found = read_portable(path).confidence
    assert found is not None
    assert torch.equal(torch.from_numpy(found), covered.seen)
    mesh = _of_file(path).mesh
    assert mesh is not None
    assert mesh.seen is not None
    assert np.array_equal(mesh.seen, found)
    (run / FILE).unlink()
    assert main(["export", str(tmp_path / "me"), "--out", str(path)]) == 0
    assert read_portable(path).confidence is None
