"""A microphone in the exported page: the lips follow a voice in front of Chromium's fake device, and nothing leaves."""

from pathlib import Path

import numpy as np
import pytest

from mien.capture.sound import RATE
from mien.cli import main
from mien.driving.constants import DRIVING
from mien.export import write_page
from mien.runtime import write_portable
from test_driving_by_speech import synthesised, tone, write_wav
from test_web_webcam import ALLOWED, FAKE, TRY_TO_SEND
from web_case import WEB, browse, bundle, drawn_head, run_node

WINDOW = (320, 240)
FPS = 60
BANDS = DRIVING.speech_bands
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
  const pressed = button.getAttribute("aria-pressed");
  const tracks = ear.stream.getTracks();
  button.click();
  await wait(0.3);
  return { log, told, pressed: [pressed, button.getAttribute("aria-pressed")],
    left: viewer.shown.expression[jaw] - rest,
    ended: tracks.every((track) => track.readyState === "ended") };
})()"""
PRESS = """(async () => {
  await microphone;
  %s
  const [told, button] = ["microphone-state", "microphone"].map((id) => document.getElementById(id));
  told.textContent = "";
  button.click();
  for (let i = 0; i < 500 && !told.textContent; ++i) await new Promise((done) => setTimeout(done, 20));
  return [told.textContent, told.getAttribute("role"), button.getAttribute("aria-pressed")];
})()"""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "me.html"
    write_page(path, drawn_head(150), microphone=True)
    return path


def mouths(voice: Path, sound: np.ndarray) -> list[dict[str, float]]:
    """Return the mouths of sound with `RATE` samples a second, as the page makes them at 60 pictures a second."""
    size = round(2048 / 48_000 * RATE)
    frequencies, window, heard = np.fft.rfftfreq(size, 1 / RATE), np.blackman(size), []
    padded = np.pad(sound.astype(np.float64), (size, 0))
    for index in range(int(len(sound) / RATE * FPS)):
        piece = padded[round(index / FPS * RATE) :][:size]
        piece = piece - piece.mean()
        power = np.abs(np.fft.rfft(piece * window)) ** 2
        parts = (
            frequencies < 700,
            frequencies > 2500,
            *((low <= frequencies) & (frequencies < high) for low, high in BANDS),
        )
        low, high, *vowel = (power[chosen].sum() / max(power.sum(), 1e-20) for chosen in parts)
        vowel = 10 * np.dot(np.log10(np.maximum(vowel, DRIVING.speech_least_share)), DRIVING.speech_band_weights)
        loudness = 10 * np.log10(max(float((piece**2).mean()), 1e-12))
        heard.append([loudness, float(vowel), float(low), float(high), index / FPS])
    return run_node("voice.mjs", voice, heard)


@pytest.fixture(scope="module")
def voice(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The part that hears, as a module."""
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
    truth = np.concatenate([np.zeros(RATE), jaw])[at]
    assert np.corrcoef(opened[late:], truth)[0, 1] >= 0.8
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
    assert result["pressed"] == ["true", "false"]
    assert result["told"].startswith("Speak: the lips follow your voice.")
    assert result["ended"] is True
    assert result["left"] == pytest.approx(0, abs=1e-6)
    assert ((heard[1:] > 0.15) & (heard[:-1] <= 0.15)).sum() >= 3, "the tone swells and fades every 1.1 seconds"
    assert heard.max() > 0.35
    assert heard[-1] < 0.03
    # A moment is heard before the picture that shows it.
    assert np.corrcoef(heard[:-1], shown[1:])[0, 1] > 0.95, "the avatar's jaw is that of the voice"


def test_what_is_wrong_is_said_and_nothing_could_be_sent(page: Path) -> None:
    """The page's own policy forbids every way out."""
    gone = "Object.defineProperty(navigator, 'mediaDevices', { value: undefined });"
    denied = "navigator.mediaDevices.getUserMedia = async () => { throw new DOMException('', 'NotAllowedError'); };"
    told = browse(page, [PRESS % denied, PRESS % gone, TRY_TO_SEND], WINDOW)
    assert set(told["requests"]) <= {"https://example.com/"}, "those that the last script tries, and the page refuses"
    *pressed, refused = told["results"]
    messages = ("The microphone is not allowed. Allow it for this page", "This browser gives no microphone")
    for (text, role, is_pressed), message in zip(pressed, messages, strict=True):
        assert text.startswith(message)
        assert (role, is_pressed) == ("status", "false")
    assert {"connect-src", "frame-src", "img-src", "script-src-elem"} <= set(refused)
    assert "form-action 'none'; base-uri 'none'" in page.read_text()


def test_export_writes_the_button(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_portable(tmp_path / "a.mien", drawn_head(10))
    for options, count in (([], 0), (["--microphone"], 1)):
        assert main(["export", str(tmp_path / "a.mien"), "--out", str(tmp_path / "a.html"), *options]) == 0
        assert (tmp_path / "a.html").read_text().count('id="microphone"') == count
    assert main(["export", str(tmp_path / "a.mien"), "--out", str(tmp_path / "a.packed"), "--microphone"]) == 2
    assert "only an .html page has a microphone" in capsys.readouterr().err
