"""Scored pictures as files: side-by-side videos for people, png pictures for other programs."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from torch import Tensor

from mien.camera import Box
from mien.evaluation.experiment import Experiment, avatar_image, head_box, target_image
from mien.evaluation.image_folders import CROPS_NAME, write_crops
from mien.evaluation.metrics import crop_to
from mien.evaluation.protocols import AVATAR, Evaluation
from mien.machine.parallel import stream_in_threads
from mien.machine.progress import track_progress
from mien.media.picture_files import write_png
from mien.media.pictures import WHITE, error_heat, shrink, side_by_side, to_uint8
from mien.media.video import write_video
from mien.training.footage.frames import Frame

_MAX_SIDE = 440
_BAR = 26
_CRF = 24


def write_comparison_video(
    path: Path, experiment: Experiment, evaluation: Evaluation, max_count: int, threads: int | None = None
) -> int:
    """Write held-out frames as truth, rendering and error heat map side by side; return the number of frames.

    If there are more than `max_count`, the first ones of each sequence and camera are used. `threads` change no byte.
    """
    places = {frame: index for index, frame in enumerate(evaluation.frames)}
    frames = choose_video_frames(evaluation.frames, max_count)
    boxes = {view: head_box(experiment, [f for f in frames if f[::2] == view]) for view in {f[::2] for f in frames}}

    def picture(job: tuple[Frame, Tensor]) -> UInt8[np.ndarray, "h w 3"]:
        frame, drawn = job
        box = boxes[frame[::2]]
        truth, image = crop_to(target_image(experiment, frame), box), crop_to(drawn, box)
        scores = evaluation.scores[AVATAR][places[frame]]
        where = f"{experiment.sequences[frame.sequence].name}, camera {experiment.camera_id(frame)}, {frame.timestep}"
        panels = {
            f"truth: {where}": to_uint8(truth),
            f"rendering: {scores['psnr']:.1f} dB, head {scores['head_psnr']:.1f}": to_uint8(image),
            "error": error_heat(image, truth),
        }
        return labeled_row(panels)

    first = experiment.sequences[frames[0].sequence].capture
    shown = track_progress(frames, f"video {path.stem}", len(frames))
    # Rendering runs here, frame by frame; all else runs in threads.
    jobs = ((frame, avatar_image(experiment, frame)) for frame in shown)
    write_video(path, match_sizes(stream_in_threads(picture, jobs, threads)), first.fps, _CRF)
    return len(frames)


def choose_video_frames(frames: Sequence[Frame], max_count: int) -> list[Frame]:
    """At most `max_count` frames for a video, camera by camera: the first ones of each, equally many."""
    groups: dict[tuple[int, int], list[Frame]] = {}
    for frame in sorted(frames, key=lambda one: (one.sequence, one.camera, one.timestep)):
        groups.setdefault((frame.sequence, frame.camera), []).append(frame)
    each = len(frames) if len(frames) <= max_count else max(1, max_count // len(groups))
    return [frame for group in groups.values() for frame in group[:each]]


def labeled_row(panels: Mapping[str, UInt8[np.ndarray, "_ _ 3"]]) -> UInt8[np.ndarray, "h w 3"]:
    """Pictures in a row, shrunk, each below a bar with its name."""
    named = []
    for name, panel in panels.items():
        small = shrink(panel, _MAX_SIDE)
        bar = np.full((_BAR, small.shape[1], 3), WHITE, np.uint8)
        cv2.putText(bar, name, (4, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (40, 40, 40), 1, cv2.LINE_AA)
        named.append(np.concatenate([bar, small]))
    return side_by_side(named)


def match_sizes(pictures: Iterator[UInt8[np.ndarray, "_ _ 3"]]) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Yield the pictures in the size of the first. Smaller ones get a white border, larger ones are shrunk."""
    size: tuple[int, int] | None = None
    for picture in pictures:
        if size is None:
            size = (picture.shape[0], picture.shape[1])
        if picture.shape[:2] == size:
            yield picture
            continue
        factor = min(1.0, size[0] / picture.shape[0], size[1] / picture.shape[1])
        small = cv2.resize(picture, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA) if factor < 1 else picture
        page = np.full((*size, 3), WHITE, np.uint8)
        height, width = min(size[0], small.shape[0]), min(size[1], small.shape[1])
        page[:height, :width] = small[:height, :width]
        yield page


def write_scored_pictures(folder: Path, experiment: Experiment) -> None:
    """Write scored pictures as FOLDER/{truth,rendering}/SEQUENCE_CAMERA_TIMESTEP.png, and truth/crops.json.

    `score_folders` gives the figures of metrics.json for them. A folder of another program's pictures with these names
    is scored in the same way.
    """
    crops: dict[str, Box] = {}
    frames = experiment.held_out_frames
    for frame in track_progress(frames, f"pictures {folder.name}", len(frames)):
        name = f"{experiment.sequences[frame.sequence].name}_{experiment.camera_id(frame)}_{frame.timestep:06d}"
        crops[name] = experiment.crop(frame)
        write_png(folder / "truth" / f"{name}.png", to_uint8(target_image(experiment, frame)))
        write_png(folder / "rendering" / f"{name}.png", to_uint8(avatar_image(experiment, frame)))
    write_crops(folder / "truth" / CROPS_NAME, crops)
