"""Draw a hand in front of the mouth of a synthetic person, for the tests of what hides a face."""

from dataclasses import replace

import cv2
import numpy as np

from mien.capture.capture import Capture

_MOUTH, _EYES, _FOREHEAD = (61, 291, 0, 17), (33, 263), 151
_FINGERS = (-0.42, -0.14, 0.14, 0.40)
"""Places of the fingers beside each other, in distances of the outer corners of the eyes."""


def with_hand(capture: Capture, frames: list[int]) -> Capture:
    """The capture with a moving hand of the colour of the person's forehead in front of the mouth in some frames."""
    images, mattes = np.array(capture.images), np.array(capture.mattes)
    for timestep in frames:
        marks = capture.landmarks[timestep, 0]
        hand, shade = _hand(marks, timestep, images.shape[2:4])
        x, y = marks[_FOREHEAD].round().astype(int)
        skin = images[timestep, 0, y - 2 : y + 3, x - 2 : x + 3].reshape(-1, 3).mean(0)
        random = np.random.default_rng(timestep)
        drawn = skin * shade[..., None] + random.normal(0, 1.5, (*shade.shape, 3))
        share = hand[..., None]
        mixed = images[timestep, 0] * (1 - share) + drawn * share
        images[timestep, 0] = mixed.clip(0, 255).round().astype(np.uint8)
        mattes[timestep, 0] = np.maximum(mattes[timestep, 0], (255 * hand).astype(np.uint8))
    return replace(capture, images=images, mattes=mattes)


def with_slab(capture: Capture, frames: list[int], group: tuple[int, ...]) -> Capture:
    """The capture with a dark slab, such as a phone, in front of some landmarks in some frames."""
    images = np.array(capture.images)
    for timestep in frames:
        marks = capture.landmarks[timestep, 0]
        unit = float(np.linalg.norm(marks[_EYES[0]] - marks[_EYES[1]]))
        x, y = marks[list(group)].mean(0) + 0.1 * unit * np.sin(0.3 * timestep + np.array([0, 1]))
        wide, high = 0.75 * unit, 0.45 * unit
        columns, rows = slice(round(x - wide), round(x + wide)), slice(round(y - high), round(y + high))
        images[timestep, 0, rows, columns] = (38, 40, 46)
    return replace(capture, images=images)


def _hand(marks: np.ndarray, timestep: int, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """The opacity of a hand with four fingers that point upwards, and its brightness relative to the skin."""
    unit = float(np.linalg.norm(marks[_EYES[0]] - marks[_EYES[1]]))
    sway = np.array([0.10 * np.sin(0.31 * timestep), 0.06 * np.sin(0.23 * timestep + 1)])
    middle = marks[list(_MOUTH)].mean(0) + unit * sway
    angle = 0.25 * np.sin(0.17 * timestep)
    down, across = np.array([np.sin(angle), np.cos(angle)]), np.array([np.cos(angle), -np.sin(angle)])
    # Drawn at four times the size, then averaged: soft edges.
    large = tuple(4 * side for side in size)
    hand, shade = np.zeros(large, np.float32), np.ones(large, np.float32)

    def capsule(start: np.ndarray, end: np.ndarray, radius: float, light: float) -> None:
        first, last = ((4 * point).round().astype(int).tolist() for point in (start, end))
        for step in range(6):  # brighter in the middle of a finger, with a dark rim
            width = max(round(4 * 2 * radius * (1 - step / 8)), 1)
            cv2.line(shade, first, last, light * (0.82 + 0.18 * (1 - (1 - step / 5) ** 2)), width)
        cv2.line(hand, first, last, 1.0, round(8 * radius))

    knuckles = middle + 0.35 * unit * down
    capsule(knuckles + 0.25 * unit * down, knuckles + 1.2 * unit * down, 0.48 * unit, 0.95)
    for number, place in enumerate(_FINGERS):
        base = knuckles + unit * place * across
        reach = (0.62, 0.74, 0.72, 0.60)[number] + 0.05 * np.sin(0.4 * timestep + number)
        capsule(base + 0.3 * unit * down, base - unit * reach * down, 0.135 * unit, 1.0 - 0.03 * number)
    hand, shade = (cv2.resize(drawn, size[::-1], interpolation=cv2.INTER_AREA) for drawn in (hand, shade))
    return hand, shade
