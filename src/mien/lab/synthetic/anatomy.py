"""Places on one subject's head at rest, for the code that paints skin and adds hair and glasses."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from mien.face.model import FaceModel
from mien.lab.synthetic.posing import landmark_positions, rest_vertices
from mien.machine import exact

# MediaPipe's landmark indices. "right" is the subject's right.
LIPS_OUTER = (61, 146, 91, 181, 84, 17, 314, 405, 321, 375, 291, 409, 270, 269, 267, 0, 37, 39, 40, 185)
LIPS_INNER = (78, 95, 88, 178, 87, 14, 317, 402, 318, 324, 308, 415, 310, 311, 312, 13, 82, 81, 80, 191)
UPPER_LIDS = {
    "right": (33, 246, 161, 160, 159, 158, 157, 173, 133),
    "left": (263, 466, 388, 387, 386, 385, 384, 398, 362),
}
LOWER_LIDS = {
    "right": (33, 7, 163, 144, 145, 153, 154, 155, 133),
    "left": (263, 249, 390, 373, 374, 380, 381, 382, 362),
}
BROWS_UPPER = {"right": (107, 66, 105, 63, 70), "left": (336, 296, 334, 293, 300)}
BROWS_LOWER = {"right": (55, 65, 52, 53, 46), "left": (285, 295, 282, 283, 276)}
CHEEKS, NOSE_TIP, FOREHEAD_TOP, CHIN, NOSE_BRIDGE = (50, 280), 4, 10, 152, 168
NOSE_WINGS, NOSE_BASE, MOUTH_TOP, EAR = (129, 358), 2, 0, 234
SIDES = ("right", "left")

_ELEVATIONS, _AZIMUTHS = 64, 128


@dataclass(frozen=True, eq=False)
class Anatomy:
    """A subject at rest, in the head frame, in metres."""

    model: FaceModel
    vertices: Float[np.ndarray, "v 3"]
    normals: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    landmarks: Float[np.ndarray, "l 3"]
    """MediaPipe's 478 points."""

    @cached_property
    def skin(self) -> Bool[np.ndarray, " f"]:
        """Mask of the triangles of the outer skin, lips and lids included."""
        return ~self.region("eyes", "irises", "eye_sockets", "teeth", "tongue", "mouth")

    def region(self, *names: str) -> Bool[np.ndarray, " f"]:
        """Return the mask of the triangles of the named regions."""
        return self.model.region_mask(*names).numpy()

    def eye_vertices(self, side: str) -> Int[np.ndarray, " e"]:
        """Return the vertices of one eyeball."""
        members = np.unique(self.faces[self.region("eyes", "irises")])
        return members[(self.vertices[members, 0] > 0) == (side == "left")]

    def curve(self, indices: tuple[int, ...], points: int) -> Float[np.ndarray, "p 3"]:
        """Return points at equal distances along a chain of landmarks."""
        return resample(self.landmarks[list(indices)], points)

    @cached_property
    def skull_center(self) -> Float[np.ndarray, " 3"]:
        """Approximate centre of the skull. Hair grows away from it."""
        top = self.vertices[:, 1].max()
        forehead = self.landmarks[FOREHEAD_TOP]
        back = self.vertices[np.abs(self.vertices[:, 1] - forehead[1]) < 0.03, 2].min()
        return np.array([0, top - 0.095, 0.5 * (forehead[2] + back)], np.float32)

    @cached_property
    def _radii(self) -> Float[np.ndarray, "e a"]:
        """Distance of the skin from the skull's centre by direction, without the ears."""
        faces = self.faces[self.skin & ~self.region("ears")]
        weights = np.random.default_rng(0).dirichlet((1, 1, 1), (len(faces), 24)).astype(np.float32)
        points = exact.product(weights, self.vertices[faces]).reshape(-1, 3) - self.skull_center
        radius = exact.length(points)
        row, column = _cells(points / radius[:, None])
        radii = np.zeros((_ELEVATIONS, _AZIMUTHS), np.float32)
        np.maximum.at(radii, (row.astype(int) % _ELEVATIONS, column.astype(int) % _AZIMUTHS), radius)
        wrapped = np.tile(radii, (1, 3))
        while (wrapped == 0).any():
            known = (wrapped > 0).astype(np.float32)
            spread = cv2.blur(wrapped, (3, 3)) / np.maximum(cv2.blur(known, (3, 3)), 1e-6)
            wrapped = np.where(wrapped > 0, wrapped, np.where(cv2.blur(known, (3, 3)) > 0.05, spread, 0))
        return cv2.GaussianBlur(wrapped, (0, 0), 1.2)[:, _AZIMUTHS : 2 * _AZIMUTHS]

    def skull_radius(self, directions: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
        """Return the smoothed distance of the skin, without ears, from `skull_center` in unit directions."""
        row, column = _cells(directions)
        wrapped = np.concatenate([self._radii, self._radii[:, :1]], axis=1)
        row = np.clip(row - 0.5, 0, _ELEVATIONS - 1.001)
        column = (column - 0.5) % _AZIMUTHS
        r, c = row.astype(int), column.astype(int)
        fr, fc = (row - r).astype(np.float32), (column - c).astype(np.float32)
        above = wrapped[r, c] * (1 - fc) + wrapped[r, c + 1] * fc
        below = wrapped[r + 1, c] * (1 - fc) + wrapped[r + 1, c + 1] * fc
        return above * (1 - fr) + below * fr

    def hair_share(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Return 1 inside the hairline and 0 outside, with a ramp of 4 mm between."""
        around = np.degrees(np.abs(np.arctan2(points[:, 0], points[:, 2] - self.skull_center[2])))
        eye = self.landmarks[[33, 263], 1].mean()
        nose, mouth, top = (self.landmarks[i, 1] for i in (NOSE_BASE, MOUTH_TOP, FOREHEAD_TOP))
        line = {
            0: top + 0.004, 25: top + 0.003, 42: top - 0.006, 55: eye + 0.040, 64: eye + 0.012, 70: eye - 0.005,
            76: nose + 0.016, 84: nose + 0.016, 90: eye + 0.014, 104: eye + 0.014, 118: nose + 0.018, 140: nose + 0.002,
            180: mouth + 0.012,
        }  # fmt: skip
        threshold = np.interp(around, list(line), list(line.values()))
        return np.clip((points[:, 1] - threshold) / 0.004 + 0.5, 0, 1).astype(np.float32)


def measure_anatomy(model: FaceModel, identity: torch.Tensor) -> Anatomy:
    """Return the anatomy of a person at rest."""
    rest, faces = rest_vertices(model, identity), model.faces.numpy()
    return Anatomy(
        model=model, vertices=rest, normals=exact.vertex_normals(rest, faces), faces=faces,
        landmarks=landmark_positions(model, rest),
    )  # fmt: skip


def resample(corners: Float[np.ndarray, "c 3"], points: int) -> Float[np.ndarray, "p 3"]:
    """Return points at equal distances along a chain of points."""
    lengths = np.concatenate([[0], np.cumsum(exact.length(np.diff(corners, axis=0)))])
    places = np.linspace(0, lengths[-1], points)
    return np.stack([np.interp(places, lengths, corners[:, axis]) for axis in range(3)], -1).astype(np.float32)


def _cells(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return fractional row (elevation) and column (azimuth) in the map of radii."""
    elevation = np.arcsin(np.clip(directions[..., 1], -1, 1)) / np.pi + 0.5
    azimuth = np.arctan2(directions[..., 0], directions[..., 2]) / (2 * np.pi) + 0.5
    return np.clip(elevation * _ELEVATIONS, 0, _ELEVATIONS - 1e-3), azimuth * _AZIMUTHS


class FrontView:
    """An orthographic view of the face from the front, to paint on and to sample at points of the skin by (x, y)."""

    def __init__(
        self, low: Float[np.ndarray, " 2"], high: Float[np.ndarray, " 2"], texels_per_meter: float = 5000.0
    ) -> None:
        self._origin = low.astype(np.float32)
        self._scale = texels_per_meter
        width, height = (float(extent) for extent in high - low)
        self.shape = (round(height * texels_per_meter), round(width * texels_per_meter))

    def pixels(self, points: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "n 2"]:
        """Return columns and rows of points; rows go up."""
        return (points[:, :2] - self._origin) * self._scale

    def polygon(self, corners: Float[np.ndarray, "c 3"], blur: float) -> Float[np.ndarray, "h w"]:
        """Return a filled outline with edges softened over `blur` metres."""
        image = np.zeros(self.shape, np.uint8)
        cv2.fillPoly(image, [np.round(self.pixels(corners) * 16).astype(np.int32)], 255, cv2.LINE_AA, 4)
        return self._soften(image, blur)

    def line(self, corners: Float[np.ndarray, "c 3"], width: float, blur: float) -> Float[np.ndarray, "h w"]:
        """Return a softened line of `width` metres."""
        image = np.zeros(self.shape, np.uint8)
        points = np.round(self.pixels(corners) * 16).astype(np.int32)
        cv2.polylines(image, [points], False, 255, max(round(width * self._scale), 1), cv2.LINE_AA, 4)
        return self._soften(image, blur)

    def _soften(self, image: np.ndarray, blur: float) -> Float[np.ndarray, "h w"]:
        return cv2.GaussianBlur(image.astype(np.float32) / 255, (0, 0), max(blur * self._scale, 0.3))

    def look_up(self, image: Float[np.ndarray, "h w"], points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Sample the painting at points in space; 0 outside."""
        place = self.pixels(points).astype(np.float32)
        # remap supports at most 32767 texels a side
        rows = -(-len(place) // 4096)
        padded = np.full((rows * 4096, 2), -1e4, np.float32)
        padded[: len(place)] = place - 0.5
        x, y = (np.ascontiguousarray(padded[:, axis]).reshape(rows, 4096) for axis in range(2))
        return cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT).reshape(-1)[: len(place)]


def face_view(anatomy: Anatomy) -> FrontView:
    """Return a front view that contains the whole face."""
    low, high = anatomy.landmarks.min(0) - 0.01, anatomy.landmarks.max(0) + 0.02
    return FrontView(low[:2], high[:2])
