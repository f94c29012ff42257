"""Step 5: finish a capture, by writing the results of all frames beside them."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mien.capture.frame_files import FRAMES, MATTES, FrameLayout
from mien.capture.parts import Part
from mien.capture.person.backend import Detector, detector_entry
from mien.capture.person.faces import second_difference_jitter
from mien.capture.person.survey import no_face
from mien.capture.person.video_kind import kind_report
from mien.capture.process import Chunk
from mien.capture.quality import quality_report, relative_quality
from mien.capture.store import CaptureData, finish_capture
from mien.disk.inside import remove_tree
from mien.machine.progress import say
from mien.media.pace import frame_rate, pace_report
from mien.media.source import FrameSource

CAMERA_ID = "0"


@dataclass(frozen=True)
class Origin:
    """The source of a part."""

    frames: FrameSource
    key: str
    name: str
    """Name of the whole, which may have several parts."""
    place: tuple[int, int]
    """The part's number, from 1, and the number of parts."""
    detector: Detector = "mediapipe"
    """What found the landmarks."""


def finish_part(
    layout: FrameLayout, out: Path, chunks: list[Chunk], part: Part, origin: Origin, scaffolding: tuple[str, ...]
) -> None:
    """Write the files beside the frames, remove `scaffolding` (names in the folder) and rename the folder to `out`."""
    landmarks = np.concatenate([chunk.landmarks for chunk in chunks])
    valid = np.concatenate([chunk.valid for chunk in chunks])
    if not valid.any():
        remove_tree(layout.folder)
        raise no_face(origin.frames.path, len(valid))
    survey, crop = part.survey, part.crop
    timestamps = survey.timestamps - survey.timestamps[0]
    measured = np.concatenate([chunk.quality for chunk in chunks])
    quality = relative_quality(measured)
    data = CaptureData(
        name=part.name,
        camera_ids=layout.camera_ids,
        fps=frame_rate(timestamps, origin.frames.fps),
        timestamps=timestamps,
        landmarks=landmarks[:, None],
        valid=valid[:, None],
        principal_point=crop.to_output(survey.picture_size / 2)[None],
        source={
            "key": origin.key,
            "file": origin.frames.path.name,
            "content_hash": origin.frames.content_hash,
            "picture_size": survey.picture_size.tolist(),
            "crop": {"left": crop.left, "top": crop.top, "width": crop.crop_width, "height": crop.crop_height},
            "first_frame": int(survey.numbers[0]),
            "part": {"of": origin.name, "number": origin.place[0], "count": origin.place[1]},
            **detector_entry(origin.detector),
        },
        quality=quality,
    )
    digests = {
        FRAMES: np.concatenate([chunk.frame_digests for chunk in chunks]),
        MATTES: np.concatenate([chunk.matte_digests for chunk in chunks]),
    }
    jitter = second_difference_jitter(landmarks)
    report = {
        "frames": len(valid),
        "frames_without_face": int((~valid).sum()),
        "frames_with_several_faces": int(part.person.crowded.sum()),
        "matte_pixels_taken_off": round(float(np.concatenate([chunk.taken_off for chunk in chunks]).mean()), 1),
        "landmark_jitter_px": jitter if np.isfinite(jitter) else None,
        **kind_report(origin.frames, survey),
        **pace_report(part.name, timestamps),
    }
    if not valid.all():
        say(f"{part.name}: no face in {report['frames_without_face']} of {len(valid)} frames; they are left out")
    report |= quality_report(part.name, quality, measured)
    for name in scaffolding:
        path = layout.folder / name
        remove_tree(path)
    finish_capture(layout, out, data, digests, report)
