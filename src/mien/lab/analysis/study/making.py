"""Make a study: one page for participants, and the key beside it.

The clips are parts of the held-out spans that all compared runs share. A clip is one video with the truth and every run
side by side, so that all play in step. One video has one quality, so compression treats all runs alike, and no file
size tells which run is which.
"""

import base64
import hashlib
import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from mien.camera import Box
from mien.disk.files import file_digest, write_atomically
from mien.disk.locks import hold
from mien.errors import UserError
from mien.evaluation.experiment import Experiment, avatar_image, head_box, target_image
from mien.evaluation.load import load_experiments
from mien.evaluation.metrics import crop_to
from mien.lab.analysis.study.files import ANSWERS, VERSION, KeyClip, StudyKey, StudySettings, key_path, write_key
from mien.machine.progress import progress_bar, say
from mien.media.pictures import WHITE, to_uint8
from mien.media.video import write_video
from mien.training.footage.frames import Frame

_MEGABYTE = 1_000_000


@dataclass(frozen=True)
class StudyRuns:
    """The runs of one workspace that a study compares."""

    name: str
    """Name of the workspace."""
    runs: Mapping[str, tuple[Path, tuple[Path, ...]]]
    """The folder of each run and those of its sequences, by the run's label. All workspaces have the same labels."""


@dataclass(frozen=True)
class Clip:
    """Consecutive held-out timesteps of one camera."""

    workspace: int
    sequence: str
    camera_id: str
    first: int
    timesteps: int
    fps: float


HeldOut = Mapping[tuple[str, str, int], tuple[Experiment, Frame]]
"""The held-out frames of one run, whatever the protocol, by sequence, camera and timestep."""


def read_held_out(run_dir: Path, sequence_dirs: Sequence[Path]) -> HeldOut:
    """The held-out frames of a run, with its avatar."""
    return {
        (one.sequences[frame.sequence].name, one.camera_id(frame), frame.timestep): (one, frame)
        for one in load_experiments(run_dir, sequence_dirs).values()
        for frame in one.held_out_frames
    }


def choose_clips(workspaces: Sequence[StudyRuns], settings: StudySettings) -> list[Clip]:
    """Random clips, in turn from each workspace, as long as there are any."""
    random = np.random.default_rng(settings.seed)
    left = []
    for index, workspace in enumerate(workspaces):
        found = _pieces(index, workspace, settings.seconds)
        left.append([found[place] for place in random.permutation(len(found))])
    turns = [int(index) for index in random.permutation(len(workspaces))]
    chosen: list[Clip] = []
    while len(chosen) < settings.clips and any(left):
        for index in turns:
            if left[index] and len(chosen) < settings.clips:
                chosen.append(left[index].pop())
    return chosen


def _pieces(index: int, workspace: StudyRuns, seconds: float) -> list[Clip]:
    """The clips of a workspace, without those that are less than half as long as the longest one."""
    rates: dict[str, float] = {}
    common: set[tuple[str, str, int]] | None = None
    for run_dir, sequence_dirs in workspace.runs.values():
        # One run at a time, so that memory does not grow with their number.
        held_out = read_held_out(run_dir, sequence_dirs)
        common = set(held_out) if common is None else common & set(held_out)
        rates |= {sequence.name: sequence.capture.fps for one, _ in held_out.values() for sequence in one.sequences}
    places: dict[tuple[str, str], list[int]] = {}
    for sequence, camera_id, timestep in sorted(common or ()):
        places.setdefault((sequence, camera_id), []).append(timestep)
    found = []
    for (sequence, camera_id), timesteps in places.items():
        for first, count in spans(timesteps, max(2, round(seconds * rates[sequence]))):
            found.append(Clip(index, sequence, camera_id, first, count, rates[sequence]))
    longest = max((clip.timesteps for clip in found), default=0)
    if longest == 0:
        raise UserError(
            f"{workspace.name}: {', '.join(workspace.runs)} have no held-out frames in a row in common; train them "
            "with the same --split or --hold-out"
        )
    return [clip for clip in found if clip.timesteps >= 0.5 * longest]


def spans(timesteps: Sequence[int], most: int) -> list[tuple[int, int]]:
    """Runs of consecutive timesteps, cut into about equal parts of at most `most`: the first one and the number.

    Parts of a single timestep are left out. `timesteps` are sorted.
    """
    found: list[tuple[int, int]] = []
    for part in np.split(np.array(timesteps), np.flatnonzero(np.diff(timesteps) != 1) + 1):
        pieces = np.array_split(part, -(-len(part) // most))
        found += [(int(piece[0]), len(piece)) for piece in pieces if len(piece) >= 2]
    return found


def write_study(path: Path, workspaces: Sequence[StudyRuns], settings: StudySettings) -> StudyKey:
    """Write a study's page to `path` (.html) and its key beside it (`key_path`), and return the key."""
    settings.check()
    with hold(path):
        clips = choose_clips(workspaces, settings)
        key = make_key(workspaces, clips, settings)
        videos = _videos(workspaces, clips, key, settings)
        page = page_html(key, clips, [data for data, _ in videos], settings.side)
        assert len(page) <= settings.megabytes * _MEGABYTE, "the page is larger than its budget"
        write_key(key_path(path), key)
        write_atomically(path, lambda aside: aside.write_bytes(page))
    worst = max(crf for _, crf in videos)
    say(
        f"{len(clips)} clips of {len(key.runs)} runs beside the truth; {len(page) / _MEGABYTE:.1f} of "
        f"{settings.megabytes:g} MB, x264's quality {worst}"
    )
    if worst >= 28:
        say("warning: the compression may be seen; give more --megabytes, fewer --clips, less --seconds")
    return key


def make_key(workspaces: Sequence[StudyRuns], clips: Sequence[Clip], settings: StudySettings) -> StudyKey:
    """The opaque names of a study, its clips and tiles.

    They are hashes of the seed and of the avatars' files, so that nobody who has only the page can compute which name
    belongs to which run.
    """
    folders = [[run_dir for run_dir, _ in one.runs.values()] for one in workspaces]
    avatars = [[file_digest(one / "avatar/avatar.safetensors") for one in runs] for runs in folders]
    labels = tuple(workspaces[0].runs)
    content = [asdict(settings), [one.name for one in workspaces], labels, avatars, [asdict(clip) for clip in clips]]
    secret = hashlib.sha256(json.dumps(content).encode()).hexdigest()

    def opaque(*parts: object) -> str:
        return hashlib.sha256("/".join(map(str, (secret, *parts))).encode()).hexdigest()[:12]

    entries = []
    for index, clip in enumerate(clips):
        tiles = {opaque("tile", index, label): label for label in labels}
        entries.append(
            KeyClip(
                opaque("clip", index), workspaces[clip.workspace].name, clip.sequence, clip.camera_id, clip.first,
                clip.timesteps, {name: tiles[name] for name in sorted(tiles)},
            )
        )  # fmt: skip
    return StudyKey(opaque("study"), settings.seed, labels, tuple(entries))


def _videos(
    workspaces: Sequence[StudyRuns], clips: Sequence[Clip], key: StudyKey, settings: StudySettings
) -> list[tuple[bytes, int]]:
    """A video for each clip, and its quality. Tiles are the truth, and the runs in the order of their opaque names."""
    videos: dict[int, tuple[bytes, int]] = {}
    # Beside its video, a clip takes up to 1,000 bytes of the page's data.
    left = int(settings.megabytes * _MEGABYTE) - len(_template()) - 1_000 * (1 + len(clips))
    frames_left = sum(clip.timesteps for clip in clips)
    with progress_bar("study", frames_left, 0) as advance:
        for place, workspace in enumerate(workspaces):
            own = [index for index, clip in enumerate(clips) if clip.workspace == place]
            runs = {label: read_held_out(*folders) for label, folders in workspace.runs.items()} if own else {}
            for index in own:
                clip = clips[index]
                # In base64, three bytes take four. What a clip leaves of its share is for those after it.
                share = left * clip.timesteps // frames_left * 3 // 4
                shown = [runs[label] for label in key.clips[index].tiles.values()]
                videos[index] = clip_video(clip, shown, settings.side, share)
                left -= -(-len(videos[index][0]) // 3) * 4
                frames_left -= clip.timesteps
                advance(clip.timesteps)
    return [videos[index] for index in range(len(clips))]


def clip_video(clip: Clip, runs: Sequence[HeldOut], side: int, most: int) -> tuple[bytes, int]:
    """The clip's frames as rows of square tiles, as `encode` returns them: the truth first, then the runs."""
    places = [
        [run[clip.sequence, clip.camera_id, clip.first + index] for index in range(clip.timesteps)] for run in runs
    ]
    first = places[0]
    box = square(head_box(first[0][0], [frame for _, frame in first]))
    with tempfile.TemporaryDirectory(prefix="mien-study-") as folder:
        # The frames are in a file, because long clips take gigabytes.
        shape = (clip.timesteps, side, side * (1 + len(runs)), 3)
        frames = np.lib.format.open_memmap(Path(folder) / "frames.npy", "w+", np.uint8, shape)
        for index in range(clip.timesteps):
            truth = tile(target_image(*first[index]), box, side)
            drawn = [tile(avatar_image(*own[index]), box, side) for own in places]
            frames[index] = np.concatenate([truth, *drawn], axis=1)
        return encode(frames, clip.fps, most, f"a clip of {clip.timesteps} frames of {clip.sequence}")


def square(box: Box) -> Box:
    """The smallest square around a box, with the same centre."""
    left, top, width, height = box
    side = max(width, height)
    return left - (side - width) // 2, top - (side - height) // 2, side, side


def tile(image: Float[Tensor, "h w 3"], box: Box, side: int) -> UInt8[np.ndarray, "s s 3"]:
    """The part of a picture inside a square box, white beyond the picture, scaled to `side` pixels."""
    left, top, width, height = box
    cut = to_uint8(crop_to(image, box))
    page = np.full((height, width, 3), WHITE, np.uint8)
    y, x = max(-top, 0), max(-left, 0)
    page[y : y + cut.shape[0], x : x + cut.shape[1]] = cut
    return cv2.resize(page, (side, side), interpolation=cv2.INTER_AREA if side < width else cv2.INTER_CUBIC)


def encode(frames: UInt8[np.ndarray, "t h w 3"], fps: float, most: int, what: str) -> tuple[bytes, int]:
    """The frames as an mp4 of at most `most` bytes, in the best of x264's qualities that fits, and that quality."""
    with tempfile.TemporaryDirectory(prefix="mien-study-") as folder:
        path = Path(folder) / "clip.mp4"
        for crf in (16, 18, 20, 22, 24, 26, 28, 30, 33, 36):
            write_video(path, frames, fps, crf)
            if path.stat().st_size <= most:
                return path.read_bytes(), crf
    raise UserError(
        f"{what}: does not fit into the page even at the lowest quality; give more --megabytes, fewer --clips, less "
        "--seconds or a smaller --side"
    )


def page_html(key: StudyKey, clips: Sequence[Clip], videos: Sequence[bytes], side: int) -> bytes:
    """The page: it holds opaque names and videos, and no name of a run, a person or a file."""
    # Sorted by opaque name, so that the order in the file says nothing either.
    order = sorted(range(len(clips)), key=lambda index: key.clips[index].name)
    content = {
        "format": ANSWERS,
        "version": VERSION,
        "study": key.study,
        "side": side,
        "clips": [
            {
                "clip": key.clips[index].name,
                "tiles": list(key.clips[index].tiles),
                "video": base64.b64encode(videos[index]).decode("ascii"),
            }
            for index in order
        ],
    }
    return _template().replace("{{study}}", json.dumps(content, separators=(",", ":"))).encode()


def _template() -> str:
    return files("mien.lab.analysis.study").joinpath("page.html").read_text(encoding="utf-8")
