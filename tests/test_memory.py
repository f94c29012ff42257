"""Long clips take bounded memory: each test fails if all of a sequence's pictures are held at once."""

import weakref
from pathlib import Path

import numpy as np
import pytest
import torch

from bounded_memory import MIB, allocating_at_most
from capture_helpers import random_capture
from mien import picture_files
from mien.capture import read_capture, write_capture
from mien.picture_files import map_pictures
from mien.tracking import make_scoring, read_scoring, track, write_scoring
from mien.tracking.fitting import solver
from mien.tracking.landmarks import LandmarkModel, stages, term
from needs import NO_PROC
from small_face_model import make_small_face_model
from test_tracking_scoring import _tracking, _upright
from tracking_case import capture_of, make_tracking_case


@pytest.fixture
def _tiny_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limit the memory of mapped pictures to a mebibyte."""
    monkeypatch.setattr(picture_files, "MAX_KEPT_BYTES", MIB)


def mapped_bytes() -> int:
    """Return the bytes of file pages in this process's memory."""
    status = Path("/proc/self/status")
    if not status.is_file():
        pytest.skip(NO_PROC)
    line = next(line for line in status.read_text().splitlines() if line.startswith("RssFile"))
    return int(line.split()[1]) << 10


def largest_share(pictures: np.ndarray) -> int:
    """Return the growth of the mapped pages while every picture is read."""
    before, most = mapped_bytes(), 0
    for index in np.ndindex(pictures.shape[:2]):
        pictures[index].sum()
        most = max(most, mapped_bytes() - before)
    return most


@pytest.mark.usefixtures("_tiny_limit")
def test_maps_and_captures_give_their_pages_back(tmp_path: Path) -> None:
    file, shape = tmp_path / "pictures.u8", (64, 1, 512, 512)
    file.write_bytes(bytes(range(256)) * (64 << 10))
    pictures, held = map_pictures(file, shape), np.memmap(file, np.uint8, "r", shape=shape)
    assert largest_share(pictures) < 6 * MIB
    assert largest_share(held) > 12 * MIB, "the test sees what is held"
    np.testing.assert_array_equal(pictures, held)
    assert largest_share(pictures[:, 0][:, None]) < 6 * MIB, "views count, too"
    write_capture(tmp_path / "capture", random_capture(timesteps=40, height=256, width=300))
    images = read_capture(tmp_path / "capture").images
    assert images.nbytes > 16 * MIB
    assert largest_share(images) < 6 * MIB


@pytest.mark.usefixtures("_tiny_limit")
@pytest.mark.unchecked
def test_scoring_is_made_written_and_read_without_being_held(tmp_path: Path) -> None:
    model, face = _upright(64)
    short, long = (capture_of(torch.full((timesteps, 478, 2), 100.0)) for timesteps in (2, 64))
    expected = make_scoring(short, _tracking(model, face[:2]), model)
    write_scoring(tmp_path / "short", expected, "so that all code is in the memory before it is measured")
    before = mapped_bytes()
    with allocating_at_most(12 * MIB):
        made = make_scoring(long, _tracking(model, face), model, scratch=tmp_path)
        write_scoring(tmp_path / "scoring", made, "of this capture")
        read = read_scoring(tmp_path / "scoring", "of this capture")
    assert read.masks.nbytes == 16 * MIB
    assert mapped_bytes() - before < 6 * MIB
    left = sorted(entry.name for entry in tmp_path.iterdir())
    assert left == ["scoring", "short"], "files for the time being have no name"
    np.testing.assert_array_equal(read.masks, made.masks)
    np.testing.assert_array_equal(read.masks[7], expected.masks[1])


@pytest.mark.unchecked
def test_tracking_looks_at_a_bounded_number_of_frames_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    case = make_tracking_case(timesteps=24)
    model = make_small_face_model()
    expected = track(case.capture, model)
    largest = {"project": 0, "linearize": 0}
    for name in largest:
        original = getattr(LandmarkModel, name)

        def watched(self, state, *arguments, original=original, name=name, **options):
            largest[name] = max(largest[name], len(state))
            return original(self, state, *arguments, **options)

        monkeypatch.setattr(LandmarkModel, name, watched)
    monkeypatch.setattr(term, "PROJECTED", 16)
    monkeypatch.setattr(term, "CHUNK", 14)
    monkeypatch.setattr(stages, "FRAMES_AT_ONCE", 18)
    monkeypatch.setattr(solver, "SEGMENT", 5)
    found = track(case.capture, model)
    assert largest == {"project": 16, "linearize": 14}
    for name, tensor in expected.face.tensors().items():
        torch.testing.assert_close(getattr(found.face, name), tensor, atol=1e-6, rtol=0)


def test_the_chain_holds_the_factors_of_one_segment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(solver, "SEGMENT", 4)
    alive: weakref.WeakSet[torch.Tensor] = weakref.WeakSet()
    most = 0
    cholesky = torch.linalg.cholesky

    def watched(matrix: torch.Tensor) -> torch.Tensor:
        nonlocal most
        factor = cholesky(matrix)
        alive.add(factor)
        most = max(most, len(alive))
        return factor

    monkeypatch.setattr(torch.linalg, "cholesky", watched)
    random, blocks, size = torch.Generator().manual_seed(0), 19, 3
    root, upper = torch.randn(2, blocks, size, size, generator=random, dtype=torch.float64)
    own = root @ root.mT + 5 * torch.eye(size, dtype=torch.float64)
    right = torch.randn(blocks, size, generator=random, dtype=torch.float64)
    solver.solve_tridiagonal(own.__getitem__, upper.__getitem__, right)
    assert most <= 6, most
