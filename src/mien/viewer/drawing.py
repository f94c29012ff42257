"""Pictures for the viewer: Gaussians, mesh and wireframe from the view of a browser, beside the filmed frame.

Gaussians are drawn without torch; the mesh, and what a camera films, need the packages of `mien[create]`.
"""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float, Float32, Int32, UInt8

from mien import runtime
from mien.media.pixels import to_rgb
from mien.runtime.filmed import head_angles
from mien.runtime.posing import rig_points

if TYPE_CHECKING:
    import torch

Surface = Literal["avatar", "mesh", "confidence"]
"""What is drawn: the Gaussians, the grey mesh of the face model, or the mesh in the colours of its confidence."""
BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "grey": (0.5, 0.5, 0.5), "black": (0.0, 0.0, 0.0)}
_FILLED_IN, _SEEN = (0.93, 0.45, 0.30), (0.25, 0.55, 0.80)
"""Colours of the mesh where nothing was filmed, and where everything was: those of the report."""
MIN_SIDE, MAX_SIDE = 16, 2048
"""Smallest and largest side of a picture, in pixels."""


@dataclass(frozen=True, eq=False)
class View:
    """The view of one browser."""

    viewmat: Float[np.ndarray, "4 4"]
    """T_camera_world with OpenCV axes, in metres."""
    field: float
    """Vertical field of view in radians."""
    width: int
    """Width of the browser's canvas in pixels."""
    height: int
    """Height of the browser's canvas in pixels."""

    def sized(self, height: int) -> tuple[int, int]:
        """Width and height of a picture with the shape of the canvas, at most `height` pixels high."""
        scale = min(1.0, height / max(1, self.height), MAX_SIDE / max(1, self.width))
        wide, high = (round(scale * side) for side in (self.width, self.height))
        return min(MAX_SIDE, max(MIN_SIDE, wide)), min(MAX_SIDE, max(MIN_SIDE, high))

    def camera(self, width: int, height: int, scale: float = 1.0) -> runtime.Camera:
        """The camera of a picture of this view. Its shape may differ from that of the canvas.

        `scale` makes what it shows smaller or larger, about the middle.
        """
        focal = scale * 0.5 * height / math.tan(0.5 * self.field)
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], np.float32)
        return runtime.Camera(K, self.viewmat.astype(np.float32), width, height)

    @property
    def is_possible(self) -> bool:
        """Whether a picture can be drawn of it. A hidden browser window has no size."""
        return bool(np.isfinite(self.viewmat).all()) and 0 < self.field < math.pi and min(self.width, self.height) > 0

    @property
    def position(self) -> Float[np.ndarray, " 3"]:
        """The camera's centre in world space, in metres."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]


@dataclass(frozen=True, eq=False)
class Mesh:
    """The mesh of an avatar's face model."""

    rig: runtime.Rig
    faces: Int32[np.ndarray, "f 3"]
    seen: Float32[np.ndarray, " f"] | None = None
    """Confidence of each triangle, 0..1: how well the training pictures show it. None if that is not known."""


@dataclass(frozen=True)
class Look:
    """What a picture shows, and how."""

    surface: Surface = "avatar"
    wireframe: bool = False
    """Whether the edges of the mesh are drawn over it."""
    background: str = "white"
    """Name of the background's colour in `BACKGROUNDS`."""


def draw(
    gaussians: runtime.Gaussians, face: runtime.Face, mesh: Mesh | None, look: Look, camera: runtime.Camera
) -> UInt8[np.ndarray, "h w 3"]:
    """The picture of a posed avatar. Without a mesh, the avatar alone is drawn."""
    background = BACKGROUNDS[look.background]
    if mesh is None or (look.surface == "avatar" and not look.wireframe):
        return to_rgb(runtime.render(gaussians, camera, background)[0])
    import torch

    from mien.camera import Camera
    from mien.render.mesh import Headlight, rasterize_mesh, render_mesh

    vertices = torch.from_numpy(rig_points(mesh.rig, face, in_world=True))
    faces = torch.from_numpy(mesh.faces.astype(np.int64))
    seen_by = Camera(torch.from_numpy(camera.K), torch.from_numpy(camera.viewmat), camera.width, camera.height)
    if look.surface == "avatar":
        picture = to_rgb(runtime.render(gaussians, camera, background)[0])
    else:
        colors = _confidence_colors(mesh) if look.surface == "confidence" and mesh.seen is not None else None
        image = render_mesh(vertices, faces, seen_by, colors, light=Headlight(), background=background)[0]
        picture = to_rgb(image.numpy())
    if look.wireframe:
        picture = _with_edges(picture, rasterize_mesh(vertices, faces, seen_by).face_index.numpy())
    return picture


def _confidence_colors(mesh: Mesh) -> "torch.Tensor":
    """Colours of the triangles' corners, [f, 3, 3]."""
    import torch

    assert mesh.seen is not None
    seen = torch.from_numpy(mesh.seen)[:, None]
    mixed = torch.lerp(torch.tensor(_FILLED_IN), torch.tensor(_SEEN), seen)
    return mixed[:, None].expand(-1, 3, -1).contiguous()


def _with_edges(picture: UInt8[np.ndarray, "h w 3"], index: Int32[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """The picture with a line wherever two neighbours show different triangles."""
    edge = np.zeros(index.shape, bool)
    edge[:, 1:] |= index[:, 1:] != index[:, :-1]
    edge[1:] |= index[1:] != index[:-1]
    lined = picture.copy()
    lined[edge] = (0.6 * np.array([40, 90, 220], np.float32) + (1 - 0.6) * picture[edge]).astype(np.uint8)
    return lined


def beside(
    filmed: UInt8[np.ndarray, "_ _ 3"], shown: UInt8[np.ndarray, "h w 3"], background: str
) -> UInt8[np.ndarray, "h _ 3"]:
    """A filmed frame in the left half, as large as fits, and the avatar in the right half."""
    height, width = shown.shape[:2]
    fitted = _resized(filmed, height / filmed.shape[0] * shrunk(filmed.shape[1], filmed.shape[0], width, height))
    high, wide = fitted.shape[:2]
    left = np.full((height, width, 3), [round(255 * part) for part in BACKGROUNDS[background]], np.uint8)
    top, start = (height - high) // 2, (width - wide) // 2
    left[top : top + high, start : start + wide] = fitted
    return np.concatenate([left, shown], axis=1)


def shrunk(filmed_width: int, filmed_height: int, width: int, height: int) -> float:
    """How much smaller what was filmed is that fits a picture than one that only has the picture's height, at most 1.

    The avatar is drawn as much smaller: then it fits a phone that is held upright, and beside a filmed frame both heads
    have one size.
    """
    return min(1.0, width * filmed_height / (filmed_width * height))


def _resized(picture: UInt8[np.ndarray, "_ _ 3"], scale: float) -> UInt8[np.ndarray, "_ _ 3"]:
    import cv2

    size = max(1, round(scale * picture.shape[1])), max(1, round(scale * picture.shape[0]))
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)


def in_corner(seen: UInt8[np.ndarray, "_ _ 3"], shown: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """The picture with what the camera saw in its lower left corner."""
    height, width = shown.shape[:2]
    small = _resized(seen, min(0.25 * height / seen.shape[0], 0.25 * width / seen.shape[1]))
    high, wide = small.shape[:2]
    bottom, left = height - round(0.02 * height), min(round(0.02 * height), width - wide)
    picture = shown.copy()
    picture[bottom - high : bottom, left : left + wide] = small
    return picture


def words_about_view(filmed: runtime.Filmed | None, face: runtime.Face, view: View) -> str:
    """One line about whether the camera sees a side of the head that was filmed."""
    if filmed is None:
        return "It is not known which sides were filmed."
    angles = head_angles(face.head_rotation[None], face.head_translation[None], view.position)[0]
    low, high = filmed.head_angles[:, 0], filmed.head_angles[:, 1]
    beyond = np.degrees(np.maximum(np.maximum(low - angles, angles - high), 0))
    if beyond.max() < 1:
        return "This side was filmed."
    ways = [f"{beyond[k]:.0f}° {('sideways', 'up or down')[k]}" for k in (0, 1) if beyond[k] >= 1]
    return f"Beyond what was filmed by {' and '.join(ways)}: what you see there is made up."
