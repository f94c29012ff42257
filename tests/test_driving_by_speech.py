"""A voice drives an avatar: silence, loudness, high and low sounds, and the sound in the video."""

import socket
import wave
from pathlib import Path

import av
import numpy as np
import pytest

from mien.cli import main
from mien.driving.drivers import Driver
from mien.driving.motion import ARKIT_NAMES
from mien.driving.speech import FPS, motion_of_sound
from mien.face import load_face_model
from mien.media.video import RATE, count_frames, read_sound, read_video_frames, write_video
from mien.pipeline import drive as driving
from mien.pipeline import view as viewing
from mien.pipeline import view_motions as viewing_motions
from mien.viewer.session import Session
from refusals import refuses
from shared_things import write_toy_workspace
from toy_scene import toy_face_model

SECONDS = 6.0
BLACK = np.zeros((32, 32, 3), np.uint8)
MOUTH = [index for index, name in enumerate(ARKIT_NAMES) if name.startswith(("jaw", "mouth"))]


def column(values: np.ndarray, name: str) -> np.ndarray:
    return values[:, ARKIT_NAMES.index(name)]


def write_wav(path: Path, samples: np.ndarray, rate: int = RATE, channels: int = 1) -> Path:
    with wave.open(str(path), "wb") as file:
        file.setnchannels(channels)
        file.setsampwidth(2)
        file.setframerate(rate)
        file.writeframes(np.repeat(samples * 32767, channels).astype("<i2").tobytes())
    return path


def tone(frequency: float, loudness: float = 0.5, rate: int = RATE) -> tuple[np.ndarray, np.ndarray]:
    """Return a tone that begins after a second and swells and fades, with its envelope (0..1)."""
    seconds = np.arange(round(SECONDS * rate)) / rate
    envelope = (0.5 - 0.5 * np.cos(2 * np.pi * (seconds - 1) / 1.1)) * (seconds > 1)
    return (loudness * envelope * np.sin(2 * np.pi * frequency * seconds)).astype(np.float32), envelope


def noise(count: int, loudness: float) -> np.ndarray:
    return (loudness * np.random.default_rng(0).standard_normal(count)).astype(np.float32)


@pytest.mark.parametrize("loudness", [0.0, 1e-3])
def test_silence_keeps_the_mouth_shut(loudness: float) -> None:
    motion = motion_of_sound(noise(round(SECONDS * RATE), loudness))
    assert (len(motion), motion.fps) == (SECONDS * FPS, FPS)
    assert (motion.coefficients[:, MOUTH] == 0).all()
    assert column(motion.coefficients, "eyeBlinkLeft").max() > 0.6, "the avatar lives"
    assert 0.005 < np.abs(motion.head_rotation).max() < 0.1


@pytest.mark.parametrize(("frequency", "loudness"), [(150.0, 0.9), (1200.0, 0.05)])
def test_the_jaw_follows_the_envelope(frequency: float, loudness: float) -> None:
    samples, envelope = tone(frequency, loudness)
    samples = samples + noise(len(samples), 1e-4)
    jaw = column(motion_of_sound(samples).coefficients, "jawOpen")
    sampled = np.interp(np.arange(len(jaw)) / FPS, np.arange(len(samples)) / RATE, envelope)
    by_lag = [np.corrcoef(np.roll(jaw, -lag), sampled)[0, 1] for lag in (0, -2, -1, 1, 2)]
    assert by_lag[0] == max(by_lag) >= 0.9, "there is no lag"
    assert jaw[:25].max() < 0.02, "it is silent before the tone"
    assert 0.4 < jaw.max() <= 0.6
    # A pause in noise closes the mouth as well.
    noisy = 0.3 / loudness * samples + noise(len(samples), 0.005)
    jaw = column(motion_of_sound(noisy).coefficients, "jawOpen")
    assert jaw[:25].max() < 0.05
    assert jaw.max() > 0.4


VOWELS = {"a": (750, 1200, 2600, 1.0, 0), "e": (290, 2300, 3000, 0.25, -5), "i": (420, 1950, 2600, 0.4, -4),
          "o": (500, 880, 2500, 0.6, -2), "u": (320, 820, 2400, 0.25, -5)}  # fmt: skip
"""Formants of five vowels in Hz, how open the jaw is, and loudness in dB."""
CLOSED = {"p": (250, 900, 2400, 0, -60), "b": (250, 900, 2400, 0, -28), "m": (250, 1100, 2300, 0, -14)}


def smooth(values: np.ndarray, seconds: float) -> np.ndarray:
    window = np.hanning(int(2 * seconds * RATE) | 1)
    return np.convolve(np.pad(values, len(window) // 2, mode="edge"), window / window.sum(), "valid")


def synthesised(seed: int, syllables: int, even: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return speech made of a buzz through three formants, with the jaw of each sample, and whether lips are closed.
    If it is `even`, all vowels are equally loud: i and u, behind a closed jaw, as loud as a."""
    random, rows = np.random.default_rng(seed), []
    for _ in range(syllables):
        rows += [CLOSED[consonant]] * round(0.09 * RATE) if (consonant := random.choice(["p", "b", "m", ""])) else []
        count = round(random.uniform(0.15, 0.3) * RATE)
        vowel = VOWELS[random.choice(list(VOWELS))]
        rows += [(*vowel[:4], 0 if even else vowel[4])] * count
    table = np.array(rows, np.float64)
    pulses = np.floor(np.cumsum(115 * (1 + 0.08 * np.sin(np.arange(len(table)) / 3000))) / RATE)
    sound = smooth(np.diff(pulses, prepend=0), 0.0006) + 0.01 * random.standard_normal(len(table))
    for part, width in enumerate((80, 100, 140)):
        reach = np.exp(-np.pi * width / RATE)
        back = 2 * reach * np.cos(2 * np.pi * smooth(table[:, part], 0.03) / RATE)
        before = last = 0.0
        for index in range(len(sound)):
            before, last = last, (1 - back[index] + reach**2) * sound[index] + back[index] * last - reach**2 * before
            sound[index] = last
    if even:
        sound /= np.sqrt(smooth(sound**2, 0.03))
    sound *= 10 ** (smooth(table[:, 4], 0.012) / 20)
    sound = 0.6 * sound / np.abs(sound).max() + 1e-4 * random.standard_normal(len(sound))
    return sound.astype(np.float32), smooth(table[:, 3], 0.05), table[:, 3] == 0


@pytest.mark.parametrize(("seed", "even"), [(0, False), (2, True)])
def test_lips_shut_at_p_b_and_m_and_the_jaw_opens_with_the_vowels(seed: int, even: bool) -> None:
    """Vowels that are equally loud are told by their formants."""
    sound, jaw, shut = synthesised(seed, 24, even)
    motion = motion_of_sound(sound)
    sampled = (np.arange(len(motion)) / FPS * RATE).astype(int)
    found, press = (column(motion.coefficients, name) for name in ("jawOpen", "mouthPressLeft"))
    assert np.corrcoef(found, jaw[sampled])[0, 1] >= 0.8
    edges = np.flatnonzero(np.diff(shut.astype(int), prepend=0, append=0)) / RATE * FPS
    closures = [slice(int(begin), int(end) + 2) for begin, end in edges.reshape(-1, 2)]
    assert np.mean([found[one].min() < 0.06 for one in closures]) >= 0.8
    inside = np.zeros(len(found), bool)
    for one in closures:
        inside[max(one.start - 1, 0) : one.stop + 1] = True
    assert press[~inside].mean() < 0.1 * press[inside].max(), "lips are not pressed in vowels"


@pytest.mark.parametrize(("between", "pressed"), [(0.0, True), (5000.0, False)])
def test_a_hiss_between_vowels_keeps_the_lips_open_and_a_pause_does_not(between: float, pressed: bool) -> None:
    """A drop of the level for a tenth of a second is a p, unless it hisses like an s."""
    seconds = np.arange(3 * RATE) / RATE
    vowel, hiss = (0.3 * np.sin(2 * np.pi * frequency * seconds) for frequency in (700.0, between))
    sound = np.where(np.abs(seconds - 1.5) < 0.05, hiss, vowel).astype(np.float32)
    press = column(motion_of_sound(sound).coefficients, "mouthPressLeft")[30:60].max()
    assert (press > 0.2) == pressed
    assert pressed or press < 0.02


def test_low_sounds_round_the_lips_and_high_ones_stretch_them() -> None:
    most = {}
    for name, frequency in (("low", 200.0), ("high", 5000.0)):
        coefficients = motion_of_sound(tone(frequency)[0]).coefficients
        most[name] = {one: column(coefficients, one).max() for one in ("jawOpen", "mouthFunnel", "mouthStretchLeft")}
    assert most["low"]["mouthFunnel"] > 0.2 > 0.05 > most["high"]["mouthFunnel"]
    assert most["high"]["mouthStretchLeft"] > 0.2 > 0.05 > most["low"]["mouthStretchLeft"]
    assert most["high"]["jawOpen"] < 0.6 * most["low"]["jawOpen"]


def test_sound_is_read_from_several_kinds_of_files(tmp_path: Path) -> None:
    stereo = write_wav(tmp_path / "a.wav", tone(440.0, rate=44_100)[0], 44_100, channels=2)
    read, (reference, _) = read_sound(stereo), tone(440.0)
    assert len(read) == pytest.approx(SECONDS * RATE, abs=50)
    assert np.abs(read[: len(reference)] - reference[: len(read)]).max() < 0.02
    given, out = write_wav(tmp_path / "b.wav", reference[: 2 * RATE]), tmp_path / "film.mp4"
    for pictures in (30, 90):
        write_video(out, [BLACK] * pictures, 30, sound=(given, pictures / 30))
        assert count_frames(out) == pictures
        assert len(read_sound(out)) == pytest.approx(pictures / 30 * RATE, abs=RATE // 10)
        with av.open(str(out)) as container:
            lengths = [float((stream.duration or 0) * (stream.time_base or 0)) for stream in container.streams]
            assert [stream.type for stream in container.streams] == ["video", "audio"]
        assert lengths == pytest.approx([pictures / 30] * 2, abs=0.05)


def test_files_without_sound_and_odd_rates_are_refused(tmp_path: Path) -> None:
    (tmp_path / "empty.wav").touch()
    (tmp_path / "text.wav").write_text("la la la " * 100)
    write_wav(tmp_path / "header.wav", np.zeros(0))
    write_video(tmp_path / "film.mp4", [BLACK] * 2, 25)
    for rate in (0, 999, 2_000_000):
        data = bytearray(write_wav(tmp_path / "rate.wav", np.zeros(100)).read_bytes())
        (tmp_path / f"{rate}.wav").write_bytes(data[:24] + rate.to_bytes(4, "little") + data[28:])
    for name, message in (
        ("gone.wav", "no such file"), ("empty.wav", "is empty"), ("header.wav", "no sound of it can be decoded"),
        ("text.wav", "cannot be read as sound.*convert it to .wav"), (".", "is not a file; give a sound file"),
        ("film.mp4", "has no sound; give a file with sound"), ("0.wav", r"\.wav: .*convert it to \.wav"),
        ("999.wav", r"\.wav: .*convert it to \.wav"), ("2000000.wav", r"\.wav: .*convert it to \.wav"),
    ):  # fmt: skip
        refuses(message, read_sound, tmp_path / name)


@pytest.mark.unchecked
def test_the_command_writes_a_talking_avatar(tmp_path: Path, monkeypatch, capsys) -> None:
    write_toy_workspace(tmp_path / "w")
    voice, out = write_wav(tmp_path / "voice.wav", tone(440.0)[0][: 3 * RATE]), tmp_path / "talking.mp4"
    told = driving.open_driver(voice, None, load_face_model("anny"))
    assert told.sound == voice
    assert told.pictures is None
    face = toy_face_model().neutral(len(told.face))
    # The toy head has none of ARKit's expressions.
    monkeypatch.setattr(driving, "open_driver", lambda *_: Driver(face, face[0], told.fps, None, told.sound))
    for options, code, said in (
        (["--out", str(out)], 0, ""),
        (["--out", str(out.with_suffix(".webm"))], 0, "has no sound; only an .mp4"),
        (["--sequence", "a", "--out", str(out)], 2, ""),
        (["--alone"], 2, "options of films need --out FILE.mp4"),
        (["--out", str(out), "--port", "80"], 2, "Unrecognized options: --port"),
    ):
        assert main(["drive", str(tmp_path / "w"), "--by", str(voice), "--size", "32", *options]) == code
        assert said in capsys.readouterr().err
    assert len(list(read_video_frames(out))) == 90
    assert len(read_sound(out)) == pytest.approx(3 * RATE, abs=RATE // 10)


def test_without_an_output_the_viewer_plays_the_voice(tmp_path: Path, monkeypatch) -> None:
    pytest.importorskip("viser")
    write_toy_workspace(tmp_path / "w")
    voice, shown, face = write_wav(tmp_path / "voice.wav", tone(300.0)[0]), [], toy_face_model().neutral(90)

    def serve(session: Session, door: object, listener: socket.socket, *rest: object) -> None:
        port = listener.getsockname()[1]
        shown.append((session.chosen, session.playing, session.clip is not None and len(session.clip.motion), port))

    monkeypatch.setattr(viewing, "serve", serve)
    monkeypatch.setattr(viewing_motions, "open_driver", lambda by, *_, **__: Driver(face, face[0], FPS, None, by))
    assert main(["drive", str(tmp_path / "w"), "--by", str(voice), "--port", "8123"]) == 0
    assert shown == [("voice.wav", True, 90, 8123)]


def write_mp3(path: Path, layout: str, seconds: float) -> bytes:
    samples = np.sin(np.arange(int(seconds * 48_000)) * 0.05).astype(np.float32)
    with av.open(str(path), "w", format="mp3", options={"write_xing": "0", "id3v2_version": "0"}) as container:
        stream = container.add_stream("libmp3lame", rate=48_000, layout=layout)
        rows = np.ascontiguousarray(np.tile(samples, (2 if layout == "stereo" else 1, 1)))
        frame = av.AudioFrame.from_ndarray(rows, format="fltp", layout=layout)
        frame.sample_rate = 48_000
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path.read_bytes()


def test_sound_that_changes_its_channels_is_read_to_its_end(tmp_path: Path) -> None:
    """Recorders append, and streams switch from one channel to two."""
    path = tmp_path / "a.mp3"
    one, two = write_mp3(path, "mono", 0.5), write_mp3(path, "stereo", 0.7)
    for content in (one + two, two + one, one + two + one):
        path.write_bytes(content)
        samples = read_sound(path)
        assert len(samples) > 1.1 * RATE
        assert np.abs(samples[-RATE // 4 : -RATE // 8]).max() > 0.3
    path.write_bytes(one + two[:3000] + bytes(100) + two[3100:])
    assert len(read_sound(path)) > 0.5 * RATE, "what follows damage may be left out"
