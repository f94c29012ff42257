"""The split of the NeRSemble benchmark (version 2), by names: its test sequences, and its hidden cameras.

The benchmark publishes no pictures of what it tests. The same split on a person whose sequences are all there, such as
one of NeRSemble's raw recordings, measures at home what the benchmark measures. Needs no torch.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

from mien.errors import UserError
from mien.training.settings import TrainSettings

BENCHMARK_SPLIT = "nersemble-benchmark"
"""Name of the split, for --split."""
TEST_SEQUENCES = ("FREE", "EMO-1-shout+laugh", "SEN-09-frown_events_bad", "SEN-10-port_strong_smokey")
"""Sequences of the monocular task that are to be rendered. The benchmark has only their tracking."""
TRAINING_CAMERA = "222200037"
"""The frontal camera, the only one of the monocular task that is trained on."""
TEST_CAMERAS = (TRAINING_CAMERA, "222200046", "220700191", "222200039")
"""Cameras from which the test sequences of the monocular task are to be rendered."""
HIDDEN_CAMERAS = ("222200046", "222200037", "222200039")
"""Cameras of the task of novel views whose pictures are not published."""
_TEST = re.compile(r"(?<![A-Z])(?:FREE(?![A-Z])|EMO-0?1(?!\d)|SEN-0?9(?!\d)|SEN-10(?!\d))")
_BY_HAND = "choose yourself with --split none, --hold-out NAME and --hold-out-cameras ID"


def with_benchmark_split(
    settings: TrainSettings, names: Sequence[str], camera_ids: Mapping[str, Sequence[str]]
) -> TrainSettings:
    """The settings with what the benchmark holds out filled in.

    With test sequences, it is the monocular task: they are held out, and all cameras but the frontal one. Without, it
    is the task of novel views: the three hidden cameras are held out.

    Args:
        settings: Settings whose `split` is `BENCHMARK_SPLIT`.
        names: Names of the sequences of the run.
        camera_ids: The ids of the cameras of each sequence, by the sequence's name.
    """
    tests = tuple(name for name in names if _TEST.search(name))
    ids = tuple(dict.fromkeys(camera for name in names for camera in camera_ids[name]))
    if len(tests) == len(names):
        raise UserError(
            f"--split {BENCHMARK_SPLIT}: holds out all of {', '.join(names)}, and nothing is left to train on; "
            f"{_BY_HAND}"
        )
    cameras = tuple(camera for camera in ids if (camera != TRAINING_CAMERA if tests else camera in HIDDEN_CAMERAS))
    if len(cameras) == len(ids):
        wanted = f"camera {TRAINING_CAMERA}" if tests else f"a camera besides {', '.join(HIDDEN_CAMERAS)}"
        raise UserError(f"--split {BENCHMARK_SPLIT}: trains on {wanted}, and there are {', '.join(ids)}; {_BY_HAND}")
    if not tests and not cameras:
        raise UserError(
            f"--split {BENCHMARK_SPLIT}: there is no test sequence (FREE, EMO-1, SEN-09, SEN-10) and no camera "
            f"{', '.join(HIDDEN_CAMERAS)} to hold out, because the benchmark publishes none; train with --split none, "
            "and write the submission with `mien export-dataset --format nersemble-benchmark`"
        )
    _check_own("--hold-out", settings.held_out_sequences, tests)
    _check_own("--hold-out-cameras", settings.held_out_cameras, cameras)
    return replace(settings, held_out_sequences=tests, held_out_cameras=cameras)


def _check_own(option: str, given: Sequence[str], held_out: Sequence[str]) -> None:
    other = [name for name in given if name not in held_out]
    if other:
        raise UserError(f"{option} {other[0]}: --split {BENCHMARK_SPLIT} decides what is held out; leave {option} out")
