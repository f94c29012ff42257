"""Compare the jaw and lips that mien makes of a voice with the phonemes that were spoken (docs/using.md, "A voice").

    apt install espeak-ng && python benchmarks/speech.py

espeak-ng speaks sentences and tells when each phoneme begins. A phoneme becomes one or two of Oculus' visemes, whose
jaw (`mien.runtime.visemes.json`), smoothed, is the truth. Within speech, the correlation of mien's jaw with it is
printed, and the number of p, b and m at which the lips shut. Constants were chosen on the sentences and voices of
`CHOSEN`; the others judge.
"""

import ctypes
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.signal import resample_poly

import mien.runtime
from mien.driving.motion import ARKIT_NAMES
from mien.driving.speech import motion_of_sound
from mien.media.video import RATE

SENTENCES = {
    "chosen": (
        "My brother bought a big map of the old town.",
        "Please bring the blue umbrella, it may rain before noon.",
        "Nobody remembers what happened to the small boat.",
        "Can you open the window and let some fresh air into the room?",
        "Five people came to the party, but Emma stayed at home.",
    ),
    "judged": (
        "The farmer keeps a brown pony behind the big barn.",
        "We saw them walking along the beach on Monday morning.",
        "Peter promised to make apple pie for both of us.",
        "How many times must I explain the problem to your mother?",
        "A warm summer breeze moved the paper on the table.",
    ),
    "judged, German": (
        "Mein Bruder kaufte am Montag eine bunte Blume.",
        "Der Bauer baut im Mai ein Haus am Bach.",
        "Papa möchte bitte noch mehr Butter und Brot haben.",
        "Wir haben am Abend oft Musik gemacht.",
        "Im Sommer blüht am Baum ein roter Apfel.",
    ),
}
VOICES = {
    "chosen": ("en-us", "en-us+f4", "en-us+m7", "en-us+klatt4"),
    "judged": ("en-gb-x-rp+f2", "en-us+klatt2", "en-us+m3", "en-us+f5"),
    "judged, German": ("de+f3",),
}
VISEMES = (
    (r"(aI|AI)", "aa I"), (r"aU", "aa U"), (r"(OI|OY|Oy|oI)", "O I"), (r"eI", "E I"), (r"(oU|@U|o#U)", "O U"),
    (r"(i@|I@)", "I E"), (r"(e@|E@)", "E"), (r"(U@|u@)", "U E"), (r"A@", "aa"), (r"(O@|o@)", "O"), (r"[pbm]", "PP"),
    (r"[fv]", "FF"), (r"[TD]", "TH"), (r"(tS|dZ|S|Z|C|s;)", "CH"), (r"(s|z|ts$)", "SS"), (r"[td?]", "DD"),
    (r"[kgxQNh]", "kk"), (r"(n|l|-l|L)", "nn"), (r"[rR]", "RR"), (r"w", "U"), (r"[j;]", "I"), (r"[AaV&]", "aa"),
    (r"[Ee3@WY]", "E"), (r"[iI]", "I"), (r"[O0o]", "O"), (r"[uUy]", "U"), (r"_", "sil"),
)  # fmt: skip
"""Beginnings of espeak's names of phonemes, and their visemes. The first that fits counts."""
WORDS_A_MINUTE, SILENCE, SMOOTHED, NOISE, SHUT = 160, 0.5, 0.12, -60, 0.06
"""Rate of speech; seconds before and after it; seconds of smoothing; noise in dB; a jaw that counts as shut."""
BURST, FIRST_BURST = 0.045, 0.08
"""Seconds by which p, t and k close before their event, which is their burst; at the beginning of speech, longer."""


class Event(ctypes.Structure):
    """espeak_EVENT of speak_lib.h."""

    _fields_ = (
        ("type", ctypes.c_int), ("uid", ctypes.c_uint), ("text_position", ctypes.c_int), ("length", ctypes.c_int),
        ("audio_position", ctypes.c_int), ("sample", ctypes.c_int), ("user_data", ctypes.c_void_p),
        ("name", ctypes.c_char * 8),
    )  # fmt: skip


Callback = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.POINTER(ctypes.c_short), ctypes.c_int, ctypes.POINTER(Event))


class Speaker:
    """Speaks by libespeak-ng, and tells phonemes with their times."""

    def __init__(self) -> None:
        self._library = ctypes.CDLL("libespeak-ng.so.1")
        self._rate = self._library.espeak_Initialize(2, 0, None, 1)  # into memory, with events of phonemes
        self._pieces: list[np.ndarray] = []
        self._phonemes: list[tuple[float, str]] = []
        self._callback = Callback(self._hear)
        self._library.espeak_SetSynthCallback(self._callback)

    def _hear(self, samples, count: int, events) -> int:
        if samples and count:
            self._pieces.append(np.ctypeslib.as_array(samples, (count,)).copy())
        index = 0
        while events[index].type != 0:
            if events[index].type == 7:  # a phoneme
                name = events[index].name.decode("utf-8", "replace")
                self._phonemes.append((events[index].audio_position / 1000, name))
            index += 1
        return 0

    def speak(self, text: str, voice: str) -> tuple[np.ndarray, list[tuple[float, str]]]:
        """Return samples at `RATE`, -1..1, and each phoneme's beginning in seconds and name."""
        self._pieces.clear()
        self._phonemes.clear()
        if self._library.espeak_SetVoiceByName(voice.encode()) != 0:
            raise SystemExit(f"espeak-ng has no voice {voice}")
        self._library.espeak_SetParameter(1, WORDS_A_MINUTE, 0)
        content = text.encode()
        self._library.espeak_Synth(content, len(content) + 1, 0, 1, 0, 1, None, None)
        self._library.espeak_Synchronize()
        samples = np.concatenate(self._pieces).astype(np.float64) / 32768
        return resample_poly(samples, RATE, self._rate), list(self._phonemes)


@dataclass
class Spoken:
    """A sentence with its truth: everything at `RATE`."""

    sound: np.ndarray
    jaw: np.ndarray
    shut: list[tuple[int, int]]
    """Beginning and end of each p, b and m."""
    speech: tuple[float, float]
    """Beginning and end of speech, in seconds."""


def visemes_of(phoneme: str) -> list[str]:
    """Visemes of a phoneme, in their order."""
    bare = phoneme.strip("',%=|")
    return next((visemes.split() for pattern, visemes in VISEMES if re.match(pattern, bare)), ["sil"])


def spoken(speaker: Speaker, text: str, voice: str) -> Spoken:
    """Speak a sentence, with silence around it and with noise, and return it with its truth."""
    table = json.loads((Path(mien.runtime.__file__).parent / "visemes.json").read_text())
    opening = {name: coefficients.get("jawOpen", 0.0) for name, coefficients in table.items()}
    samples, phonemes = speaker.speak(text, voice)
    silence = np.zeros(round(SILENCE * RATE))
    samples = np.concatenate([silence, samples, silence])
    events = [(round((second + SILENCE) * RATE), name) for second, name in phonemes if name] + [(len(samples), "_")]
    jaw, shut = np.zeros(len(samples)), []
    for (begin, name), (end, _) in zip(events, events[1:], strict=False):
        visemes = visemes_of(name)
        if re.match(r"(p|t|k)(?!S)", name):
            closing = FIRST_BURST if begin < (SILENCE + 0.09) * RATE else BURST
            closed = begin - round(closing * RATE)
            jaw[closed:begin] = opening[visemes[0]]
            if visemes == ["PP"]:
                shut.append((closed, begin))
        elif visemes == ["PP"]:
            shut.append((begin, end))
        borders = np.linspace(begin, end, len(visemes) + 1).astype(int)
        for viseme, low, high in zip(visemes, borders, borders[1:], strict=False):
            jaw[low:high] = opening[viseme]
    window = np.hanning(round(SMOOTHED * RATE) | 1)
    jaw = np.convolve(np.pad(jaw, len(window) // 2, mode="edge"), window / window.sum(), "valid")
    noise = 10 ** (NOISE / 20) * np.random.default_rng(0).standard_normal(len(samples))
    sound = (0.6 * samples / np.abs(samples).max() + noise).astype(np.float32)
    return Spoken(sound, jaw, shut, (events[0][0] / RATE, events[-2][0] / RATE))


def scores(cases: list[Spoken]) -> tuple[float, int, int]:
    """Mean correlation of the jaw within speech, and of how many p, b and m the lips shut."""
    column, seen, correlations = ARKIT_NAMES.index("jawOpen"), [], []
    for case in cases:
        motion = motion_of_sound(case.sound)
        found = motion.coefficients[:, column]
        at = np.minimum((np.arange(len(found)) / motion.fps * RATE).astype(int), len(case.jaw) - 1)
        within = slice(*(int(second * motion.fps) for second in case.speech))
        correlations.append(np.corrcoef(found[within], case.jaw[at][within])[0, 1])
        for begin, end in case.shut:
            frames = slice(int(begin / RATE * motion.fps), int(end / RATE * motion.fps) + 2)
            seen.append(bool(found[frames].min() < SHUT))
    return float(np.mean(correlations)), sum(seen), len(seen)


def rows() -> Iterator[str]:
    """The table of all methods, a row at a time."""
    speaker = Speaker()
    yield "| sentences | voice of espeak-ng | r of the jaw | lips shut at p, b, m |\n|---|---|---|---|"
    for kind, sentences in SENTENCES.items():
        for voice in VOICES[kind]:
            r, shut, count = scores([spoken(speaker, text, voice) for text in sentences])
            yield f"| {kind} | {voice} | {r:.2f} | {shut} of {count} |"


if __name__ == "__main__":
    for row in rows():
        print(row, flush=True)
