"""A drawn head as a webcam: a video whose motion is known, with each frame's number beside the head."""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float

from mien.lab.synthetic import SyntheticRecipe, SyntheticScene
from mien.lab.synthetic.painter import develop, draw, to_uint8
from mien.lab.synthetic.posing import head_pose
from mien.lab.synthetic.subject import pose_subject

FPS = 4.0
"""Frames per second. Few, because software WebGL leaves the detector four to eight on a busy machine."""
STILL = 20
"""Frames at the start in which nothing moves."""
TRUE = ("jawOpen", "eyeBlinkLeft", "eyeBlinkRight")
WIDTH, HEIGHT = 640, 480
CELL, BITS = 40, 10
"""The number is a column of cells at the left: black or white for each bit, the lowest on top, and their parity."""
_SIDE = HEIGHT
_JAW = ((24, 14, 0.35), (44, 16, 0.6), (70, 14, 0.45), (92, 12, 0.25))
_BLINKS = ((33, 7), (57, 7), (64, 6), (86, 7))
_COUNT = 108
_YAW = 0.12


@dataclass(frozen=True)
class Clip:
    """A video, and what it shows."""

    path: Path
    """An uncompressed video (.y4m), as Chromium's fake camera takes it."""
    truth: Float[np.ndarray, "t 3"]
    """Coefficients of `TRUE` at each frame."""
    yaw: Float[np.ndarray, " t"]
    """Turn of the head to the person's left, in radians."""


def write_clip(folder: Path) -> Clip:
    """Draw a person who opens the mouth four times, blinks four times, and turns the head a little."""
    recipe = SyntheticRecipe(
        width=_SIDE, height=_SIDE, fps=FPS, seconds=_COUNT / FPS, glasses=False, supersample=1, texture_size=768
    )
    scene = SyntheticScene(recipe, 2)
    time = np.arange(_COUNT)
    jaw, blink = np.zeros(_COUNT), np.zeros(_COUNT)
    for start, length, height in _JAW:
        jaw += height * _bump(time, start, length)
    for start, length in _BLINKS:
        blink += _bump(time, start, length)
    turn = np.where(time < STILL, 0, _YAW * np.sin(2 * np.pi * (time - STILL) / 44))
    truth = np.stack([jaw, blink, blink], axis=1)
    names = scene.model.expression_names
    rest = scene.model.neutral(_COUNT)
    expression, rotation = rest.expression.clone(), torch.zeros(_COUNT, 3)
    expression[:, [names.index(name) for name in TRUE]] = torch.from_numpy(truth).float()
    rotation[:, 1] = torch.from_numpy(turn).float()
    first = scene.face[0]
    face = replace(
        rest,
        identity=first.identity,
        expression=expression,
        head_rotation=rotation,
        head_translation=first.head_translation.expand(_COUNT, -1),
    )
    path = folder / "drawn.y4m"
    with path.open("wb") as file:
        file.write(f"YUV4MPEG2 W{WIDTH} H{HEIGHT} F{FPS:.0f}:1 Ip A1:1 C420jpeg\n".encode())
        for step in range(_COUNT):
            posed = pose_subject(scene.subject, face[step], scene.camera.position.numpy())
            camera = scene.camera.in_frame(torch.from_numpy(head_pose(face[step])))
            posed = replace(posed, viewpoint=camera.position.numpy())
            colors, coverage = draw(scene.subject, posed, camera, recipe.supersample)
            image = to_uint8(develop(colors, coverage, scene.background), recipe.noise, np.random.default_rng(step))
            file.write(b"FRAME\n" + cv2.cvtColor(_numbered(image, step), cv2.COLOR_RGB2YUV_I420).tobytes())
    return Clip(path, truth, turn)


def _bump(time: np.ndarray, start: int, length: int) -> np.ndarray:
    """Return a raised cosine, 0 at both ends and 1 in its middle."""
    share = np.clip((time - start) / length, 0, 1)
    return 0.5 - 0.5 * np.cos(2 * np.pi * share)


def _numbered(image: np.ndarray, number: int) -> np.ndarray:
    frame = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    left = (WIDTH - _SIDE) // 2
    frame[:, left : left + _SIDE] = image
    bits = [(number >> bit) & 1 for bit in range(BITS)]
    for cell, bit in enumerate([*bits, sum(bits) & 1]):
        frame[cell * CELL : (cell + 1) * CELL, :CELL] = 255 * bit
    return frame
