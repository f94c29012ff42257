"""Makes a study: one page for participants, and the key beside it."""

import base64
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from typing import Any

from mien.disk.files import file_digest, write_atomically
from mien.disk.locks import hold
from mien.lab.analysis.study.clips import Clip, HeldOut, StudyRuns, choose_clips, read_held_out
from mien.lab.analysis.study.drawing import VISIBLE_CRF, Encoded, drawn_clip, encode
from mien.lab.analysis.study.files import ANSWERS, VERSION, KeyClip, StudyKey, key_path, write_key
from mien.lab.analysis.study.settings import StudySettings
from mien.machine.progress import progress_bar, say

_ROOM = 1_000
"""Bytes of the page's data for each clip beside its video."""
_MEGABYTE = 1_000_000


def write_study(path: Path, workspaces: Sequence[StudyRuns], settings: StudySettings) -> StudyKey:
    """Write a study's page to `path` and its key beside it, and return the key.

    Args:
        path: The .html file. The key is `key_path(path)`.
        workspaces: The runs to compare.
        settings: Clips, sizes and seed.
    """
    settings.check()
    with hold(path):
        clips = choose_clips(workspaces, settings)
        key = make_key(workspaces, clips, settings)
        videos = _videos(workspaces, clips, key, settings)
        page = page_html(key, clips, [video.data for video in videos], settings.side)
        assert len(page) <= settings.megabytes * _MEGABYTE, "the page is larger than its budget"
        write_key(key_path(path), key)
        write_atomically(path, lambda aside: aside.write_bytes(page))
    worst = max(video.crf for video in videos)
    say(
        f"{len(clips)} clips of {len(key.runs)} runs beside the truth; {len(page) / _MEGABYTE:.1f} of "
        f"{settings.megabytes:g} MB, x264's quality {worst}"
    )
    if worst >= VISIBLE_CRF:
        say("warning: the compression may be seen; give more --megabytes, fewer --clips, less --seconds")
    return key


def make_key(workspaces: Sequence[StudyRuns], clips: Sequence[Clip], settings: StudySettings) -> StudyKey:
    """The opaque names of a study, its clips and tiles.

    They are hashes of the seed and of the avatars' files, so that nobody who has only the page can compute which name
    belongs to which run.
    """
    avatars = [[file_digest(run_dir / "avatar/avatar.safetensors") for run_dir, _ in one.runs.values()]
               for one in workspaces]  # fmt: skip
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
) -> list[Encoded]:
    """A video for each clip. Its tiles are the truth, and the runs in the order of their opaque names."""
    videos: dict[int, Encoded] = {}
    left = int(settings.megabytes * _MEGABYTE) - len(_template()) - _ROOM * (1 + len(clips))
    frames_left = sum(clip.timesteps for clip in clips)
    with progress_bar("study", frames_left, 0) as advance:
        for place, workspace in enumerate(workspaces):
            own = [index for index, clip in enumerate(clips) if clip.workspace == place]
            runs = {label: read_held_out(*folders) for label, folders in workspace.runs.items()} if own else {}
            for index in own:
                clip = clips[index]
                # In base64, three bytes take four. What a clip leaves of its share is for those after it.
                share = left * clip.timesteps // frames_left * 3 // 4
                videos[index] = _video(clip, key.clips[index], runs, settings.side, share)
                left -= -(-len(videos[index].data) // 3) * 4
                frames_left -= clip.timesteps
                advance(clip.timesteps)
    return [videos[index] for index in range(len(clips))]


def _video(clip: Clip, entry: KeyClip, runs: Mapping[str, HeldOut], side: int, most: int) -> Encoded:
    shown = [runs[label] for label in entry.tiles.values()]
    with drawn_clip(clip, shown, side) as frames:
        return encode(frames, clip.fps, most, f"a clip of {clip.timesteps} frames of {clip.sequence}")


def page_html(key: StudyKey, clips: Sequence[Clip], videos: Sequence[bytes], side: int) -> bytes:
    """The page: it holds opaque names and videos, and no name of a run, a person or a file."""
    # Sorted by opaque name, so that the order in the file says nothing either.
    order = sorted(range(len(clips)), key=lambda index: key.clips[index].name)
    content: dict[str, Any] = {
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
