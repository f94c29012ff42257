"""A drawn head as a webcam: pictures of a known motion, which a page sees one after the other at the pace of a test."""

import base64
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Float

from mien.lab.synthetic import SyntheticRecipe, SyntheticScene
from mien.lab.synthetic.painter import develop, draw, to_uint8
from mien.lab.synthetic.posing import head_pose
from mien.lab.synthetic.subject import pose_subject

STILL = 12
"""Pictures at the start in which nothing moves."""
TRUE = ("jawOpen", "eyeBlinkLeft", "eyeBlinkRight")
_SIDE = 360
_JAW, _BLINKS = ((14, 14, 0.6), (34, 12, 0.4)), ((24, 7), (46, 7))
_COUNT = 56
_YAW = 0.12
CAMERA = """(() => {
  const picture = new OffscreenCanvas(360, 360), brush = picture.getContext("2d"), make = createImageBitmap;
  const { postMessage } = Worker.prototype;
  let see = () => {}, answered = () => {};
  HTMLVideoElement.prototype.requestVideoFrameCallback = (callback) => void (see = callback);
  window.createImageBitmap = () => make(picture);
  Worker.prototype.postMessage = function (message, moved) {
    if (message.picture) this.addEventListener("message", () => setTimeout(answered), { once: true });
    postMessage.call(this, message, moved);
  };
  let milliseconds = 0;
  window.film = async (address) => {
    const image = new Image(), done = new Promise((resolve) => (answered = resolve));
    image.src = address;
    await image.decode();
    brush.drawImage(image, 0, 0);
    see((milliseconds += 250));
    await done;
  };
})()"""
"""Lets `film` show the page a picture, 0.25 s after the last one, and wait until the detector has seen it."""


@dataclass(frozen=True)
class Clip:
    """Pictures, and what they show."""

    pictures: list[str]
    """Addresses that hold the pictures themselves."""
    truth: Float[np.ndarray, "t 3"]
    """Coefficients of `TRUE` at each frame."""
    yaw: Float[np.ndarray, " t"]
    """Turn of the head to the person's left, in radians."""


def draw_clip() -> Clip:
    """Draw a person who opens the mouth twice, blinks twice, and turns the head a little."""
    recipe = SyntheticRecipe(
        width=_SIDE, height=_SIDE, fps=4.0, seconds=_COUNT / 4, glasses=False, supersample=1, texture_size=512
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
    pictures = []
    for step in range(_COUNT):
        posed = pose_subject(scene.subject, face[step], scene.camera.position.numpy())
        camera = scene.camera.in_frame(torch.from_numpy(head_pose(face[step])))
        posed = replace(posed, viewpoint=camera.position.numpy())
        colors, coverage = draw(scene.subject, posed, camera, recipe.supersample)
        image = to_uint8(develop(colors, coverage, scene.background), recipe.noise, np.random.default_rng(step))
        _, packed = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
        pictures.append("data:image/jpeg;base64," + base64.b64encode(packed.tobytes()).decode())
    return Clip(pictures, truth, turn)


def _bump(time: np.ndarray, start: int, length: int) -> np.ndarray:
    """Return a raised cosine, 0 at both ends and 1 in its middle."""
    share = np.clip((time - start) / length, 0, 1)
    return 0.5 - 0.5 * np.cos(2 * np.pi * share)
