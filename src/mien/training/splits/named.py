"""The split of GaussianAvatars on NeRSemble, by name: what is trained on, held out, and what drives other avatars.

Source: the paper's supplement, section B, tables 1 and 2. Needs no torch, because commands check it before any work.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from mien.errors import UserError
from mien.training.settings import TrainSettings

NAMED_SPLIT = "gaussian-avatars"
SEQUENCES = ("EMO-1", "EMO-2", "EMO-3", "EMO-4", "EXP-2", "EXP-3", "EXP-4", "EXP-5", "EXP-8", "EXP-9")
"""The sequences of table 1 that are trained on, except for the subject's held-out one."""
DRIVING = "FREE"
"""The sequence that is never trained on and drives avatars of other subjects."""
HELD_OUT = {
    "074": "EMO-4",
    "104": "EXP-2",
    "218": "EXP-9",
    "253": "EMO-4",
    "264": "EXP-9",
    "302": "EMO-2",
    "304": "EXP-2",
    "306": "EXP-2",
    "460": "EMO-3",
}
"""The held-out sequence of each subject (table 2)."""
NOVEL_VIEW = ("08", "222200037")
"""Names of the camera that is held out, the frontal one: its index in NeRSemble, and its serial number."""
_ID = re.compile(r"(?<![A-Z])(?:(EMO|EXP)-0?(\d)(?!\d)|FREE(?![A-Z]))")
_BY_HAND = "or choose yourself with --split none, --hold-out NAME and --hold-out-cameras ID"


@dataclass(frozen=True)
class NamedSplit:
    """The sequences of one subject, by what they are for."""

    subject: str
    sequences: tuple[str, ...]
    """Names of the ten sequences of the run, with the held-out one, in the order of `SEQUENCES`."""
    held_out: str
    """Name of the held-out sequence."""
    left_out: tuple[str, ...]
    """Names of the sequences that the run does not use, for example FREE."""


def split_by_name(names: Sequence[str], folder: str, subject: str | None = None) -> NamedSplit:
    """Divide a subject's sequences as the paper does.

    A sequence is recognised by the part of its name that is an id: EMO-1, EMO-1-shout+laugh and 306_EMO-1 are the same.

    Args:
        names: Names of the sequences.
        folder: Name of the subject's folder, which gives the subject if none is given.
        subject: The subject's number in NeRSemble.
    """
    subject = _subject(folder, subject)
    found: dict[str, str] = {}
    for name in names:
        key = _key(name)
        if key in found and key in SEQUENCES:
            raise UserError(
                f"--split {NAMED_SPLIT}: {found[key]} and {name} are both {key}; name one of them with --sequences"
            )
        found[key] = name
    missing = [key for key in SEQUENCES if key not in found]
    if missing:
        raise UserError(
            f"--split {NAMED_SPLIT}: {', '.join(missing)} of subject {subject} is missing; capture it with --name "
            f"{missing[0]} and track again, {_BY_HAND}"
        )
    chosen = tuple(found[key] for key in SEQUENCES)
    left_out = tuple(name for name in names if name not in chosen)
    return NamedSplit(subject, chosen, found[HELD_OUT[subject]], left_out)


def driving_sequences(names: Sequence[str]) -> list[str]:
    """The names of those sequences that drive avatars of other subjects."""
    return [name for name in names if _key(name) == DRIVING]


def _key(name: str) -> str:
    """The id in a sequence's name, or an empty text."""
    match = _ID.search(name)
    if match is None:
        return ""
    return f"{match[1]}-{match[2]}" if match[1] else DRIVING


def _subject(folder: str, given: str | None) -> str:
    known = f"the subjects are {', '.join(HELD_OUT)}"
    if given is not None:
        number = given.zfill(3)
        if number not in HELD_OUT:
            raise UserError(f"--subject {given}: is not a subject of --split {NAMED_SPLIT}; {known}; {_BY_HAND[3:]}")
        return number
    numbers = [number for number in re.findall(r"\d+", folder) if number in HELD_OUT]
    if len(set(numbers)) != 1:
        raise UserError(
            f"--split {NAMED_SPLIT}: the folder's name {folder!r} does not say which subject it is; give --subject "
            f"({known}), {_BY_HAND}"
        )
    return numbers[0]


def with_named_split(
    settings: TrainSettings, split: NamedSplit, camera_ids: Mapping[str, Sequence[str]] | None = None
) -> TrainSettings:
    """The settings with what the split holds out filled in.

    Args:
        settings: Settings whose `split` is `NAMED_SPLIT`.
        split: The subject's sequences.
        camera_ids: The ids of the cameras of each sequence, by the sequence's name; None before they are known.
    """
    _check_own(settings.held_out_sequences, (split.held_out,), "--hold-out")
    _check_own(settings.held_out_cameras, NOVEL_VIEW, "--hold-out-cameras")
    settings = replace(settings, held_out_sequences=(split.held_out,))
    if camera_ids is None:
        return settings
    cameras = set()
    for name in split.sequences:
        own = [one for one in camera_ids[name] if one in NOVEL_VIEW]
        if not own:
            raise UserError(
                f"--split {NAMED_SPLIT}: {name} has no camera {' or '.join(NOVEL_VIEW)}, which it holds out (there are "
                f"{', '.join(camera_ids[name])}); give the cameras their NeRSemble ids when you capture, {_BY_HAND}"
            )
        cameras.update(own)
    return replace(settings, held_out_cameras=tuple(sorted(cameras)))


def _check_own(given: Sequence[str], wanted: Sequence[str], option: str) -> None:
    other = [name for name in given if name not in wanted]
    if other:
        raise UserError(f"{option} {other[0]}: --split {NAMED_SPLIT} decides what is held out; leave {option} out")
