"""A stranger's workspace is refused if its files hold what cannot be.

Every file here has the right checksum, or none, since whoever makes a file can make its checksum.
"""

import json
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from capture_helpers import write_gradient_video
from damage import edit_json, nested
from mien.capture import read_capture
from mien.cli import main
from mien.errors import UserError
from mien.evaluation import EvaluationSettings, compare_runs, evaluate
from mien.evaluation.load import load_experiments
from mien.storage import file_digest, read_arrays, read_json, read_tensors, write_arrays, write_json, write_tensors
from mien.tracking import TrackingSettings, pipeline, read_scoring, read_tracking, track_subject
from mien.training import read_curves, read_run_config, read_sequence, read_training_summary, run_camera
from toy_scene import toy_face_model
from toy_workspace import write_evaluated_workspace

NOT_ONE_LINE = "a\nb"
HUGE = 10**400


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_evaluated_workspace(tmp_path_factory.mktemp("made") / "w")


@pytest.fixture
def workspace(made: Path, tmp_path: Path) -> Path:
    return shutil.copytree(made, tmp_path / "received", copy_function=shutil.copy2)


def test_partial_figures_of_other_kinds_are_dropped(workspace: Path) -> None:
    """Partial figures with impossible content are dropped, although their first line is right."""
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


@pytest.mark.parametrize("name", CAPTURES)
def test_captures_that_cannot_be(name: str, workspace: Path) -> None:
    """Impossible captures are refused by their file."""
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
    """Impossible numbers of a capture are refused by name."""
    folder = workspace / "sequences/clip/capture"
    arrays = read_arrays(folder / "landmarks.safetensors")
    arrays[name] = np.array(arrays[name])
    arrays[name].flat[-1] = value
    write_arrays(folder / "landmarks.safetensors", arrays)
    with pytest.raises(UserError, match=f"{name} holds impossible numbers"):
        read_capture(folder)


def test_a_picture_larger_than_it_should_be_is_not_decoded(workspace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A picture larger than it should be is not decoded. Its header claims 30,000 x 30,000 pixels."""
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
    """Impossible trackings are refused in one line."""
    TRACKINGS[name](workspace / "sequences/clip/tracking")
    with pytest.raises(UserError, match="tracking") as error:
        read_tracking(workspace / "sequences/clip/tracking")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "change",
    [{"timesteps": 10**9}, {"timesteps": HUGE}, {"cameras": "1"}, {"width": HUGE}, {"height": 10**6}, {"width": None}],
)
def test_scorings_that_cannot_be(change: dict[str, Any], workspace: Path) -> None:
    """Impossible scorings are refused."""
    folder = workspace / "sequences/clip/scoring"
    edit_json(folder / "scoring.json", lambda content: content.update(change))
    with pytest.raises(UserError, match="scoring"):
        read_scoring(folder)


@pytest.mark.parametrize("crop", [[-1, 0, 8, 8], [0, 0, 33, 8], [2**31 - 1, 0, 2**31 - 1, 1]])
def test_crops_out_of_the_picture(crop: list[int], workspace: Path) -> None:
    """Crops that reach out of the picture are refused."""
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
    """Impossible runs are refused in one line."""
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
    "eyes": of_protocol(lambda e: e.update(eyes={"psnr": "high"})),
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
        (b'{"__metadata__": [1]}', "metadata is not an object"),
        (b'{"__metadata__": "x"}', "metadata is not an object"),
        (b"[]", "metadata is not an object"),
        (b"[" * 3000, "too deep"),
        (b'{"a": ' + b"9" * 400 + b"}", "400 digits"),
        (b'{"a": {"dtype": "F32", "shape": [1000000000000], "data_offsets": [0, 4000000000000]}}', "damaged"),
        (b'{"a": {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}, "b": {"dtype": "F32", "shape": [1], '
         b'"data_offsets": [0, 4]}}', "damaged"),
        (b'{"a": {"dtype": "BF16", "shape": [2], "data_offsets": [0, 4]}}', "damaged"),
    ],
)  # fmt: skip
def test_safetensors_headers_that_cannot_be(header: bytes, message: str, tmp_path: Path) -> None:
    """Impossible safetensors headers are refused."""
    path = tmp_path / "a.safetensors"
    path.write_bytes(len(header).to_bytes(8, "little") + header + bytes(4))
    with pytest.raises(UserError, match=message):
        read_arrays(path)


def test_a_huge_safetensors_file_is_not_read(tmp_path: Path) -> None:
    path, header = tmp_path / "a.safetensors", b"{}"
    path.write_bytes(len(header).to_bytes(8, "little") + header)
    with path.open("r+b") as file:
        file.truncate(1 << 40)
    with pytest.raises(UserError, match="bytes, and at most"):
        read_arrays(path)


def test_a_chosen_number_of_parts_is_not_counted_to(
    workspace: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A capture may claim to be part of 10^12 parts. The command does not look for each of them."""
    write_gradient_video(tmp_path / "clip.mp4")
    for name in ("clip", "clip-1"):
        capture = workspace / "sequences" / name / "capture"
        if not capture.exists():
            shutil.copytree(workspace / "sequences/clip/capture", capture)
        edit_json(capture / "capture.json", lambda c: c.update(source={"part": {"count": 10**12}}))
    began = time.monotonic()
    assert main(["capture", str(tmp_path / "clip.mp4"), "--out", str(workspace)]) == 2
    assert time.monotonic() - began < 30
    assert "holds a capture of another source" in capsys.readouterr().err


def test_json_is_written_as_it_is_read(tmp_path: Path) -> None:
    """Tuples, numeric keys and large whole numbers have the same checksum when json is written and read."""
    content = {"a": (1, 2.5, [2**63 - 1]), "b": {"1": None}}
    write_json(tmp_path / "a.json", "x", 1, {**content, "b": {1: None}})
    assert read_json(tmp_path / "a.json", "x", 1)["a"] == [1, 2.5, [2**63 - 1]]


def test_kept_pieces_of_a_tracking_that_are_of_no_use(
    workspace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Tracking starts again, once, if the kept files are whole but hold something else."""
    keep, seen = tmp_path / ".tracking-0123", []
    keep.mkdir()

    def fit(captures: object, model: object, settings: object, keep: Path, *others: object) -> list[object]:
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
