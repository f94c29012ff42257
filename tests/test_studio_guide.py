"""The studio's guide on films: what is wrong with each, by the page's own check, in Chromium with MediaPipe."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
import torch

pytest.importorskip("starlette")

from mien.face import FaceModel, FaceParams
from mien.lab.synthetic import motion, scene
from mien.lab.synthetic.recipe import SyntheticRecipe
from mien.lab.synthetic.scene import SyntheticScene
from studio_case import give_film, studio
from web_case import browse, script, tasks_vision

pytestmark = [pytest.mark.slow, pytest.mark.unchecked]
FPS = 5
"""Pictures of the films in a second. The check looks at three."""
SHORT = 5 * FPS
CHECK = script("""
  const pause = () => new Promise((done) => setTimeout(done, 50)), one = (text) => document.querySelector(text);
  while (!one("#films li")) await pause();
  const notes = [];
  for (let k = 1; k <= COUNT; ++k) {
    const row = () => one("#films").children[k - 1];
    row().querySelector(`[aria-label="Check film ${k}"]`).click();
    while (!row().querySelector("small + small")) {
      if (one("#message").textContent) throw new Error(one("#message").textContent);
      await pause();
    }
    notes.push(row().querySelector("small + small").textContent);
  }
  return notes;
""")
"""Presses Check at each film, one after the other, and returns the notes."""


def frames_of(path: Path, count: int) -> Iterator[np.ndarray]:
    """Yield RGB pictures of a film, `FPS` in a second."""
    with av.open(str(path)) as source:
        stream = source.streams.video[0]
        every = round(float(stream.average_rate or 25) / FPS)
        for index, frame in enumerate(source.decode(stream)):
            if index % every == 0 and index < count * every:
                yield frame.to_ndarray(format="rgb24")


def write_film(path: Path, pictures: Iterable[np.ndarray], fps: int = FPS) -> Path:
    with av.open(str(path), "w") as out:
        stream: Any = None
        for picture in pictures:
            if stream is None:
                stream = out.add_stream("libx264", rate=Fraction(fps), options={"crf": "12", "preset": "ultrafast"})
                stream.height, stream.width = (side // 2 * 2 for side in picture.shape[:2])
                stream.pix_fmt = "yuv420p"
            cut = np.ascontiguousarray(picture[: stream.height, : stream.width])
            out.mux(stream.encode(av.VideoFrame.from_ndarray(cut)))
        out.mux(stream.encode())
    return path


def checked(folder: Path, films: list[Path]) -> list[str]:
    """Return what the page says of each film."""
    tasks_vision()
    with studio(folder) as serving:
        for film in films:
            give_film(serving.maker.people, "Ada", film)
        (notes,) = browse(serving.address, [CHECK.replace("COUNT", str(len(films)))], fragment="Ada")["results"]
    return notes


def with_a_hand(picture: np.ndarray) -> np.ndarray:
    """Draw a hand of four fingers before the middle of a picture of 512 x 512."""
    drawn, skin = picture.copy(), (198, 150, 125)
    cv2.ellipse(drawn, (256, 300), (70, 80), 0, 0, 360, skin, -1)
    for k in range(4):
        cv2.ellipse(drawn, (205 + 34 * k, 200), (15, 75), 0, 0, 360, skin, -1)
    for k in range(3):
        cv2.line(drawn, (222 + 34 * k, 140), (222 + 34 * k, 250), (150, 105, 85), 2)
    return drawn


def far_away(picture: np.ndarray) -> np.ndarray:
    """Show a picture small, in the middle of a grey one of the same size."""
    drawn, small = np.full_like(picture, 150), cv2.resize(picture, (200, 200), interpolation=cv2.INTER_AREA)
    drawn[150:350, 150:350] = small
    return drawn


NOTHING = "Turn your head further: right, up, left, down. Smile, and show your teeth."
"""What begins the note of a film whose light and place are good, and in which little happens."""


@pytest.mark.footage
def test_films_are_told_what_a_person_would_say(tmp_path: Path, test_data: Path) -> None:
    footage = test_data / "footage"
    wojtek, other = (list(frames_of(footage / f"{name}.mp4", SHORT)) for name in ("wojtek", "d9"))
    films: dict[str, tuple[Iterable[np.ndarray], str]] = {
        "wojtek": (wojtek, NOTHING), "d9": (other, NOTHING),
        **{name: (frames_of(footage / f"{name}.mp4", SHORT), NOTHING) for name in ("d6", "d14")},
        "dark": ([(picture * 0.15).astype(np.uint8) for picture in wojtek], "Too dark here: Turn on a lamp"),
        "small": (map(far_away, wojtek), "Too far away: Come closer"),
        "two": ((np.hstack(both) for both in zip(wojtek, (each[:, :512] for each in resized(other)), strict=True)),
                "Two people here: Only one of you"),
        "hand": (map(with_a_hand, wojtek), "No face seen: Look into the camera"),
        "photograph": ([wojtek[5]] * (6 * SHORT), f"{NOTHING} Raise your eyebrows."),
    }  # fmt: skip
    paths = [write_film(tmp_path / f"{name}.mp4", pictures) for name, (pictures, _) in films.items()]
    notes = dict(zip(films, checked(tmp_path / "people", paths), strict=True))
    assert {name: note[: len(films[name][1])] for name, note in notes.items()} == {
        name: begin for name, (_, begin) in films.items()
    }
    for name, note in notes.items():
        assert note.count(": ") <= 2, f"{name}: at most one fault, and the turns"


def resized(pictures: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    return (cv2.resize(each, (512, 512), interpolation=cv2.INTER_AREA) for each in pictures)


LOOKS, SECONDS = 3, 30
"""Pictures of the drawn film in a second, as many as the check looks at, and its length."""
SHOWN = (
    ("mouthSmileLeft", "mouthSmileRight"), ("browInnerUp", "browOuterUpLeft", "browOuterUpRight"), ("jawOpen",),
    ("mouthPucker", "mouthFunnel"), ("eyeBlinkLeft", "eyeBlinkRight"),
)  # fmt: skip


def drawn_film(path: Path, seed: int) -> Path:
    """Write half a minute of a drawn person who turns their head all around, and then makes each face."""
    count = LOOKS * SECONDS
    recipe = SyntheticRecipe(
        width=360, height=360, fps=float(LOOKS), seconds=float(SECONDS), glasses=False, supersample=1, texture_size=512
    )

    def posed(model: FaceModel, *given: Any) -> FaceParams:
        own, rest = motion.generate_motion(model, *given), model.neutral(count)
        expression, rotation = rest.expression.clone(), torch.zeros(count, 3)
        times = torch.arange(count) / LOOKS
        around = 2 * np.pi * (times - 3) / 12
        turns = ((times >= 3) & (times < 15)).float()
        rotation[:, 0], rotation[:, 1] = 0.4 * turns * around.sin(), 0.75 * turns * around.cos()
        for k, names in enumerate(SHOWN):
            makes = (times >= 16 + 2.5 * k) & (times < 18 + 2.5 * k)
            for name in names:
                expression[makes, model.expression_names.index(name)] = 1
        placed = replace(rest, identity=own.identity, head_translation=own.head_translation[:1].expand(count, -1))
        return replace(placed, expression=expression, head_rotation=rotation)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(scene, "generate_motion", posed)
        pictures = (np.ascontiguousarray(each.image) for each in SyntheticScene(recipe, seed).frames())
        return write_film(path, pictures, LOOKS)


def test_a_drawn_person_who_turns_and_makes_faces_fills_both_rings(tmp_path: Path) -> None:
    film = drawn_film(tmp_path / "drawn.mp4", 2)
    assert checked(tmp_path / "people", [film]) == ["It has all that an avatar needs."]
