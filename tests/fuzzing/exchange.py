"""Readers of files that are exchanged with other programs and people, and the uses of what they read."""

import contextlib
import json
import subprocess
from dataclasses import fields
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from fuzzing import content, uses
from mien.avatar import METHODS
from mien.capture.calibration import CalibratedCamera, read_calibration
from mien.capture.readings import readings_of
from mien.commands.config_file import ConfigFile, read_config_file
from mien.commands.options import TrainOptions, with_settings
from mien.driving import Motion
from mien.driving.speech import read_speech
from mien.errors import UserError
from mien.export import read_glb, read_glb_avatar, read_sog, read_spz, read_usd
from mien.gaussians import Gaussians
from mien.lab.analysis.study.files import read_all_answers, read_key
from mien.lab.analysis.study.tally import tally_content, tally_text

_READER = Path(__file__).parents[2] / "web" / "tests" / "read.mjs"
_NODE_SECONDS = 60


def read_splats(root: Path, file: Path) -> Gaussians:
    """Read a .spz, .sog or USD file."""
    return {".spz": read_spz, ".sog": read_sog}.get(file.suffix, read_usd)(file)


def read_scene(root: Path, file: Path) -> None:
    """Read all arrays of a .glb scene, as programs do that show it."""
    glb = read_glb(file)
    accessors = glb.content.get("accessors")
    for index in range(min(len(accessors), 50) if isinstance(accessors, list) else 0):
        try:
            glb.array(index).sum()
        except ValueError as error:
            raise UserError(f"{file}: {error}") from None


def read_avatar_of_glb(root: Path, file: Path) -> Any:
    return read_glb_avatar(file)


def read_in_node(root: Path, file: Path) -> None:
    """Read an avatar with the web runtime, as pages do, and pose it."""
    command = ["node", str(_READER), str(root / "web/mien.js"), str(file)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=_NODE_SECONDS, check=False)
    if done.returncode:
        raise RuntimeError(f"node ended with {done.returncode}: {done.stderr[-300:]}")
    found = json.loads(done.stdout)
    if found["memory"] > 1 << 30:
        raise MemoryError(f"node took {found['memory'] >> 20} MiB")
    if found["message"].startswith("not told"):
        raise RuntimeError(found["message"])
    if found["message"]:
        raise UserError(f"{file}: {found['message']}")


def read_sound(root: Path, file: Path) -> Motion:
    return read_speech(file)


def read_rig(root: Path, file: Path) -> list[CalibratedCamera]:
    return read_calibration(file)


def use_rig(root: Path, found: list[CalibratedCamera], dice: Random) -> None:
    """Straighten a picture of every camera, and read the calibration in the other usual ways."""
    for one in found[:3]:
        content.expect_finite(one.camera)
        if one.lens is not None:
            straight = one.lens.straighten(np.zeros((32, 32, 3), np.uint8))
            assert straight.shape == (32, 32, 3)
            assert np.isfinite(one.lens.straighten_points(np.full((4, 2), 7.0), 32, 32)).all()
    for reading in readings_of([one.camera for one in found[:3]]):
        content.expect_finite(reading.cameras)


def tally(root: Path, file: Path) -> str:
    """Count the answers of a study."""
    key = read_key(root / "study/study.key.json")
    return tally_text(tally_content(key, read_all_answers([root / "study/answers.json"], key)))


def read_config(root: Path, file: Path) -> ConfigFile:
    return read_config_file(file)


def use_config(root: Path, found: ConfigFile, dice: Random) -> None:
    """Make the options of `mien train` of the file, as its command line does, and check them."""
    from mien.commands.train import Command

    arguments = ["--config", str(found.path)]
    if found.method is None:
        arguments += ["--method", dice.choice(list(METHODS))]
    command = with_settings(Command, arguments)
    options = next(field for field in fields(command) if field.name == "options").default_factory()  # type: ignore[misc]
    assert isinstance(options, TrainOptions)
    options.check()
    if dice.random() < 0.3:
        with contextlib.suppress(UserError):  # there is no such workspace
            uses.run_line(f"train {{root}}/none --config {found.path}", root)
