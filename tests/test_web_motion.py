"""Recordings and a voice move a page's avatar as they move it in Python, and its signs of life are calm."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mien import runtime
from mien.cli import main
from mien.driving import drive
from mien.driving.blendshape_json import read_blendshape_json
from mien.driving.live_link_face import read_live_link_face
from mien.driving.motion import PAIRS
from mien.driving.rest import rest_of
from mien.driving.speech import SPEECH_BAND_WEIGHTS, SPEECH_BANDS, SPEECH_LEAST_SHARE
from mien.driving.transfer import face_of_motion
from mien.face import FaceParams, load_face_model
from mien.formats.page import write_page
from mien.media.video import RATE
from recordings import COLUMNS, LAYOUTS, row, write_csv, write_json
from test_driving_by_speech import synthesised, tone, write_wav
from test_web_webcam import ALLOWED, FAKE
from web_case import WEB, browse, bundle, drawn_head, run_node

EQUAL = 1e-4
COUNT = 150_000


def read_by_node(built: Path, folder: Path, recording: Path) -> dict[str, Any]:
    avatar = folder / "head.mien"
    if not avatar.exists():
        runtime.write_portable(avatar, drawn_head(10))
    return run_node("motion.mjs", built / "mien.js", built / "motion.js", avatar, recording)


def driven_by_python(recording: Path) -> tuple[float, FaceParams]:
    portable, model = drawn_head(10), load_face_model("anny")
    motion = (read_live_link_face if recording.suffix == ".csv" else read_blendshape_json)(recording)
    face, rest = face_of_motion(motion, model)
    names = ("expression", "joints", "head_rotation", "head_translation")
    near = (torch.from_numpy(getattr(portable.neutral, name))[None] for name in names)
    neutral = FaceParams(model.neutral().identity, *near)
    return motion.fps, drive(face, rest_of(rest, model).face, neutral, model.expression_bounds)


def plain_recording(folder: Path) -> Path:
    frames: list[dict[str, Any]] = [
        {"timestamp_ms": 40 * at, "blendshapes": {"jawOpen": at / 9, "mouthSmileLeft": 0.3}} for at in range(5)
    ]
    frames[2]["blendshapes"] = None
    return write_json(folder / "plain.json", frames)


def turned_rows() -> list[list[str]]:
    turns = np.random.default_rng(0).uniform(-0.3, 0.3, (6, 3))
    return [
        row(f"0:00:00:{2 * at:02d}.0", JawOpen=at / 8, EyeBlinkLeft=0.5, EyeLookOutLeft=0.4, EyeLookInRight=0.4,
            EyeLookUpLeft=0.2, HeadYaw=yaw, HeadPitch=pitch, HeadRoll=roll)
        for at, (yaw, pitch, roll) in enumerate(turns)
    ]  # fmt: skip


def expect_as_in_python(built: Path, folder: Path, recording: Path, notes: int = 0) -> None:
    found = read_by_node(built, folder, recording)
    assert len(found["notes"]) == notes, found
    fps, face = driven_by_python(recording)
    assert found["fps"] == pytest.approx(fps, rel=1e-6)
    for name in ("expression", "joints", "head_rotation"):
        expected = getattr(face, name).numpy().reshape(-1)
        np.testing.assert_allclose(found[name], expected, rtol=0, atol=EQUAL, err_msg=f"{recording.name}: {name}")


def test_every_layout_and_odd_recordings_are_read_as_in_python(built: Path, tmp_path: Path) -> None:
    names = [name for pair in PAIRS for name in pair]
    for write in (write for writers in LAYOUTS.values() for write in writers):
        recording = write(tmp_path, [{}, *({name: 0.5} for name in names), {"jawOpen": 0.5}])
        expect_as_in_python(built, tmp_path, recording)
    # Midnight, repeats, gaps, faces that are lost at first, decimal commas, transposed matrices, turns and gaze.
    codes = ("23:59:59:56", "23:59:59:58", "23:59:59:58", "0:00:00:00", "0:00:00:06", "0:00:00:08")
    rows = [row(code, JawOpen=index / 8, MouthLeft=0.5, HeadYaw=0.1 * index) for index, code in enumerate(codes)]
    keep = [index for index, name in enumerate(COLUMNS) if name != "TongueOut"]
    lines = [";".join(cells[index].replace(".", ",") for index in keep) for cells in (COLUMNS, *rows)]
    table = "\n".join(["sep=;", lines[0], "23:59:59:54;0", *lines[1:]])
    (tmp_path / "take.csv").write_text(table, encoding="utf-8-sig")
    expect_as_in_python(built, tmp_path, tmp_path / "take.csv", 2)
    turn = [[0.8, 0.6, 0, 0], [-0.6, 0.8, 0, 0], [0, 0, 1, 0], [1, 2, -40, 1]]
    results = [
        {
            "time": time,
            "face_blendshapes": [[{"category_name": "mouthLeft", "score": time}]],
            "facial_transformation_matrixes": [turn if time else np.eye(4).tolist()],
        }
        for time in (0.0, 0.1, 0.2, 0.5, 0.5)
    ]
    expect_as_in_python(built, tmp_path, write_json(tmp_path / "task.json", results), 2)
    expect_as_in_python(built, tmp_path, write_csv(tmp_path / "turned.csv", *turned_rows()))
    slow = write_csv(tmp_path / "slow.csv", *(row(f"0:00:0{second}:00.0", JawOpen=0.5) for second in range(4)))
    expect_as_in_python(built, tmp_path, slow, 1)


def test_long_tables_are_read_as_in_python_and_what_is_no_recording_is_said(built: Path, tmp_path: Path) -> None:
    """A long list of rows is not spread into the arguments of a call, of which engines take some 100,000."""
    times = ((at // 108000, at // 1800 % 60, at // 30 % 60, at % 30) for at in range(COUNT))
    rows = [f"{hour}:{minute:02d}:{second:02d}:{frame:02d},61,0.5" for hour, minute, second, frame in times]
    (tmp_path / "long.csv").write_text(CSV + "\n".join(rows))
    found = read_by_node(built, tmp_path, tmp_path / "long.csv")
    assert "error" not in found
    assert (found["moments"], found["fps"]) == (COUNT, pytest.approx(30))
    for name, content, message in BROKEN:
        (tmp_path / name).write_text(content)
        assert read_by_node(built, tmp_path, tmp_path / name)["error"] == message


def frames(count: int = 1, **parts: Any) -> str:
    """Return json of frames with these parts. What is callable depends on the frame."""
    plain = {"blendshapes": {"jawOpen": 0}} | parts
    return json.dumps([{k: v(i) if callable(v) else v for k, v in plain.items()} for i in range(count)])


CSV = "Timecode,BlendshapeCount,JawOpen\n"
BROKEN = [
    ("a.csv", "hello", "is no csv of Live Link Face"),
    ("a.csv", CSV + "0:0:0:1,61,wide\n", "has wide for jawopen in line 2"),
    ("a.csv", CSV + "0:0:0:5,61,0\n0:0:0:4,61,0\n", "has times that do not increase"),
    ("a.csv", "Timecode,JawOpen\n1:0:0:5,0\n1:2:0:5,0\n", "has a gap of more than 60 s"),
    ("a.csv", "time,jawOpen,HeadYaw\n0,0.1,2.9\n",
     "has 2.9 for headyaw in line 2; angles are in radians, so divide degrees by 57.3"),
    ("a.csv", "time,jawOpen,HeadYaw\n0,0,0\n0.04,0,0.1\n0.08,0,1.2\n",
     "has 1.2 for headyaw right after 0.1; angles are in radians, so divide degrees by 57.3"),
    ("a.json", "[{", "is no json"),
    ("a.json", frames(3, timestamp_ms=lambda i: i / 30),
     'has 30000 frames in a second; give milliseconds, or call seconds "time"'),
    ("a.json", frames(3, time=lambda i: 33 * i),
     'has frames of 33 s; give seconds, or call milliseconds "timestamp_ms"'),
    ("a.json", json.dumps([{"face_blendshapes": [[]], "facial_transformation_matrixes": [[[1] * 4] * 4]}]),
     "has a matrix whose last row is not 0 0 0 1 in frame 0"),
    ("a.json", frames(blendshapes={"smile": 1}), "has none of this avatar's expressions"),
]  # fmt: skip


def test_signs_of_life_are_calm(built: Path, tmp_path: Path) -> None:
    found = read_by_node(built, tmp_path, plain_recording(tmp_path))
    blinks = np.array(found["blinks"])
    assert 10 <= (np.diff((blinks > 0).astype(int)) == 1).sum() <= 30
    assert (blinks > 0).mean() < 0.12
    assert min(blinks) == 0 < 0.9 < max(blinks)
    assert 0.01 < np.linalg.norm(found["sways"], axis=1).max() < np.radians(4)


DROP = """(async () => {
  const viewer = await mien, given = new DataTransfer(), before = viewer.motion;
  document.getElementById("message").textContent = "";
  given.items.add(new File([%s], "take.%s"));
  document.dispatchEvent(new DragEvent("drop", { dataTransfer: given, bubbles: true }));
  for (let i = 0; i < 100 && viewer.motion === before && !document.getElementById("message").textContent; ++i)
    await new Promise((done) => setTimeout(done, 50));
  viewer.play(false);
  if (viewer.motion) viewer.seek(3);
  const row = document.getElementById("motion");
  return [document.getElementById("message").textContent, row.hidden, Array.from(viewer.face.expression)];
})()"""


def test_a_page_plays_dropped_recordings(tmp_path: Path) -> None:
    write_page(tmp_path / "a.html", drawn_head(500))
    table, plain = write_csv(tmp_path / "take.csv", *turned_rows()), plain_recording(tmp_path)
    drops = (("hello", "csv"), (table.read_text(), "csv"), (plain.read_text(), "json"))
    scripts = [DROP % (json.dumps(content), ending) for content, ending in drops]
    told = browse(tmp_path / "a.html", scripts, size=(500, 300))
    assert (told["requests"], told["messages"]) == ([], [])
    refused, first, second = told["results"]
    words = "take.csv is no csv of Live Link Face. Give a csv of Live Link Face, or blend shapes as json."
    assert refused[:2] == [words, True]
    for recording, (message, hidden, expression) in ((table, first), (plain, second)):
        assert (message, hidden) == ("", False)
        np.testing.assert_allclose(expression, driven_by_python(recording)[1].expression[3], atol=EQUAL)


WINDOW = (320, 240)
FPS = 60
HEAR = """(async () => {
  const viewer = await mien, ear = await microphone, button = document.getElementById("microphone"), log = [];
  const jaw = viewer.avatar.expression_names.indexOf("jawOpen"), rest = viewer.avatar.neutral.expression[jaw];
  const wait = (seconds) => new Promise((done) => setTimeout(done, 1000 * seconds));
  ear.onMouth = (mouth) => log.push([mouth.jawOpen, viewer.shown.expression[jaw] - rest]);
  button.click();
  while (!ear.on) await wait(0.02);
  const told = document.getElementById("microphone-state").textContent;
  // Until the mouth has opened and shut three times, however slow the machine is.
  const times = () => log.filter(([open], k) => k && open > 0.15 && log[k - 1][0] <= 0.15).length;
  for (let i = 0; i < 400 && !(times() > 2 && log.at(-1)[0] < 0.03); ++i) await wait(0.2);
  const pressed = button.getAttribute("aria-pressed"), tracks = ear.stream.getTracks();
  button.click();
  await wait(0.3);
  return { log, told, pressed: [pressed, button.getAttribute("aria-pressed")],
    left: viewer.shown.expression[jaw] - rest,
    ended: tracks.every((track) => track.readyState === "ended") };
})()"""


@pytest.fixture
def page(tmp_path: Path) -> Path:
    runtime.write_portable(tmp_path / "me.mien", drawn_head(150))
    assert main(["export", str(tmp_path / "me.mien"), "--out", str(tmp_path / "me.html"), "--microphone"]) == 0
    return tmp_path / "me.html"


def mouths(voice: Path, sound: np.ndarray) -> list[dict[str, float]]:
    """Return the mouths of sound with `RATE` samples a second, as the page makes them at 60 pictures a second."""
    size = round(2048 / 48_000 * RATE)
    frequencies, window, heard = np.fft.rfftfreq(size, 1 / RATE), np.blackman(size), []
    padded = np.pad(sound.astype(np.float64), (size, 0))
    for index in range(int(len(sound) / RATE * FPS)):
        piece = padded[round(index / FPS * RATE) :][:size]
        piece = piece - piece.mean()
        power = np.abs(np.fft.rfft(piece * window)) ** 2
        bands = ((0, 700), (2500.1, np.inf), *SPEECH_BANDS)
        parts = (power[(least <= frequencies) & (frequencies < most)].sum() for least, most in bands)
        low, high, *vowel = (part / max(power.sum(), 1e-20) for part in parts)
        vowel = 10 * np.dot(np.log10(np.maximum(vowel, SPEECH_LEAST_SHARE)), SPEECH_BAND_WEIGHTS)
        loudness = 10 * np.log10(max(float((piece**2).mean()), 1e-12))
        heard.append([loudness, float(vowel), float(low), float(high), index / FPS])
    return run_node("voice.mjs", voice, heard)


@pytest.fixture(scope="module")
def voice(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("voice") / "voice.js"
    bundle(WEB / "src" / "voice.ts", path)
    return path


@pytest.mark.parametrize(("seed", "even"), [(0, False), (2, True)])
def test_lips_shut_at_p_b_and_m_and_the_jaw_opens_with_the_vowels(voice: Path, seed: int, even: bool) -> None:
    """As those of `mien drive --by voice.wav`, without knowing what comes next. A second of noise comes before."""
    sound, jaw, shut = synthesised(seed, 24, even)
    noise = 1e-4 * np.random.default_rng(0).standard_normal(RATE).astype(np.float32)
    found = mouths(voice, np.concatenate([noise, sound]))
    opened = np.array([mouth["jawOpen"] for mouth in found])
    late = round(0.03 * FPS)
    at = (np.arange(len(found) - late) / FPS * RATE).astype(int)
    assert np.corrcoef(opened[late:], np.concatenate([np.zeros(RATE), jaw])[at])[0, 1] >= 0.8
    edges = np.flatnonzero(np.diff(shut.astype(int), prepend=0, append=0)) / RATE * FPS + FPS
    closures = [slice(int(begin), int(end) + 3) for begin, end in edges.reshape(-1, 2)]
    assert np.mean([opened[one].min() < 0.06 for one in closures]) >= 0.8
    assert opened[: FPS - late].max() < 0.05, "noise opens no mouth"
    press = np.array([mouth["mouthPressLeft"] for mouth in found])
    assert max(press[one].max() for one in closures) > 0.2


def test_low_sounds_round_the_lips_and_high_ones_stretch_them(voice: Path) -> None:
    low, high = (mouths(voice, tone(frequency)[0]) for frequency in (200.0, 5000.0))
    most = [{name: max(mouth[name] for mouth in found) for name in found[0]} for found in (low, high)]
    assert most[0]["mouthFunnel"] > 0.2 > 0.05 > most[1]["mouthFunnel"]
    assert most[1]["mouthStretchLeft"] > 0.2 > 0.05 > most[0]["mouthStretchLeft"]
    assert most[1]["jawOpen"] < 0.6 * most[0]["jawOpen"]


def test_a_voice_drives_the_page(page: Path, tmp_path: Path) -> None:
    """The fake device plays a voice of six seconds, a second of silence first, again and again."""
    sound = write_wav(tmp_path / "voice.wav", tone(300.0)[0])
    told = browse(page, [HEAR], WINDOW, flags=[FAKE, ALLOWED, f"--use-file-for-fake-audio-capture={sound}"])
    assert (told["requests"], told["messages"]) == ([], [])
    (result,) = told["results"]
    heard, shown = np.array(result["log"]).T
    assert (result["pressed"], result["ended"]) == (["true", "false"], True)
    assert result["told"].startswith("Speak: the lips follow your voice.")
    assert "form-action 'none'; base-uri 'none'" in page.read_text()
    assert result["left"] == pytest.approx(0, abs=1e-6)
    assert heard.max() > 0.35 > 0.03 > heard[-1]
    # A moment is heard before the picture that shows it.
    assert np.corrcoef(heard[:-1], shown[1:])[0, 1] > 0.95, "the avatar's jaw is that of the voice"
