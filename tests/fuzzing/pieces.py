"""Make a small tracking that was stopped, with its finished pieces, and continue it."""

import pickle
from pathlib import Path

import torch

from mien.tracking import TrackingSettings, track_subject
from mien.tracking.fitting import StageCache
from mien.tracking.settings import PhotometricSettings
from photometric_case import make_photometric_case, make_textured_model

SETTINGS = TrackingSettings(photometric=PhotometricSettings(texture_size=128, keyframes=2, shared_steps=1))
_TIMESTEPS = 4


def write_pieces(folder: Path) -> None:
    """Write every piece of a tracking, none of them dropped, and its capture (for children of this process only)."""
    torch.set_num_threads(1)
    capture = make_photometric_case(_TIMESTEPS).capture
    drop, forget = StageCache.drop, StageCache.forget
    StageCache.drop = StageCache.forget = lambda *_: None  # type: ignore[method-assign, assignment]
    try:
        track_subject([capture], make_textured_model(), SETTINGS, folder)
    finally:
        StageCache.drop, StageCache.forget = drop, forget  # type: ignore[method-assign]
    (folder / "capture.pickle").write_bytes(pickle.dumps(capture))


def go_on(folder: Path) -> None:
    """Continue a tracking from the pieces in a folder."""
    capture = pickle.loads((folder / "capture.pickle").read_bytes())
    track_subject([capture], make_textured_model(), SETTINGS, folder)
