"""From answers to percentages with confidence intervals, as in Table 3 of MonoGaussianAvatar. Needs no torch.

A judgement is one participant's choice of the best run in one clip. The judgements of a participant resemble each
other, so that 15 people with 10 clips each say less than 150 people with one clip. The interval is therefore Wilson's
(1927) for an effective number of judgements (Korn and Graubard 1998): the number of independent ones that would vary
as much as the participants' own percentages do.
"""

import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import Any

import numpy as np
from jaxtyping import Float

from mien.lab.analysis.study.files import QUESTIONS, Answers, StudyKey
from mien.lab.benchmarking.comparing import markdown

CONFIDENCE = 0.95
"""Share of the intervals that hold the true percentage, over many studies."""
FORMAT, VERSION = "mien.study_tally", 1


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
