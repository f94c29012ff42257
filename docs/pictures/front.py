"""Make the picture of README.md: `python docs/pictures/front.py DIR`, where DIR is what `make demo` writes.

A frame of the video, the avatar at the same moment, turned and driven, and the avatar's page. It needs `npm ci` in web/
and Chromium.
"""

import argparse
import json
import shutil
import subprocess
import tempfile
from pathlib import Path

import cv2
import numpy as np

from mien.cli import main
from mien.pipeline.sheets import named_picture

ROOT = Path(__file__).parent.parent.parent
OUT = ROOT / "docs" / "images" / "demo.jpg"
SIDE, GAP, QUALITY = 296, 8, 86
ZOOM = 1.4
"""Magnification of all pictures but the page."""
PAGE = (954, 2 * SIDE + GAP + 54)
"""Width and height of the page's window: the height of two pictures with their names."""
_SMILE = """(async () => {
  const viewer = await mien;
  [...document.querySelectorAll("#faces button")].find((each) => each.textContent === "Smile").click();
  viewer.yaw = -0.25;
  viewer.look();
  await new Promise((done) => setTimeout(done, 1500));
})()"""


def frame_of(video: Path, index: int) -> np.ndarray:
    """Return a frame of a video as BGR."""
    reader = cv2.VideoCapture(str(video))
    reader.set(cv2.CAP_PROP_POS_FRAMES, index)
    read, picture = reader.read()
    assert read, f"{video}: has no frame {index}"
    return picture


def shoot(page: Path, path: Path) -> None:
    """Write what the page's window shows, with a smile."""
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
    told = {"width": PAGE[0], "height": PAGE[1], "scripts": [_SMILE], "screenshots": [str(path)]}
    command = ["node", str(ROOT / "web" / "tests" / "browser.mjs"), chromium, str(page)]
    subprocess.run(command, input=json.dumps(told), text=True, capture_output=True, check=True)


def make(workspace: Path, timestep: int) -> None:
    """Write the picture into docs/images."""
    (video,) = workspace.glob("synthetic-*.mp4")
    views = {
        "avatar, same moment": ["--timestep", str(timestep)],
        "turned by 30 degrees": ["--timestep", str(timestep), "--yaw", "30"],
        "driven: surprise": ["--set", "surprise=0.9"],
    }
    filmed = frame_of(video, timestep)
    edge = round(filmed.shape[0] * (1 - 1 / ZOOM) / 2)
    filmed = filmed[edge:-edge, edge:-edge]
    shown = [("filmed frame (drawn person)", cv2.resize(filmed, (SIDE, SIDE), interpolation=cv2.INTER_AREA))]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for title, options in views.items():
            still = str(folder / "still.png")
            assert (
                main(["render", str(workspace), "--out", still, "--size", str(SIDE), "--zoom", str(ZOOM), *options])
                == 0
            )
            shown.append((title, np.asarray(cv2.imread(still))))
        shoot(workspace / "me.html", folder / "page.png")
        page = np.asarray(cv2.imread(str(folder / "page.png")))
    tiles = [named_picture(picture, title) for title, picture in shown]
    high, wide = tiles[0].shape[:2]
    canvas = np.full((2 * high + GAP, 2 * (wide + GAP) + page.shape[1], 3), 255, np.uint8)
    for index, tile in enumerate(tiles):
        top, left = (index // 2) * (high + GAP), (index % 2) * (wide + GAP)
        canvas[top : top + high, left : left + wide] = tile
    canvas[:, 2 * (wide + GAP) :] = page[: len(canvas)]
    cv2.imwrite(str(OUT), canvas, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("workspace", type=Path)
    parser.add_argument("--timestep", type=int, default=60, help="moment of the first three pictures")
    given = parser.parse_args()
    make(given.workspace, given.timestep)
