"""The studio's guide on films: what is wrong with each, by the page's own check, in Chromium with MediaPipe."""

from collections.abc import Callable, Iterator
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
from studio_case import give_film, person, studio, told
from web_case import browse, script, tasks_vision

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


def write_film(path: Path, pictures: Iterator[np.ndarray]) -> Path:
    with av.open(str(path), "w") as out:
        stream: Any = None
        for picture in pictures:
            if stream is None:
                stream = out.add_stream("libx264", rate=Fraction(FPS), options={"crf": "12", "preset": "ultrafast"})
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
