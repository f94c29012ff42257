"""Two commands on one workspace for which all is quick: one waits beside a lock, and the other runs meanwhile."""

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from forked import Forked, ForkServer
from mien.capture.store import read_capture_hash
from mien.cli import main
from mien.disk import locks
from mien.disk.files import write_arrays
from mien.disk.workspace import Workspace
from mien.evaluation import living
from mien.face.loading import add_face_model
from mien.pipeline.track import tracking_fingerprint
from mien.tracking import write_tracking
from mien.tracking.scoring import Scoring
from mien.tracking.scoring_files import write_scoring
from mien.tracking.settings import TrackingSettings
from toy_scene import toy_capture, toy_face_model, toy_tracking

_TIMESTEPS, _SIZE = 5, 48
_PATIENCE_SECONDS = 600


def beside(
    server: ForkServer, folder: Path, stop: tuple[str, str], first: list[str], second: list[str]
) -> tuple[Forked, Forked]:
    """Run a command up to a lock, then another one to its end, and then the first one to its end.
    The first stops "before" or "within" its first lock of a place, whose name `stop` has, too. The folder is made."""
    folder.mkdir()
    waiting = server.call("two_commands:run_up_to_a_lock", first, *stop, str(folder), exits=True)
    wait_until(lambda: (folder / "waits").exists() or waiting.poll() is not None)
    assert waiting.poll() is None, f"it did not come to the lock: {waiting.stderr}"
    other = server.call("two_commands:run", second, exits=True)
    other.wait()
    (folder / "goes on").touch()
    waiting.wait()
    return waiting, other


def run(words: list[str]) -> int:
    """Run a command in this process, which must be a fork, with films of few pictures."""
    living.FPS = 2
    return main(words)


def run_up_to_a_lock(words: list[str], where: str, name: str, folder: str) -> int:
    """Run a command in this process, which must be a fork, and let it wait for a file beside its first lock."""
    waited = False

    @contextmanager
    def hold(*places: Path, **options: str) -> Iterator[None]:
        nonlocal waited
        here = not waited and any(place.name == name for place in places)
        waited |= here
        if here and where == "before":
            _wait(Path(folder))
        with original(*places, **options):
            if here and where == "within":
                _wait(Path(folder))
            yield

    original = locks.hold
    for module in list(sys.modules.values()):
        if getattr(module, "hold", None) is original:
            module.hold = hold  # type: ignore[attr-defined]
    return run(words)


def _wait(folder: Path) -> None:
    (folder / "waits").touch()
    wait_until((folder / "goes on").exists)


def wait_until(is_so: Callable[[], object]) -> None:
    """Wait for an event, for minutes if need be."""
    for _ in range(100 * _PATIENCE_SECONDS):
        if is_so():
            return
        time.sleep(0.01)
    raise TimeoutError


@dataclass(frozen=True)
class Studio:
    """Filmed toy head: a workspace in which it is captured and tracked, and the options of its commands."""

    root: Path
    video: Path
    capture_options: list[str]
    """Options of a capture with mattes and landmarks, so that nothing has to be detected."""
    avatar_folder: Path
    """Place of an exported GaussianAvatars folder."""
    create_options: list[str]
    """Options of `create` with which everything up to the tracking is current and training is short."""


RANK = ["--method.expression-rank", "0", "--method.appearance", "static"]
"""Options without changes with the expression, which GaussianAvatars' own files cannot hold."""


def toy_studio(folder: Path, cache: Path) -> Studio:
    """Film, capture and track the toy head without any detector. MIEN_CACHE has to be `cache`."""
    assert os.environ["MIEN_CACHE"] == str(cache)
    model = toy_face_model()
    add_face_model(model, folder / "toy.npz", "none")
    film, alpha = toy_capture(model, _TIMESTEPS, _SIZE)
    for kind, pictures in (("mattes", alpha[:, 0]), ("pictures", film.images[:, 0, ..., ::-1])):
        (folder / kind).mkdir(parents=True)
        for timestep, picture in enumerate(pictures):
            cv2.imwrite(str(folder / kind / f"{timestep}.png"), picture)
    marks = np.random.default_rng(0).uniform(8, 40, (_TIMESTEPS, 478, 2)).astype(np.float32)
    write_arrays(folder / "landmarks.safetensors", {"landmarks": marks})
    capture_options = ["--capture.crop", "none", "--capture.mattes", str(folder / "mattes")]
    capture_options += ["--capture.landmarks", str(folder / "landmarks.safetensors")]
    root, video = folder / "workspace", folder / "pictures"
    assert main(["capture", str(video), "--out", str(root), "--name", "clip", *capture_options]) == 0
    sequence = root / "sequences" / "clip"
    fingerprint = tracking_fingerprint(Workspace(root), ["clip"], model, TrackingSettings())
    made_from = {"fingerprint": fingerprint, "tracked_together": ["clip"]}
    write_tracking(sequence / "tracking", replace(toy_tracking(model, _TIMESTEPS, _SIZE), settings=made_from))
    (sequence / "tracking" / "report.html").write_text("a report")
    crops = np.tile(np.array([4, 4, 30, 30], np.int64), (_TIMESTEPS, 1, 1))
    write_scoring(sequence / "scoring", Scoring(alpha, crops), read_capture_hash(sequence / "capture"))
    create_options = ["--name", "clip", "--face-model", "toy", "--overlay", "none", "--steps", "3", "--split", "tail"]
    return Studio(root, video, capture_options, folder / "avatar", [*create_options, *RANK, *capture_options])
