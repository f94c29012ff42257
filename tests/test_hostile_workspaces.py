"""A workspace from a stranger: nothing in it leads out of it, and what it says is refused where it cannot be.

Every file here has the right checksum, or none: who makes a file can make its checksum.
"""

import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from capture_helpers import assert_same_capture, write_gradient_video
from damage import edit_json
from mien.capture import read_capture
from mien.capture.frame_files import CacheWriter, FrameLayout, FrameWriter
from mien.cli import main
from mien.errors import UserError
from mien.evaluation import EvaluationSettings, compare_runs, evaluate
from mien.evaluation.experiment import Frame
from mien.evaluation.load import load_experiments
from mien.evaluation.partial import PartialScores
from mien.inside import check_tree, inside, is_plain_name, open_new, remove_tree
from mien.storage import file_digest, read_arrays, read_json, read_tensors, write_arrays, write_json, write_tensors
from mien.tracking import TrackingSettings, pipeline, read_scoring, read_tracking, track_subject
from mien.training import read_curves, read_run_config, read_sequence, read_training_summary, run_camera
from mien.workspace import Workspace, check_new_workspace, open_workspace
from toy_scene import toy_face_model
from toy_workspace import write_toy_workspace

COMMANDS = (
    "render W --out OUT/a.png --size 32",
    "export W --out OUT/a.ply",
    "drive W --by W --out OUT/b.mp4 --size 32",
    "evaluate W --no-perceptual",
    "evaluate W --compare",
    "train W --run other --steps 1",
    "track W",
    "capture OUT/clip.mp4 --out W",
    "create OUT/clip.mp4 --out W",
)
FOLDERS = (
    "sequences", "runs", "sequences/clip", "sequences/clip/capture", "sequences/clip/capture/cache",
    "sequences/clip/capture/frames", "sequences/clip/capture/frames/front", "sequences/clip/.capture.partial",
    "sequences/clip/scoring/masks", "sequences/clip/tracking", "sequences/.tracking-0123", "runs/toy",
    "runs/toy/avatar", "runs/toy/checkpoints", "runs/toy/videos", "runs/toy/pictures", "runs/other",
)  # fmt: skip
FILES = (
    "sequences/clip/capture/cache/frames.u8", "sequences/clip/capture/cache/stamp.json",
    "sequences/clip/capture/frames/front/000001.png", "sequences/clip/capture/capture.json",
    "sequences/clip/tracking/report.html", "sequences/clip/tracking/overlay.mp4",
    "sequences/clip/scoring/masks/00/000000.png", "runs/toy/config.json", "runs/toy/report.html",
    "runs/toy/avatar/avatar.safetensors", "runs/toy/.self_reenactment_tail.partial",
)  # fmt: skip
NOT_ONE_LINE = "a\nb"
HUGE = 10**400
Place = Callable[[Path], Path]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("made") / "w"
    write_toy_workspace(root)
    clip, run = root / "sequences/clip", root / "runs/toy"
    evaluate(run, [clip], EvaluationSettings(perceptual=False, video_frames=0))
    return root


@pytest.fixture
def workspace(made: Path, tmp_path: Path) -> Path:
    return shutil.copytree(made, tmp_path / "received", copy_function=shutil.copy2)


@pytest.fixture
def victim(tmp_path: Path) -> Iterator[Path]:
    """The user's own folder, which has to be as it was."""
    folder = tmp_path / "home"
    (folder / "deep").mkdir(parents=True)
    for name in ("frames.u8", "000000.png", "deep/a.txt", "notes"):
        (folder / name).write_bytes(b"mine " * 100)
    before = {path: path.is_file() and path.read_bytes() for path in folder.rglob("*")}
    yield folder
    assert {path: path.is_file() and path.read_bytes() for path in folder.rglob("*")} == before


def put(link: Path, target: Path) -> None:
    remove_tree(link)
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(target)


def run_all(workspace: Path, out: Path, capsys: pytest.CaptureFixture[str], told: str) -> None:
    out.mkdir(exist_ok=True)
    (out / "clip.mp4").write_bytes(b"no video")
    for command in COMMANDS:
        arguments = [word.replace("W", str(workspace)) if word == "W" else word.replace("OUT", str(out))
                     for word in command.split()]  # fmt: skip
        assert main(arguments) == 2, command
        error = capsys.readouterr().err.strip()
        assert told in error, command
        assert "\n" not in error, command


@pytest.mark.parametrize("place", ["runs", "sequences/clip/capture/cache", "runs/toy/avatar/avatar.safetensors"])
def test_no_command_follows_a_link(
    place: str, workspace: Path, victim: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    put(workspace / place, victim / "notes" if "." in place else victim)
    run_all(workspace, tmp_path / "out", capsys, f"{workspace / place}: a link")


def test_links_are_found_wherever_they_are(made: Path, tmp_path: Path, victim: Path) -> None:
    """By the two doors that every command goes through."""
    for number, place in enumerate((*FOLDERS, *FILES)):
        received = shutil.copytree(made, tmp_path / str(number), copy_function=os.link)
        put(received / place, victim / "notes" if place in FILES else victim)
        for door in (open_workspace, check_new_workspace):
            with pytest.raises(UserError, match="a link") as error:
                door(received)
            assert str(received / place) in str(error.value)


def test_a_pipe_is_not_waited_for(workspace: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    place, began = workspace / "runs/toy/config.json", time.monotonic()
    place.unlink()
    os.mkfifo(place)
    run_all(workspace, tmp_path / "out", capsys, f"{place}: no ordinary file")
    with pytest.raises(UserError, match="no ordinary file"):
        read_run_config(workspace / "runs/toy")
    assert time.monotonic() - began < 60


def test_the_workspace_itself_may_be_reached_by_a_link(workspace: Path, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(workspace)
    open_workspace(tmp_path / "link")
    assert read_capture(tmp_path / "link/sequences/clip/capture").timesteps == 5


def test_the_library_follows_no_link_either(workspace: Path, victim: Path) -> None:
    """Functions check for themselves: no command has checked the workspace for their caller."""
    clip, run = workspace / "sequences/clip", workspace / "runs/toy"
    for place, read in (
        (clip / "capture/cache", lambda: read_capture(clip / "capture")),
        (clip / "capture/frames/front/000001.png", lambda: read_capture(clip / "capture")),
        (clip / "tracking/tracking.safetensors", lambda: read_tracking(clip / "tracking")),
        (clip / "scoring/masks/00", lambda: read_scoring(clip / "scoring")),
        (run / "videos", lambda: evaluate(run, [clip])),
    ):
        aside = workspace / "aside"
        if place.exists():
            place.rename(aside)
        put(place, victim if place.suffix == "" else victim / "notes")
        with pytest.raises(UserError, match="a link"):
            read()
        place.unlink()
        if aside.exists():
            aside.rename(place)


def test_a_cache_is_not_written_through_links_nor_second_names(workspace: Path, victim: Path) -> None:
    folder = workspace / "sequences/clip/capture"
    whole, raw = read_capture(folder), folder / "cache/frames.u8"
    raw.unlink()
    os.link(victim / "frames.u8", raw)
    assert_same_capture(read_capture(folder), whole)
    layout = FrameLayout(folder, ("front",), 5, 32, 32)
    for make in (lambda: raw.symlink_to(victim / "frames.u8"), lambda: os.link(victim / "frames.u8", raw)):
        raw.unlink()
        make()
        with pytest.raises(UserError, match="a link|also lies elsewhere"):
            CacheWriter(layout)


def test_frames_are_not_written_through_links_nor_second_names(tmp_path: Path, victim: Path) -> None:
    layout = FrameLayout(tmp_path / "capture", ("0",), 2, 4, 4)
    (layout.folder / "frames/0").mkdir(parents=True)
    layout.png("frames", 0, 0).symlink_to(victim / "000000.png")
    os.link(victim / "notes", layout.png("frames", 1, 0))
    with FrameWriter(layout) as writer:
        for timestep in range(2):
            writer.submit(timestep, lambda: (np.zeros((1, 4, 4, 3), np.uint8), np.zeros((1, 4, 4), np.uint8)))
        writer.flush()
    assert not layout.png("frames", 0, 0).is_symlink()


def test_partial_figures_are_not_written_through_links_nor_second_names(tmp_path: Path, victim: Path) -> None:
    for make in (lambda path: path.symlink_to(victim / "notes"), lambda path: os.link(victim / "notes", path)):
        path = tmp_path / ".a.partial"
        path.unlink(missing_ok=True)
        make(path)
        partial = PartialScores(path, "0123")
        with pytest.raises(UserError, match="a link|also lies elsewhere"):
            partial.add(Frame(0, 0, 0), {}, 0.0)
        assert partial.read() == {}
        assert not path.is_symlink()


def test_partial_figures_of_other_kinds_are_dropped(workspace: Path) -> None:
    """Behind the right first line stands whatever a stranger wants."""
    run, clip = workspace / "runs/toy", workspace / "sequences/clip"
    settings = EvaluationSettings(perceptual=False, video_frames=0)
    fingerprint = next(iter(read_json_content(run / "metrics.json")["fingerprints"].values()))
    for line in (
        '{"frame": [0, 4, 0], "scores": {}, "seconds": 1}',
        '{"frame": [0, 4, 0], "scores": {"avatar": {"psnr": "high"}}, "seconds": 1}',
        '{"frame": [0, 4, 0], "scores": [], "seconds": 1}',
        f'{{"frame": [0, {HUGE}, 0], "scores": {{}}, "seconds": 1}}',
        "[" * 5000,
    ):
        (run / ".self_reenactment_tail.partial").write_text(f'{{"scores_of": "{fingerprint}"}}\n{line}\n')
        assert evaluate(run, [clip], settings)["protocols"]["self_reenactment_tail"]["psnr"] > 0


def read_json_content(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())


def test_new_files_and_removed_folders_leave_what_links_lead_to(tmp_path: Path, victim: Path) -> None:
    (tmp_path / "file").symlink_to(victim / "notes")
    with open_new(tmp_path / "file") as file:
        file.write(b"ours")
    assert (tmp_path / "file").read_bytes() == b"ours"
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder/link").symlink_to(victim)
    (tmp_path / "link").symlink_to(victim)
    for name in ("folder", "link", "missing"):
        remove_tree(tmp_path / name)
        assert not os.path.lexists(tmp_path / name)


@pytest.mark.parametrize(
    "name", ["", ".", "..", "../x", "/x", "a/b", "a\\b", "a\0b", "a\x1b[2J", NOT_ONE_LINE, "é" * 200, 3]
)
def test_names_that_lead_elsewhere(name: Any, tmp_path: Path) -> None:
    assert not is_plain_name(name)
    with pytest.raises(UserError, match="give a plain name"):
        inside(tmp_path, name)


@pytest.mark.parametrize("name", ["clip", "Anna 2", "a:b", "12\u202fAM", "ü", "声", ".hidden"])
def test_names_of_ordinary_files(name: str, tmp_path: Path) -> None:
    assert inside(tmp_path, name) == tmp_path / name


def test_names_in_files_stay_in_their_folder(workspace: Path, victim: Path) -> None:
    run, capture = workspace / "runs/toy", workspace / "sequences/clip/capture"
    for name in ("../../../home", str(victim), NOT_ONE_LINE, 3, None):
        edit_json(run / "config.json", lambda content, name=name: content["data"][0].update(sequence=name))
        with pytest.raises(UserError, match=r"config\.json"):
            read_run_config(run)
        edit_json(capture / "capture.json", lambda content, name=name: content.update(camera_ids=[name]))
        with pytest.raises(UserError, match=r"capture\.json"):
            read_capture(capture)
    for name in ("../home", str(victim), NOT_ONE_LINE):
        with pytest.raises(UserError, match="plain name"):
            Workspace(workspace).run_dir(name)


def test_a_deep_tree_is_told(tmp_path: Path) -> None:
    """Deeper than a path can be."""
    top = os.open(tmp_path, os.O_RDONLY)
    place = top
    for _ in range(30):
        os.mkdir("d" * 200, dir_fd=place)
        below = os.open("d" * 200, os.O_RDONLY, dir_fd=place)
        os.close(place)
        place = below
    os.close(place)
    with pytest.raises(UserError, match="cannot be looked through"):
        check_tree(tmp_path)


CAPTURES: dict[str, Callable[[dict[str, Any]], object]] = {
    "timesteps": lambda c: c.update(timesteps=10**9),
    "timesteps huge": lambda c: c.update(timesteps=HUGE),
    "timesteps text": lambda c: c.update(timesteps="5"),
    "width": lambda c: c.update(width=10**9),
    "width huge": lambda c: c.update(width=HUGE),
    "size": lambda c: c.update(width=30000, height=30000),
    "fps": lambda c: c.update(fps=HUGE),
    "fps small": lambda c: c.update(fps=1e-300),
    "camera twice": lambda c: c.update(camera_ids=["front", "front"]),
    "name": lambda c: c.update(name=NOT_ONE_LINE),
    "source": lambda c: c.update(source=[]),
    "deep": lambda c: c.update(source={"a": nested(900)}),
}


def nested(depth: int) -> list[Any]:
    inner: list[Any] = []
    for _ in range(depth):
        inner = [inner]
    return inner


@pytest.mark.parametrize("name", CAPTURES)
def test_captures_that_cannot_be(name: str, workspace: Path) -> None:
    folder = workspace / "sequences/clip/capture"
    edit_json(folder / "capture.json", CAPTURES[name])
    with pytest.raises(UserError, match=r"capture\.json|timestamps is"):
        read_capture(folder)


@pytest.mark.parametrize(
    ("name", "value"),
    [("landmarks", np.nan), ("landmarks", np.inf), ("landmarks", 3e38), ("timestamps", np.nan), ("timestamps", 1e300),
     ("principal_point", np.inf)],
)  # fmt: skip
def test_capture_numbers_that_cannot_be(name: str, value: float, workspace: Path) -> None:
    folder = workspace / "sequences/clip/capture"
    arrays = read_arrays(folder / "landmarks.safetensors")
    arrays[name] = np.array(arrays[name])
    arrays[name].flat[-1] = value
    write_arrays(folder / "landmarks.safetensors", arrays)
    with pytest.raises(UserError, match=f"{name} holds numbers that cannot be"):
        read_capture(folder)


def test_a_picture_larger_than_it_should_be_is_not_decoded(workspace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its header claims 30,000 x 30,000 pixels, which would take gigabytes."""
    folder = workspace / "sequences/clip"
    decoded: list[object] = []
    monkeypatch.setattr("mien.picture_files.cv2.imdecode", lambda *arguments: decoded.append(arguments))
    shutil.rmtree(folder / "capture/cache")
    for file, read in (
        (folder / "capture/frames/front/000000.png", lambda: read_capture(folder / "capture")),
        (folder / "scoring/masks/00/000000.png", lambda: read_scoring(folder / "scoring")),
    ):
        data = bytearray(file.read_bytes())
        data[16:24] = (30000).to_bytes(4, "big") * 2
        file.write_bytes(data)
        with pytest.raises(UserError, match="damaged, or not of 32x32 pixels"):
            read()
    assert decoded == []
    assert not (folder / "capture/cache/frames.u8").exists()


def rewrite_tracking(folder: Path, change: Callable[[dict[str, Tensor]], object]) -> None:
    tensors = read_tensors(folder / "tracking.safetensors")
    change(tensors)
    write_tensors(folder / "tracking.safetensors", tensors)
    digest = file_digest(folder / "tracking.safetensors")
    edit_json(folder / "tracking.json", lambda content: content.update(tensors_sha256=digest))


TRACKINGS: dict[str, Callable[[Path], object]] = {
    "camera 3e38": lambda f: rewrite_tracking(f, lambda t: t["camera_K"].fill_(3e38)),
    "viewmat": lambda f: rewrite_tracking(f, lambda t: t["camera_viewmats"].mul_(2)),
    "focal": lambda f: rewrite_tracking(f, lambda t: t["camera_K"].neg_()),
    "huge": lambda f: rewrite_tracking(f, lambda t: t["head_translation"].fill_(3e38)),
    "dtype": lambda f: rewrite_tracking(f, lambda t: t.update(expression=t["expression"].half())),
    "whole": lambda f: rewrite_tracking(f, lambda t: t.update(neck_lines=t["neck_lines"].long())),
    "float8": lambda f: rewrite_tracking(f, lambda t: t.update(joints=t["joints"].to(torch.float8_e4m3fn))),
    "width": lambda f: edit_json(f / "tracking.json", lambda c: c["cameras"][0].update(width=10**9)),
    "width huge": lambda f: edit_json(f / "tracking.json", lambda c: c["cameras"][0].update(width=HUGE)),
    "cameras": lambda f: edit_json(f / "tracking.json", lambda c: c.update(cameras={})),
    "face model": lambda f: edit_json(f / "tracking.json", lambda c: c.update(face_model=["anny"])),
    "settings": lambda f: edit_json(f / "tracking.json", lambda c: c.update(settings=[1])),
    "together": lambda f: edit_json(f / "tracking.json", lambda c: c["settings"].update(tracked_together=3)),
    "looks": lambda f: edit_json(f / "tracking.json", lambda c: c.update(looks=[])),
}


@pytest.mark.parametrize("name", TRACKINGS)
def test_trackings_that_cannot_be(name: str, workspace: Path) -> None:
    TRACKINGS[name](workspace / "sequences/clip/tracking")
    with pytest.raises(UserError, match="tracking") as error:
        read_tracking(workspace / "sequences/clip/tracking")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "change",
    [{"timesteps": 10**9}, {"timesteps": HUGE}, {"cameras": "1"}, {"width": HUGE}, {"height": 10**6}, {"width": None}],
)
def test_scorings_that_cannot_be(change: dict[str, Any], workspace: Path) -> None:
    folder = workspace / "sequences/clip/scoring"
    edit_json(folder / "scoring.json", lambda content: content.update(change))
    with pytest.raises(UserError, match="scoring"):
        read_scoring(folder)


@pytest.mark.parametrize("crop", [[-1, 0, 8, 8], [0, 0, 33, 8], [2**31 - 1, 0, 2**31 - 1, 1]])
def test_crops_out_of_the_picture(crop: list[int], workspace: Path) -> None:
    folder = workspace / "sequences/clip/scoring"
    write_arrays(folder / "crops.safetensors", {"crops": np.tile(np.array(crop, np.int32), (5, 1, 1))})
    with pytest.raises(UserError, match="extends beyond the picture"):
        read_scoring(folder)


def test_parts_of_a_sequence_have_to_be_of_the_same_pictures(workspace: Path) -> None:
    clip = workspace / "sequences/clip"

    def shorten(tensors: dict[str, Tensor]) -> None:
        per_timestep = ("expression", "joints", "head_rotation", "head_translation", "valid", "neck_lines", "residuals")
        tensors.update({name: tensors[name][:3].clone() for name in per_timestep})

    rewrite_tracking(clip / "tracking", shorten)
    read_tracking(clip / "tracking")
    with pytest.raises(UserError, match="other pictures than the capture"):
        read_sequence(clip)


RUNS: dict[str, tuple[Callable[[Path], object], Callable[[Path], object]]] = {
    "camera": (lambda r: edit_config(r, lambda c: c["data"][0]["camera"].update(width=10**9)), run_camera),
    "camera 3e38": (lambda r: edit_config(r, lambda c: c["data"][0]["camera"].update(K=[[3e38] * 3] * 3)), run_camera),
    "no data": (lambda r: edit_config(r, lambda c: c.update(data=[])), read_run_config),
    "settings": (lambda r: edit_config(r, lambda c: c.update(settings=[{"split": 1}])), read_run_config),
    "method": (lambda r: edit_config(r, lambda c: c.update(method={"kind": 3})), read_run_config),
    "command line": (lambda r: edit_config(r, lambda c: c.update(command_line=[1])), read_run_config),
    "steps": (lambda r: edit_json(r / "training.json", lambda c: c.update(steps="many")), read_training_summary),
    "seconds": (lambda r: edit_json(r / "training.json", lambda c: c.update(seconds=HUGE)), read_training_summary),
    "curves": (lambda r: write_tensors(r / "curves.safetensors", {"loss": torch.zeros(2, 2)}), read_curves),
    "no curves": (lambda r: write_tensors(r / "curves.safetensors", {}), read_curves),
    "faces": (
        lambda r: change_tensors(r / "face_track.safetensors", lambda t: t["expression"].fill_(torch.nan)),
        lambda r: load_experiments(r, [r.parent.parent / "sequences/clip"]),
    ),
    "faces of another model": (
        lambda r: change_tensors(r / "face_track.safetensors", lambda t: t.update(expression=torch.zeros(5, 9))),
        lambda r: load_experiments(r, [r.parent.parent / "sequences/clip"]),
    ),
}


def edit_config(run: Path, change: Callable[[dict[str, Any]], object]) -> None:
    edit_json(run / "config.json", change)


def change_tensors(path: Path, change: Callable[[dict[str, Tensor]], object]) -> None:
    tensors = read_tensors(path)
    change(tensors)
    write_tensors(path, tensors)


@pytest.mark.parametrize("name", RUNS)
def test_runs_that_cannot_be(name: str, workspace: Path) -> None:
    change, read = RUNS[name]
    change(workspace / "runs/toy")
    with pytest.raises(UserError) as error:
        read(workspace / "runs/toy")
    assert "\n" not in str(error.value)


def of_protocol(change: Callable[[dict[str, Any]], object]) -> Callable[[dict[str, Any]], object]:
    return lambda content: change(content["protocols"]["self_reenactment_tail"])


METRICS: dict[str, Callable[[dict[str, Any]], object]] = {
    "protocols": lambda c: c.update(protocols=[]),
    "a protocol": lambda c: c.update(protocols={"self_reenactment_tail": 3}),
    "name": lambda c: c["protocols"].update({NOT_ONE_LINE: c["protocols"]["self_reenactment_tail"]}),
    "other protocol": lambda c: c.update(protocols={"novel": c["protocols"]["self_reenactment_tail"]}),
    "text": of_protocol(lambda e: e.update(psnr="high")),
    "none": of_protocol(lambda e: e.update(psnr=None)),
    "huge": of_protocol(lambda e: e.update(psnr=HUGE)),
    "list": of_protocol(lambda e: e.update(ssim=[1])),
    "head": of_protocol(lambda e: e.update(head=None)),
    "no head": of_protocol(lambda e: e.pop("head")),
    "faces": of_protocol(lambda e: e.update(face_params="guessed")),
    "frames": of_protocol(lambda e: e.update(frames="1")),
    "split": of_protocol(lambda e: e.update(split={})),
    "baselines": of_protocol(lambda e: e.update(baselines=[1])),
    "a baseline": of_protocol(lambda e: e["baselines"].update(mesh={"psnr": 1.0})),
    "another baseline": of_protocol(lambda e: e["baselines"].update(other=e["baselines"]["mesh"])),
    "scored on": of_protocol(lambda e: e.update(scored_on=["clip"])),
    "frames differ": of_protocol(lambda e: e["per_frame"].update(timestep=[])),
    "per frame": of_protocol(lambda e: e.pop("per_frame")),
    "a frame's figure": of_protocol(lambda e: e["per_frame"].update(head_psnr=["x"])),
    "backbone": of_protocol(lambda e: e.update(perceptual_backbone=[1])),
    "seconds": of_protocol(lambda e: e.update(seconds_per_frame=None)),
    "training": lambda c: c.update(training={"gaussians": "many", "seconds": 1}),
    "no training": lambda c: c.pop("training"),
}


@pytest.mark.parametrize("name", METRICS)
def test_edited_metrics_are_told_in_a_comparison(
    name: str, workspace: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    edit_json(workspace / "runs/toy/metrics.json", METRICS[name])
    assert main(["evaluate", str(workspace), "--compare"]) == 2
    told = capsys.readouterr().err.strip()
    assert "metrics.json" in told
    assert len([line for line in told.splitlines() if "metrics.json" in line]) == 1
    assert "Traceback" not in told


def test_metrics_as_they_were_written_are_compared(workspace: Path) -> None:
    assert len(compare_runs({"toy": workspace / "runs/toy"}).tables) == 1


@pytest.mark.parametrize(
    ("header", "message"),
    [
        (b'{"__metadata__": [1]}', "metadata is no object"),
        (b'{"__metadata__": "x"}', "metadata is no object"),
        (b"[]", "metadata is no object"),
        (b"[" * 3000, "too deep"),
        (b'{"a": ' + b"9" * 400 + b"}", "400 digits"),
        (b'{"a": {"dtype": "F32", "shape": [1000000000000], "data_offsets": [0, 4000000000000]}}', "damaged"),
        (b'{"a": {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}, "b": {"dtype": "F32", "shape": [1], '
         b'"data_offsets": [0, 4]}}', "damaged"),
        (b'{"a": {"dtype": "BF16", "shape": [2], "data_offsets": [0, 4]}}', "damaged"),
    ],
)  # fmt: skip
def test_safetensors_headers_that_cannot_be(header: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    path.write_bytes(len(header).to_bytes(8, "little") + header + bytes(4))
    with pytest.raises(UserError, match=message):
        read_arrays(path)


def test_a_huge_safetensors_file_is_not_read(tmp_path: Path) -> None:
    path, header = tmp_path / "a.safetensors", b"{}"
    path.write_bytes(len(header).to_bytes(8, "little") + header)
    with path.open("r+b") as file:
        file.truncate(1 << 40)
    with pytest.raises(UserError, match="too many"):
        read_arrays(path)


def test_a_chosen_number_of_parts_is_not_counted_to(
    workspace: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The part that a capture says it is of so many others: they are looked for one after the other."""
    write_gradient_video(tmp_path / "clip.mp4")
    for name in ("clip", "clip-1"):
        capture = workspace / "sequences" / name / "capture"
        if not capture.exists():
            shutil.copytree(workspace / "sequences/clip/capture", capture)
        edit_json(capture / "capture.json", lambda c: c.update(source={"part": {"count": 10**12}}))
    began = time.monotonic()
    assert main(["capture", str(tmp_path / "clip.mp4"), "--out", str(workspace)]) == 2
    assert time.monotonic() - began < 30
    assert "holds a capture of something else" in capsys.readouterr().err


def test_json_is_written_as_it_is_read(tmp_path: Path) -> None:
    """The checksum of what holds tuples, numbers as keys and large whole numbers."""
    content = {"a": (1, 2.5, [2**63 - 1]), "b": {"1": None}}
    write_json(tmp_path / "a.json", "x", 1, {**content, "b": {1: None}})
    assert read_json(tmp_path / "a.json", "x", 1)["a"] == [1, 2.5, [2**63 - 1]]


def test_kept_pieces_of_a_tracking_that_are_of_no_use(
    workspace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Tracking starts again, once, if the kept files are whole but hold something else."""
    keep, seen = tmp_path / ".tracking-0123", []
    keep.mkdir()

    def fit(captures: object, face_model: object, settings: object, keep: Path, page: object) -> list[object]:
        seen.append(keep.exists())
        if keep.exists():
            raise KeyError("rows")
        return []

    monkeypatch.setattr(pipeline, "_track_subject", fit)
    capture = read_capture(workspace / "sequences" / "clip" / "capture")
    arguments: Any = ([capture], toy_face_model(), TrackingSettings(), keep, None)
    assert track_subject(*arguments) == []
    assert seen == [True, False]
    assert "starts again" in capsys.readouterr().err
    monkeypatch.setattr(pipeline, "_track_subject", lambda *_: {}["a bug of ours"])
    with pytest.raises(KeyError):
        track_subject(*arguments)


def test_a_capture_named_like_our_scratch_folder_is_not_removed(workspace: Path) -> None:
    folder = (workspace / "sequences/clip/capture").rename(workspace / "mien-capture-mine")
    assert read_capture(folder).timesteps == 5
    assert read_capture(folder).timesteps == 5
