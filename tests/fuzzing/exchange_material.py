"""Write one whole file of each kind that is exchanged: exports, sounds, recordings, rigs, studies and settings."""

import json
import shutil
import subprocess
import wave
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import av
import numpy as np
import torch

from mien import runtime
from mien.avatar import METHODS, Avatar, as_array, bake_rig, make_portable
from mien.capture.sound import RATE
from mien.config import encode
from mien.export import MeshModel, in_world, pack, write_glb, write_sog, write_spz, write_usd
from mien.gaussians import Gaussians
from mien.lab.analysis.study.files import ANSWERS, VERSION, KeyClip, StudyKey, write_key
from mien.lab.analysis.study.shuffling import shuffled
from plain_settings import plain_config
from recordings import LAYOUTS
from test_runtime import new_avatar
from toy_scene import toy_camera

WEB = Path(__file__).parents[2] / "web"
_SECONDS = 0.5
_TEXTURE = 16


def write_exchanged(root: Path, avatar: Avatar, run: Path) -> None:
    """Write every kind of file, except for those whose program is missing here (USD, node)."""
    _write_exports(root / "exports", avatar)
    _write_sounds(root / "sounds")
    _write_rig(root / "rig")
    _write_study(root / "study")
    _write_configs(root / "configs", run)
    takes = root / "takes"
    takes.mkdir()
    for writers in LAYOUTS.values():
        for write in writers:
            write(takes, [{"jawOpen": index / 8, "eyeBlinkLeft": 0.5} for index in range(4)])
    if shutil.which("node") and (WEB / "node_modules" / "esbuild").is_dir():
        build = ["node", str(WEB / "build.mjs"), str(root / "web")]
        subprocess.run(build, check=True, capture_output=True)
        (root / "packed").mkdir()
        for method in METHODS:
            (root / "packed" / f"{method}.packed").write_bytes(pack(_portable(new_avatar(method))))


def _portable(avatar: Avatar) -> runtime.PortableAvatar:
    return make_portable(avatar, toy_camera(32), "toy")


def _write_exports(folder: Path, avatar: Avatar) -> None:
    folder.mkdir()
    with torch.no_grad():
        posed = in_world(avatar.pose(avatar.subject).gaussians.timestep(0))
    rich = _with_coefficients(posed)
    write_spz(folder / "head.spz", rich, version=3)  # the faults lie behind gzip
    write_sog(folder / "head.sog", rich)
    if find_spec("pxr") is not None:
        for ending in ("usda", "usdc", "usdz"):
            write_usd(folder / f"head.{ending}", [posed, posed][: 1 + (ending == "usda")], None)
        shutil.copy(folder / "head.usdc", folder / "head.usd")
    model = avatar.face_model
    mesh = MeshModel(bake_rig(model, avatar.subject), *map(as_array, (model.faces, model.uv, model.uv_faces)))
    write_glb(folder / "head.glb", _portable(avatar), mesh, _TEXTURE)


def _with_coefficients(gaussians: Gaussians) -> Gaussians:
    """Return Gaussians with coefficients of the first degree, which .sog shares in a palette."""
    higher = 0.1 * torch.randn(len(gaussians), 3, 3, generator=torch.Generator().manual_seed(0))
    return replace(gaussians, sh=torch.cat([gaussians.sh[:, :1], higher], dim=1))


def _write_sounds(folder: Path) -> None:
    folder.mkdir()
    samples = (0.3 * np.sin(np.arange(round(_SECONDS * RATE)) * 0.1)).astype(np.float32)
    with wave.open(str(folder / "voice.wav"), "wb") as file:
        file.setnchannels(2)
        file.setsampwidth(2)
        file.setframerate(RATE)
        file.writeframes(np.repeat(samples * 32767, 2).astype("<i2").tobytes())
    for ending, codec, sample in (("mp3", "libmp3lame", "fltp"), ("flac", "flac", "s16"), ("ogg", "libopus", "flt"),
                                  ("m4a", "aac", "fltp")):  # fmt: skip
        with av.open(str(folder / f"voice.{ending}"), "w") as container:
            stream = container.add_stream(codec, rate=48_000, layout="mono")
            assert isinstance(stream, av.AudioStream)
            rows: Any = np.repeat(samples, 3)[None]
            rows = (rows * 32767).astype(np.int16) if sample == "s16" else rows
            frame = av.AudioFrame.from_ndarray(np.ascontiguousarray(rows), format=sample, layout="mono")
            frame.sample_rate = 48_000
            container.mux(stream.encode(frame))
            container.mux(stream.encode())


def _write_rig(folder: Path) -> None:
    folder.mkdir()
    K = [[40.0, 0.0, 16.0], [0.0, 40.0, 16.0], [0.0, 0.0, 1.0]]
    one = {"K": K, "viewmat": np.eye(4).tolist(), "width": 32, "height": 32}
    cameras = [{"id": "00", **one}, {"id": "08", **one, "offset": 2, "distortion": [0.1, -0.05, 0.001, 0.0, 0.0]}]
    (folder / "rig.json").write_text(json.dumps({"format": "mien.cameras", "version": 1, "cameras": cameras}))


def _write_study(folder: Path) -> None:
    """Write the key of a study of two runs and two clips, and the answers of one participant."""
    folder.mkdir()
    study, participant, runs = "0123456789ab", "00000001", ("one", "two")
    tiles = {f"{index:012x}": run for index, run in enumerate(runs)}
    clips = tuple(KeyClip(f"c{index:07x}", "W", "clip", "front", 4 * index, 4, tiles) for index in range(2))
    write_key(folder / "study.key.json", StudyKey(study, 0, runs, clips))
    answers = [
        {
            "clip": clip.name,
            "shown": shuffled(list(tiles), study, participant, clip.name),
            "seconds": 1.5,
            **dict.fromkeys(("quality", "expression"), next(iter(tiles))),
        }
        for clip in clips
    ]
    content = {"format": ANSWERS, "version": VERSION, "study": study, "participant": participant, "answers": answers}
    (folder / "answers.json").write_text(json.dumps(content))


def _write_configs(folder: Path, run: Path) -> None:
    """Write a run's own config.json, and one by hand for each method."""
    folder.mkdir()
    shutil.copy(run / "config.json", folder / "run.json")
    for name in METHODS:
        settings = {"steps": 10, "seed": 1, "background": "random"}
        content = {"method": encode(plain_config(name)), "settings": settings}
        (folder / f"{name}.json").write_text(json.dumps(content))
