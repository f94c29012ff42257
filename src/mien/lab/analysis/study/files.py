"""A study on disk: its settings, the key, which says what the page's opaque names stand for, the answers, their tally.

Needs no torch. The tally has percentages with confidence intervals, as in Table 3 of MonoGaussianAvatar. A judgement is
one participant's choice of the best run in one clip. The judgements of a participant resemble each other, so that 15
people with 10 clips each say less than 150 people with one clip. The interval is therefore Wilson's (1927) for an
effective number of judgements (Korn and Graubard 1998): the number of independent ones that would vary as much as the
participants' own percentages do.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import NormalDist
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float

from mien.disk.config import Range, check_ranges, decode
from mien.disk.files import read_json, write_json
from mien.disk.reading import expect_whole, listed, parse_json, read_bytes
from mien.errors import UserError
from mien.lab.benchmarking.comparing import markdown

QUESTIONS = {"quality": "visual quality", "expression": "expression accuracy"}
"""The questions of the study, by their names in answer files (MonoGaussianAvatar, supplement A.5)."""
MOST_RUNS = 8
"""Largest number of runs beside the truth."""
ANSWERS, VERSION = "mien.study_answers", 1
CONFIDENCE = 0.95
"""Share of the intervals that hold the true percentage, over many studies."""
TALLY = "mien.study_tally"
_KEY = "mien.study_key"
_KEY_REMEDY = "make the study again with the same seed and runs"
_AGAIN = "ask the participant to save it again, or leave it out"
_MASK = 0xFFFFFFFF


@dataclass(frozen=True)
class StudySettings:
    """Settings of a study's page."""

    clips: Annotated[int, Range(1, 200)] = 10
    """Largest number of clips, spread evenly over the workspaces. The paper showed 10."""
    seconds: Annotated[float, Range(0.1, 60)] = 4.0
    """Longest clip. A clip never crosses the end of a held-out part, so runs with --split tail or --hold-out have
    longer clips than those with --split blocks."""
    side: Annotated[int, Range(64, 1024)] = 384
    """Side of each picture in pixels, a multiple of 16 (H.264's blocks, none of which then holds pixels of two tiles).
    It shows the square around the head."""
    megabytes: Annotated[float, Range(1, 1000)] = 30.0
    """Largest size of the page, in millions of bytes. Videos are compressed until they fit."""
    seed: Annotated[int, Range(0, 2**63 - 1)] = 0
    """Seed of the choice of clips and of opaque names. The order of the methods differs for each participant and clip;
    the page draws it from the participant's number. The same seed, runs and settings give the same page."""

    def check(self) -> None:
        """Check that all numbers are in their ranges."""
        check_ranges(self, lambda name: f"--{name}")
        if self.side % 16:
            raise UserError(f"--side {self.side}: give a multiple of 16, for example {max(64, self.side // 16 * 16)}")


@dataclass(frozen=True)
class KeyClip:
    """What a clip of the page shows."""

    name: str
    """The clip's opaque name."""
    workspace: str
    """Name of the workspace's folder."""
    sequence: str
    camera_id: str
    first: int
    """The first timestep."""
    timesteps: int
    tiles: dict[str, str]
    """The run of each opaque name of a tile."""


@dataclass(frozen=True)
class StudyKey:
    """What the page does not say."""

    study: str
    """The study's opaque name."""
    seed: int
    runs: tuple[str, ...]
    """Labels of the compared runs, in the order of the tables."""
    clips: tuple[KeyClip, ...]


@dataclass(frozen=True)
class Answer:
    """The answers of a participant to one clip."""

    clip: KeyClip
    shown: tuple[str, ...]
    """The runs from left to right."""
    choices: dict[str, str]
    """The chosen run by question."""


@dataclass(frozen=True)
class Answers:
    """The answers of one participant to all clips, in the key's order."""

    participant: str
    """The participant's random number, as 8 hex digits."""
    clips: tuple[Answer, ...]


def key_path(page: Path) -> Path:
    """The key beside a page."""
    return page.with_name(f"{page.stem}.key.json")


def write_key(path: Path, key: StudyKey) -> None:
    """Write the key of a study."""
    write_json(path, _KEY, VERSION, asdict(key))


def read_key(path: Path) -> StudyKey:
    """Read the key of a study."""
    content = read_json(path, _KEY, VERSION, "`mien study make`", _KEY_REMEDY)
    own = {name: value for name, value in content.items() if name not in ("format", "version")}
    return decode(StudyKey, own, str(path), _KEY_REMEDY)


def read_answers(path: Path, key: StudyKey) -> Answers:
    """Read the answers of one participant."""
    content = _answer_json(path)
    with expect_whole(path, _AGAIN):
        study, participant = _opaque(content["study"]), _opaque(content["participant"])
        if study != key.study:
            raise UserError(
                f"{path}: answers study {study}, but the key is of study {key.study}; give the key of its page"
            )
        entries = {_opaque(entry["clip"]): entry for entry in content["answers"]}
        if len(entries) < len(content["answers"]):
            raise ValueError("it answers a clip twice")
        unknown = sorted(entries.keys() - {clip.name for clip in key.clips})
        if unknown:
            raise ValueError(f"it answers {unknown[0]}, which is no clip of the study")
        missing = len(key.clips) - len(entries)
        if missing:
            raise ValueError(f"{missing} of {len(key.clips)} clips have no answer")
        return Answers(participant, tuple(_answer(entries[clip.name], clip, key, participant) for clip in key.clips))


def read_all_answers(paths: Sequence[Path], key: StudyKey) -> list[Answers]:
    """Read answer files, and all .json files of folders, sorted by participant."""
    seen: dict[str, tuple[Path, Answers]] = {}
    for path in _answer_files(paths):
        answers = read_answers(path, key)
        if answers.participant in seen:
            other = seen[answers.participant][0]
            raise UserError(f"{path}: is of participant {answers.participant}, as {other} is; give each one once")
        seen[answers.participant] = path, answers
    return [seen[participant][1] for participant in sorted(seen)]


def _answer_files(paths: Sequence[Path]) -> list[Path]:
    found: list[Path] = []
    for path in paths:
        if not path.is_dir():
            found.append(path)
            continue
        inner = [one for one in listed(path, "*.json") if not one.name.endswith(".key.json")]
        if not inner:
            raise UserError(f"{path}: has no answer file (.json); put the participants' files there")
        found += inner
    return found


def _answer_json(path: Path) -> Mapping[str, Any]:
    try:
        content = parse_json(read_bytes(path, 1 << 20).decode("utf-8"), unique_names=True)
    except FileNotFoundError:
        raise UserError(f"{path}: no such file; give the files that participants saved") from None
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be read as json ({error}); {_AGAIN}") from None
    found = (content.get("format"), content.get("version")) if isinstance(content, dict) else (None, None)
    if found != (ANSWERS, VERSION):
        raise UserError(
            f"{path}: has format {found[0]!r:.80} version {found[1]!r:.80}, expected {ANSWERS!r} version {VERSION}; "
            "give the files that participants saved"
        )
    return content


def _answer(entry: Mapping[str, Any], clip: KeyClip, key: StudyKey, participant: str) -> Answer:
    shown = [_opaque(name) for name in entry["shown"]]
    if shown != shuffled(list(clip.tiles), key.study, participant, clip.name):
        raise ValueError(f"the order of clip {clip.name} is not that of its participant")
    choices = {question: clip.tiles[_opaque(entry[question])] for question in QUESTIONS}
    return Answer(clip, tuple(clip.tiles[name] for name in shown), choices)


def _opaque(name: object) -> str:
    if not isinstance(name, str) or re.fullmatch(r"[0-9a-f]{8,32}", name) is None:
        raise ValueError(f"{name!r:.40} is not a name of a page")
    return name


def shuffled(names: Sequence[str], study: str, participant: str, what: str) -> list[str]:
    """Opaque names of clips or tiles in this participant's order (Fisher-Yates), which is the same for any given order.

    page.html has the same function, and a test compares both. The numbers come from sfc32 (Doty-Humphrey, PractRand:
    128 bits of state, of which 32 count), which is short in both languages. Its state is a hash (FNV-1a) of the study,
    the participant and `what` (the clip's name, or `clips` for their order), so that an answer file alone tells the
    order again.
    """
    order, numbers = sorted(names), _numbers(f"{study}/{participant}/{what}")
    for last in range(len(order) - 1, 0, -1):
        other = next(numbers) * (last + 1) >> 32
        order[last], order[other] = order[other], order[last]
    return order


def _numbers(text: str) -> Iterator[int]:
    a, b, c = (_hash(f"{salt}{text}") for salt in "012")
    count = 1
    for index in range(1 << 62):
        value = (a + b + count) & _MASK
        count = (count + 1) & _MASK
        a = b ^ (b >> 9)
        b = (c + (c << 3)) & _MASK
        c = (((c << 21) | (c >> 11)) + value) & _MASK
        if index >= 15:  # until all bits of the state are mixed
            yield value


def _hash(text: str) -> int:
    value = 0x811C9DC5
    for byte in text.encode("ascii"):
        value = ((value ^ byte) * 0x01000193) & _MASK
    return value


def tally_content(key: StudyKey, answers: Sequence[Answers]) -> dict[str, Any]:
    """The percentages of every run, with intervals, as a json object. There is at least one participant."""
    return {
        "study": key.study,
        "participants": len(answers),
        "clips": len(key.clips),
        "judgements": len(answers) * len(key.clips),
        "confidence": CONFIDENCE,
        "runs": {
            run: {question: _entry(run, question, answers) for question in QUESTIONS} for run in key.runs
        },
        "positions": {question: _positions(question, answers) for question in QUESTIONS},
        "per_clip": [
            {
                "clip": clip.name,
                "workspace": clip.workspace,
                "sequence": clip.sequence,
                "camera_id": clip.camera_id,
                "timesteps": [clip.first, clip.first + clip.timesteps - 1],
                **{
                    question: {
                        run: sum(one.clips[index].choices[question] == run for one in answers) for run in key.runs
                    }
                    for question in QUESTIONS
                },
            }
            for index, clip in enumerate(key.clips)
        ],
    }  # fmt: skip


def _entry(run: str, question: str, answers: Sequence[Answers]) -> dict[str, Any]:
    chosen = np.array([[one.choices[question] == run for one in each.clips] for each in answers])
    low, high = interval(chosen.mean(1), chosen.shape[1])
    return {
        "chosen": int(chosen.sum()),
        "percent": round(100 * float(chosen.mean()), 2),
        "low": round(100 * low, 2),
        "high": round(100 * high, 2),
    }


def _positions(question: str, answers: Sequence[Answers]) -> dict[str, float]:
    """How often each place from left to right was chosen, in percent. Equal shares mean that order did not matter."""
    places = [one.shown.index(one.choices[question]) for each in answers for one in each.clips]
    count = len(answers[0].clips[0].shown)
    return {"ABCDEFGH"[place]: round(100 * places.count(place) / len(places), 2) for place in range(count)}


def interval(shares: Float[np.ndarray, " p"], clips: int) -> tuple[float, float]:
    """The confidence interval of a share, from the shares of the participants, who all judged `clips` clips.

    The variance of the mean share over participants gives the effective number of judgements, from the number of
    participants to that of all judgements, times (z / t)^2 for the few participants. If there is only one participant,
    or the share is 0 or 1, the variance cannot be estimated, and each participant counts as one judgement.
    """
    people, share = len(shares), float(np.mean(shares))
    z = NormalDist().inv_cdf(0.5 + CONFIDENCE / 2)
    effective = float(people)
    if people > 1 and 0 < share < 1:
        variance = float(np.var(shares, ddof=1)) / people
        whole = people * clips
        independent = whole if variance == 0 else share * (1 - share) / variance
        effective = min(max(independent, people), whole) * (z / student_quantile(people - 1)) ** 2
    return wilson(share, effective, z)


def wilson(share: float, count: float, z: float) -> tuple[float, float]:
    """Wilson's interval (1927) of a share of `count` independent judgements, within 0..1."""
    middle = share + z * z / (2 * count)
    reach = z * math.sqrt(share * (1 - share) / count + z * z / (4 * count * count))
    scale = 1 + z * z / count
    return max(0.0, (middle - reach) / scale), min(1.0, (middle + reach) / scale)


def student_quantile(degrees: int) -> float:
    """The two-sided quantile of Student's t for `CONFIDENCE`, by the series of Abramowitz and Stegun (26.7.5).

    It is 1 % too small for 2 degrees of freedom, and far closer for more. For 1 degree it is exact.
    """
    if degrees == 1:
        return math.tan(math.pi * CONFIDENCE / 2)
    z = NormalDist().inv_cdf(0.5 + CONFIDENCE / 2)
    terms = (
        (z**3 + z) / 4,
        (5 * z**5 + 16 * z**3 + 3 * z) / 96,
        (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384,
        (79 * z**9 + 776 * z**7 + 1482 * z**5 - 1920 * z**3 - 945 * z) / 92160,
    )
    return z + sum(term / degrees ** (power + 1) for power, term in enumerate(terms))


def tally_text(content: dict[str, Any]) -> str:
    """The percentages as a table in markdown, with what a reader has to know."""
    heads = ["Run", *(name.capitalize() for name in QUESTIONS.values())]
    cells = [
        (run, *(f"{one['percent']:.1f} % ({one['low']:.1f} to {one['high']:.1f})" for one in entries.values()))
        for run, entries in content["runs"].items()
    ]
    lines = [
        markdown(heads, cells),
        f"{content['participants']} participants, {content['clips']} clips, {content['judgements']} judgements of each "
        f"question. In brackets: {100 * content['confidence']:.0f} % confidence interval over participants. "
        f"Chance is {100 / len(content['runs']):.1f} %.",
    ]
    for question, name in QUESTIONS.items():
        places = ", ".join(f"{place} {share:.0f} %" for place, share in content["positions"][question].items())
        lines.append(f"Chosen by place from left to right, {name}: {places}.")
    return "\n".join(lines)
