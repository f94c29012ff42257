"""Lines that tell people what a dataset holds."""

from mien.datasets.dataset import Clip, Findings
from mien.machine.terminal import counted

_MAX_CLIPS = 12
"""Most sequences that are listed one by one."""


def findings_lines(findings: Findings, face_model_is_given: bool = True, corrects_colors: bool = True) -> list[str]:
    """Return the sequences, the face model, the split, the colours and what is missing, a line each."""
    clips = findings.clips
    lines = [f"  {_clip_line(clip)}" for clip in clips[:_MAX_CLIPS]]
    if len(clips) > _MAX_CLIPS:
        lines.append(f"  and {counted(len(clips) - _MAX_CLIPS, 'more sequence')}")
    lines = [f"  one person, {counted(len(clips), 'sequence')}", *lines]
    remedy = "" if face_model_is_given or findings.face_model is None else "; give yours with --face-model"
    lines.append(f"  face model: {findings.face_model or 'none, or none that can be used'}{remedy}")
    lines.append(f"  split: {findings.split or 'none'}")
    if findings.color_correction is not None:
        told = findings.color_correction if corrects_colors else "left out (--no-color-correction)"
        lines.append(f"  colour correction: {told}")
    return lines + [f"  missing or not used: {each}" for each in findings.missing]


def _clip_line(clip: Clip) -> str:
    frames = "as many frames as its videos" if clip.frames is None else counted(clip.frames, "frame")
    return f"{clip.name}: {frames}, {counted(clip.cameras, 'camera')}"
