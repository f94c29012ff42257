"""The tally of `mien study`: percentages of judgements, and their intervals."""

import numpy as np
import pytest

from mien.lab.analysis.study import files


def test_few_participants_have_wider_intervals_by_student_s_factor() -> None:
    """Three people, 12.5 judgements' worth of evidence: (1.96 / 4.30)^2 of it counts, which leaves 2.6."""
    shares = np.array([0.4, 0.5, 0.75])
    share, variance = float(shares.mean()), float(np.var(shares, ddof=1)) / 3
    evidence = share * (1 - share) / variance
    assert 3 < evidence < 30
    z = 1.959964
    wanted = files.wilson(share, evidence * (z / 4.3027) ** 2, z)
    assert files.interval(shares, 10) == pytest.approx(wanted, abs=0.005)
    assert wanted[1] - wanted[0] > 1.5 * np.ptp(files.wilson(share, evidence, z)), "what the factor is about"
    low, high = files.interval(np.zeros(15), 10)
    assert low == 0
    assert 0.15 < high < 0.25  # 15 people, not 150
    assert files.interval(np.ones(15), 10)[1] == pytest.approx(1)
    alone, same = files.interval(np.array([0.5]), 10), files.interval(np.full(20, 0.5), 10)
    assert alone[0] < 0.1 < 0.4 < same[0] < 0.5 < same[1] < 0.6 < 0.9 < alone[1]
    assert files.student_quantile(1) == pytest.approx(12.706, rel=1e-3)
    assert files.student_quantile(2) == pytest.approx(4.303, rel=0.012)
    assert files.student_quantile(14) == pytest.approx(2.145, rel=1e-3)


def table_3() -> tuple[files.StudyKey, list[files.Answers]]:
    """Return answers with the counts of the paper's table: 15 participants, 10 clips, 4 methods."""
    runs = ("nerface", "imavatar", "pointavatar", "ours")
    counts = {"quality": (19, 0, 13, 118), "expression": (35, 0, 12, 103)}
    tiles = {f"{index:012x}": run for index, run in enumerate(runs)}
    clips = tuple(files.KeyClip(f"c{index:07x}", "w", "s", "0", 0, 9, tiles) for index in range(10))
    picks = {question: np.repeat(runs, each).reshape(15, 10) for question, each in counts.items()}
    answers = [
        files.Answers(
            f"{i:08x}", tuple(files.Answer(clips[j], runs, {q: str(picks[q][i, j]) for q in picks}) for j in range(10))
        )
        for i in range(15)
    ]
    return files.StudyKey("0123456789ab", 0, runs, clips), answers


def test_the_tally_gives_the_paper_s_percentages() -> None:
    content = files.tally_content(*table_3())
    percents = {
        run: [entry[question]["percent"] for question in files.QUESTIONS] for run, entry in content["runs"].items()
    }
    assert percents == {
        "nerface": [12.67, 23.33], "imavatar": [0.0, 0.0], "pointavatar": [8.67, 8.0], "ours": [78.67, 68.67]
    }  # fmt: skip
    assert (content["judgements"], files.StudySettings().clips) == (150, 10)
    assert list(files.QUESTIONS.values()) == ["visual quality", "expression accuracy"]
    for entry in content["runs"].values():
        for figures in entry.values():
            assert 0 <= figures["low"] <= figures["percent"] <= figures["high"] <= 100
    text = files.tally_text(content)
    assert "| ours | 78.7 % (" in text
    assert "Chance is 25.0 %" in text
