"""`mien study`: a page shows runs blind and in random order, saves answers, and the tally counts them."""

import base64
import json
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import train_toy
from known import known
from mien.avatar.methods import METHODS
from mien.cli import main
from mien.lab.analysis.study.files import QUESTIONS, read_all_answers, read_key, shuffled
from mien.lab.analysis.study.making import encode, spans
from mien.media.video import read_video_frames
from mien.training import read_sequence, train
from refusals import complaint, refuses
from shared_things import write_toy_workspace
from toy_scene import toy_face_model
from web_case import browse, expect_usable, picture

pytestmark = [pytest.mark.unchecked, pytest.mark.usefixtures("short_films")]
RUNS = ("headgas", "begun", "toy")
SIDE = 64


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a workspace with three runs that look different, and 6 held-out timesteps at the end."""
    root = tmp_path_factory.mktemp("studied") / "somebody"
    write_toy_workspace(root, 30)
    sequence = read_sequence(root / "sequences" / "clip")
    short = replace(train_toy.SETTINGS, split="tail", steps=2)
    train([sequence], toy_face_model(), train_toy.CONFIG, short, root / "runs" / "begun")
    train([sequence], toy_face_model(), METHODS["headgas"].config(), short, root / "runs" / "headgas")
    return root


def make(workspace: Path, page: Path, *more: str) -> int:
    options = ["--side", str(SIDE), "--seconds", "0.12", "--clips", "2", "--megabytes", "1", *more]
    return main(["study", "make", str(workspace), "--out", str(page), "--runs", *RUNS, *options])


@pytest.fixture(scope="module")
def page(workspace: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    page = tmp_path_factory.mktemp("page") / "study.html"
    assert make(workspace, page) == 0
    return page


def content_of(page: Path) -> dict[str, Any]:
    found = known(re.search(r'<script type="application/json" id="study">(.*?)</script>', page.read_text()))
    return json.loads(found[1])


def answered(page: Path, participant: str, choose: dict[str, str]) -> dict[str, Any]:
    """Return the answer file of a participant who chooses one run for each question, as the page writes it."""
    study, key = content_of(page), read_key(page.with_name("study.key.json"))
    answers = []
    for clip in key.clips:
        names = {run: tile for tile, run in clip.tiles.items()}
        shown = shuffled(list(clip.tiles), key.study, participant, clip.name)
        picks = {question: names[run] for question, run in choose.items()}
        answers.append({"clip": clip.name, "shown": shown, "seconds": 1.5, **picks})
    named = {"format": study["format"], "version": study["version"], "study": study["study"]}
    return {**named, "participant": participant, "answers": answers}


def test_the_page_says_nothing_about_the_runs(page: Path, workspace: Path, tmp_path: Path) -> None:
    text, key = page.read_text(), read_key(page.with_name("study.key.json"))
    assert key.runs == RUNS
    for word in (*RUNS, *METHODS, "somebody", str(workspace), '"seed"'):
        assert word not in re.sub(r'"video":"[^"]*"', "", text), word
    for entry in content_of(page)["clips"]:
        video = base64.b64decode(entry["video"])
        assert not [word for word in (*RUNS, "somebody", "mien") if word.encode() in video]
        assert entry["tiles"] == sorted(entry["tiles"])
    policy = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; media-src blob:"
    assert policy in text
    assert not re.search("https?://", text)
    assert make(workspace, tmp_path / "study.html") == 0
    for name in ("study.html", "study.key.json"):
        assert (tmp_path / name).read_bytes() == page.with_name(name).read_bytes()
    assert make(workspace, tmp_path / "other.html", "--seed", "1") == 0
    other = read_key(tmp_path / "other.key.json")
    assert key.study != other.study
    assert not {tile for clip in key.clips for tile in clip.tiles} & {t for clip in other.clips for t in clip.tiles}


def test_the_key_says_which_tile_shows_which_run(page: Path, workspace: Path, tmp_path: Path) -> None:
    """Each tile of the videos is nearest to the picture of its run that `mien evaluate --pictures` writes."""
    for run in RUNS:
        assert main(["evaluate", str(workspace), "--run", run, "--pictures", "--no-perceptual"]) == 0
    pictures, key = workspace / "runs", read_key(page.with_name("study.key.json"))
    for clip in key.clips:
        frames = frames_of(page, clip.name, tmp_path)
        assert len(frames) == clip.timesteps
        tiles = np.split(frames[0], 1 + len(RUNS), axis=1)
        name = f"clip_front_{clip.first:06d}.png"
        drawn = {run: pictures / run / "pictures/self_reenactment_tail/rendering" / name for run in RUNS}
        drawn["truth"] = pictures / "toy" / "pictures/self_reenactment_tail/truth" / name
        truth = {run: head_square(path) for run, path in drawn.items()}
        for tile, run in zip(tiles, ["truth", *clip.tiles.values()], strict=True):
            errors = {other: float(np.abs(tile - picture).mean()) for other, picture in truth.items()}
            assert min(errors, key=errors.__getitem__) == run, errors


def frames_of(page: Path, clip: str, folder: Path) -> np.ndarray:
    (video,) = (entry["video"] for entry in content_of(page)["clips"] if entry["clip"] == clip)
    (folder / "clip.mp4").write_bytes(base64.b64decode(video))
    return np.stack([picture for _, picture in read_video_frames(folder / "clip.mp4")]).astype(np.float64)


def head_square(path: Path) -> np.ndarray:
    """Return the square around the toy's head box, with its margin of 1 pixel, as the study scales it."""
    cut = known(cv2.imread(str(path)))[3:25, 3:25, ::-1]
    return cv2.resize(np.ascontiguousarray(cut), (SIDE, SIDE), interpolation=cv2.INTER_CUBIC).astype(np.float64)


def test_the_budget_is_kept(workspace: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "study.html"
    assert make(workspace, page, "--side", "1024") == 0
    assert page.stat().st_size <= 1_000_000
    assert "of 1 MB" in capsys.readouterr().err
    noise = np.random.default_rng(0).integers(0, 255, (4, 64, 256, 3), dtype=np.uint8)
    (_, best), (small, worse) = encode(noise, 25.0, 1 << 20, "it"), encode(noise, 25.0, 30_000, "it")
    assert best < worse
    assert len(small) <= 30_000
    refuses("it: does not fit into the page even at the lowest quality", encode, noise, 25.0, 1_000, "it")


def test_spans_are_cut_into_equal_parts_and_ordered_by_chance() -> None:
    assert spans([3, 4, 5, 9, 20, 21, 22, 23, 24], 3) == [(3, 3), (20, 3), (23, 2)]
    assert spans(list(range(10)), 4) == [(0, 4), (4, 3), (7, 3)]
    names = (f"{participant:08x}" for participant in range(6000))
    counts = Counter(tuple(shuffled(["a", "b", "c"], "0123456789ab", name, "fedcba987654")) for name in names)
    assert len(counts) == 6
    assert sum((count - 1000) ** 2 / 1000 for count in counts.values()) < 20.5  # chi squared, 5 degrees, 0.1 %
    assert shuffled(["c", "a", "b"], "s", "0", "x") == shuffled(["a", "b", "c"], "s", "0", "x")


def test_answers_become_percentages(page: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    key, out = str(page.with_name("study.key.json")), tmp_path / "sums" / "tally.json"
    for number in range(4):
        picks = {"quality": "toy" if number else "begun", "expression": "headgas"}
        (tmp_path / f"{number}.json").write_text(json.dumps(answered(page, f"{number:08x}", picks)))
    assert main(["study", "tally", key, str(tmp_path), "--out", str(out), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown == {name: value for name, value in json.loads(out.read_text()).items() if name != "checksum"}
    assert shown["participants"] == 4
    percents = {run: [figures[question]["percent"] for question in QUESTIONS] for run, figures in shown["runs"].items()}
    assert percents == {"toy": [75, 0], "begun": [25, 0], "headgas": [0, 100]}
    assert [one["quality"] for one in shown["per_clip"]] == [{"headgas": 0, "begun": 1, "toy": 3}] * 2
    assert sum(shown["positions"]["quality"].values()) == pytest.approx(100, abs=0.1)
    assert main(["study", "tally", key, *(str(tmp_path / f"{number}.json") for number in range(4))]) == 0
    assert "| toy | 75.0 % (" in capsys.readouterr().out


def damages(good: dict[str, Any]) -> dict[str, tuple[str, str]]:
    first, rest = good["answers"][0], good["answers"][1:]

    def changed(**parts: Any) -> str:
        return json.dumps({**good, **parts})

    def with_first(**parts: Any) -> str:
        return changed(answers=[{**first, **parts}, *rest])

    missing = {name: value for name, value in first.items() if name != "quality"}
    return {
        "cut": (json.dumps(good)[:-20], "cannot be read as json"),
        "newer": (changed(version=2), "version 2"),
        "study": (changed(study="0" * 12), "answers study 000000000000, but the key is of study"),
        "one": (changed(answers=rest), "1 of 2 clips have no answer"),
        "twice": (changed(answers=[first, first, *rest]), "answers a clip twice"),
        "unknown": (with_first(clip="0" * 12), "no clip of the study"),
        "choice": (with_first(quality="0" * 12), "incomplete or damaged"),
        "unanswered": (changed(answers=[missing, *rest]), "incomplete or damaged"),
        "order": (with_first(shown=first["shown"][::-1]), "is not that of its participant"),
        "participant": (changed(participant="00000009"), "is not that of its participant"),
        "type": (with_first(shown=7), "incomplete or damaged"),
        "name": (changed(participant="<b>"), "is not a name of a page"),
    }


def test_bad_answers_are_told_in_one_line(page: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    key, bad, gone = page.with_name("study.key.json"), tmp_path / "bad.json", tmp_path / "gone.json"
    good = answered(page, "00000001", {"quality": "toy", "expression": "toy"})
    (tmp_path / "good.json").write_text(json.dumps(good))
    for text, told in damages(good).values():
        bad.write_text(text)
        assert told in complaint(capsys, "study", "tally", key, tmp_path / "good.json", bad)
    bad.write_text(json.dumps(good))
    for key_file, answers, told in (
        (key, tmp_path, "is of participant 00000001"), (key, gone, "gone.json: no such file"),
        (gone, tmp_path, "no such file; give the key"), (tmp_path / "good.json", tmp_path, "expected 'mien.study_key'"),
        (key, page.parent, "has no answer file"),
    ):  # fmt: skip
        assert told in complaint(capsys, "study", "tally", key_file, answers)


def test_bad_options_are_told_in_one_line(workspace: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "a.html"
    for told, *words in (
        ("give a file that ends in .html", "--out", tmp_path / "a.mp4"),
        ("a study compares 2 to 8 runs, here toy", "--runs", "toy"),
        ("no run 'nobody'", "--runs", "toy", "nobody"),
        ("--side 100: give a multiple of 16, for example 96", "--side", "100"),
        ("--megabytes nan", "--megabytes", "nan"),
        ("--seconds 0: give a number from 0.1 to 60", "--seconds", "0"),
    ):
        assert told in complaint(capsys, "study", "make", workspace, "--out", page, *words)
    assert "is given twice" in complaint(capsys, "study", "make", workspace, workspace, "--out", page)
    assert "no such folder" in complaint(capsys, "study", "make", tmp_path / "gone", "--out", page)
    assert not page.exists()


START = 'document.getElementById("start").click()'
LOOK = """(async () => {
  const began = performance.now(), blank = document.createElement("canvas");
  const canvases = [...document.querySelectorAll("canvas")];
  blank.width = blank.height = canvases[0].width;
  const drawn = (canvas) => canvas.toDataURL() !== blank.toDataURL();
  while (!canvases.every(drawn) && performance.now() - began < 20000) await new Promise((done) => setTimeout(done, 30));
  for (const id of ["pause", "again", "pause"]) document.getElementById(id).click();
  await new Promise((done) => setTimeout(done, 300));
  const radios = [...document.querySelectorAll("input[name=quality]")].map((input) => input.value);
  return [radios, canvases.map((canvas) => canvas.toDataURL()), document.getElementById("next").disabled];
})()"""
ANSWER = """(() => {
  const wanted = %s;
  for (const [question, tiles] of Object.entries(wanted)) {
    const input = [...document.querySelectorAll(`input[name=${question}]`)].find((one) => tiles.includes(one.value));
    input.click();
  }
  const next = document.getElementById("next"), ready = !next.disabled;
  next.click();
  return ready;
})()"""
SAVE = """(async () => {
  document.getElementById("save").click();
  await new Promise((done) => setTimeout(done, 500));
  return document.getElementById("participant").textContent;
})()"""


def test_a_participant_answers_in_a_browser_under_a_name_of_their_own(page: Path, tmp_path: Path, capsys) -> None:
    key = read_key(page.with_name("study.key.json"))
    toy, begun = (
        [tile for clip in key.clips for tile in clip.tiles if clip.tiles[tile] == run] for run in ("toy", "begun")
    )
    answer = ANSWER % json.dumps({"quality": toy, "expression": begun})
    scripts = [START, LOOK, answer, LOOK, answer, SAVE]
    told = browse(page, scripts, (1200, 800), downloads=tmp_path, fragment="participant=0000002a")
    assert told["messages"] == []
    assert not [url for url in told["requests"] if not url.startswith("blob:")]
    _, first, ready, second, also, participant = told["results"]
    assert (ready, also, participant) == (True, True, "0000002a")
    tiles = {clip.name: list(clip.tiles) for clip in key.clips}
    order = shuffled(list(tiles), key.study, participant, "clips")
    for name, (radios, pictures, disabled) in zip(order, (first, second), strict=True):
        assert disabled
        assert radios == shuffled(tiles[name], key.study, participant, name)
        videos = np.split(frames_of(page, name, tmp_path), 1 + len(RUNS), axis=2)
        own = dict(zip(["truth", *tiles[name]], videos, strict=True))
        for tile, address in zip(["truth", *radios], pictures, strict=True):
            shown = 255 * picture(address)[..., :3]
            errors = {other: np.abs(frames - shown).mean((1, 2, 3)).min() for other, frames in own.items()}
            assert min(errors, key=errors.__getitem__) == tile, errors
            assert errors[tile] < 4
    saved = tmp_path / f"answers-{key.study}-0000002a.json"
    assert read_all_answers([saved], key)[0].participant == "0000002a"
    assert main(["study", "tally", str(page.with_name("study.key.json")), str(saved), "--json"]) == 0
    runs = json.loads(capsys.readouterr().out)["runs"]
    assert (runs["toy"]["quality"]["percent"], runs["begun"]["expression"]["percent"]) == (100, 100)
    expect_usable(page, "", f"{START};")
    name = 'document.getElementById("participant").textContent'
    first, other = (browse(page, [START, name])["results"][1] for _ in range(2))
    assert first != other
