"""Step 1: tell the user, and the report, what kind of video it is: HDR, interlaced, or with combs.

A mark that the file lacks, or has wrongly, shows in its combs. Pictures never change because of them: the user decides.
"""

from typing import Any

import numpy as np

from mien.capture.person.survey import Survey
from mien.machine.progress import say
from mien.media.source import FrameSource

_COMBED = 0.9
"""Quantile of the frames' combs that counts: a still head has none."""
_MIN_COMBS = 0.004
"""Part of the picture with combs (`mien.media.fields.combs`) from which a video counts as interlaced. Seven
progressive clips have at most 0.0008, with noise of 8 levels 0.0027. Woven from two frames each, they have 0.0066."""


def tell_kind(frames: FrameSource) -> None:
    """Say what the file states, before it is read."""
    if frames.other_streams:
        others = ", ".join(map(str, frames.other_streams))
        say(
            f"{frames.path}: has several streams of pictures; stream {frames.stream} is captured, and --capture.stream "
            f"chooses another ({others})"
        )
    if frames.hdr:
        say(f"{frames.path}: HDR video ({frames.hdr}); its pictures are tone-mapped to sRGB")
    if frames.has_field_pictures:
        say(
            f"warning: {frames.path}: each picture is a single field of interlaced video, of half the height (HEVC); "
            "mien does not join them: deinterlace it with a video program and give the result"
        )


def tell_fields(frames: FrameSource, survey: Survey) -> None:
    """Say how many frames were deinterlaced, and whether the file seems to be marked wrongly."""
    count, total, has_combs = int(survey.deinterlaced.sum()), len(survey.numbers), _has_combs(survey)
    if count:
        told = f"{frames.path}: interlaced; {count} of {total} frames are deinterlaced, each to one picture"
        if not has_combs and frames.deinterlace == "auto":
            told += "; they show no combs: if filmed progressively, --capture.deinterlace never keeps more detail"
        say(told)
    elif has_combs and frames.deinterlace == "auto":
        say(
            f"warning: {frames.path}: its lines alternate between two moments, but it is not marked as interlaced; if "
            "moving edges look like combs, add --capture.deinterlace always"
        )


def kind_report(frames: FrameSource, survey: Survey) -> dict[str, Any]:
    """Return the entries for the capture's report."""
    return {
        "hdr": frames.hdr or None,
        "frames_deinterlaced": int(survey.deinterlaced.sum()),
        "combs": _has_combs(survey),
    }


def _has_combs(survey: Survey) -> bool:
    measured = survey.combs[np.isfinite(survey.combs)]
    return bool(len(measured)) and float(np.quantile(measured, _COMBED)) > _MIN_COMBS
