"""The input of an evaluation: an avatar, the sequences it was trained on, and the frames it has never seen."""

import copy
from collections.abc import Sequence as Items
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from mien.avatar.avatar import Avatar, move_avatar
from mien.camera import Box, Camera
from mien.face.head_parts import part_boxes
from mien.face.params import FaceParams
from mien.gaussians import Gaussians, Rendering
from mien.render import rasterize
from mien.render.rasterize import close_holes
from mien.render.validation import drawable
from mien.tracking.scoring import Scoring
from mien.training.colors import lit
from mien.training.footage.clothes import clothes_mask
from mien.training.footage.foreground import foreground_colors
from mien.training.footage.frames import Frame
from mien.training.footage.sequence import Sequence, composite

FaceSource = Literal["as_tracked", "corrected"]
"""Face parameters of held-out frames: as the tracker left them, or corrected by what training changed in neighbouring
frames; a held-out sequence takes the mean change of the head's pose. Corrections never use the pixels of held-out
frames."""

Edges = Literal["cleaned", "filmed"]
"""Colours of the truth where the matte is soft: those of the person alone (`foreground_colors`), or as filmed, with
a share of the background behind the person."""

WHITE, DARK = (255, 255, 255), (26, 32, 80)
"""Backgrounds of scored pictures, 0 to 255. An avatar that lets a white background through where the person is light
or thin, as hair is, looks right over white alone. Dark blue shows it."""
_HEAD_MARGIN = 0.05


@dataclass(frozen=True, eq=False)
class Experiment:
    """Everything that an evaluation reads."""

    avatar: Avatar
    sequences: tuple[Sequence, ...]
    faces: tuple[FaceParams, ...]
    """Face parameters that pose the avatar: one entry per sequence, with all its timesteps."""
    face_source: FaceSource
    scorings: tuple[Scoring, ...]
    """The frozen masks and head crops, one entry per sequence."""
    training_frames: tuple[Frame, ...]
    held_out_frames: tuple[Frame, ...]
    split: str
    """Name of the split: `blocks`, `tail`, `sequences`, `cameras`."""
    edges: Edges = "cleaned"
    whole_mattes: bool = False
    """Whether the scored pixels are those of the capture's mattes, without mien's cut at the neck."""
    clothes: tuple[UInt8[np.ndarray, "t h p"] | None, ...] = ()
    """Packed masks of clothes of each sequence, where its dataset has some. Empty if no protocol asks for them."""
    gains: tuple[Float[Tensor, "t 3"], ...] = ()
    """Gain of each timestep of each sequence, by which renderings are multiplied. Empty if the light is steady."""
    digests: tuple[dict[str, str], ...] = ()
    """The hashes of the `pictures` and the `mask` of each sequence. Empty if nothing was read from disk."""

    def camera(self, frame: Frame) -> Camera:
        """The camera of a frame."""
        return self.sequences[frame.sequence].tracking.cameras[frame.camera]

    def camera_id(self, frame: Frame) -> str:
        """The name of a frame's camera."""
        return self.sequences[frame.sequence].capture.camera_ids[frame.camera]

    def crop(self, frame: Frame) -> Box:
        """The head crop that was frozen together with the scoring mask."""
        left, top, width, height = (int(value) for value in self.scorings[frame.sequence].crops[frame[1:]])
        return left, top, width, height

    @torch.no_grad()
    def parts(self, frame: Frame) -> dict[str, Box]:
        """The boxes of eyes and mouth, by the tracked mesh as the tracker left it, so that runs share them."""
        face_model = self.avatar.face_model
        vertices = face_model(self.sequences[frame.sequence].tracking.face[frame.timestep])[0]
        return part_boxes(face_model, vertices, self.camera(frame))

    def clothes_of(self, frame: Frame) -> Bool[np.ndarray, "h w"] | None:
        """Return where a picture shows clothes, or None if nothing tells."""
        packed = self.clothes[frame.sequence] if self.clothes else None
        return None if packed is None else clothes_mask(packed, frame.timestep, self.camera(frame).width)

    def lit(self, rendering: Rendering, background: Float[Tensor, " 3"], frame: Frame) -> Rendering:
        """A rendering of the avatar in the light of a frame. The background keeps its colour."""
        if not self.gains:
            return rendering
        return lit(rendering, background, self.gains[frame.sequence][frame.timestep].to(background))

    def face(self, frame: Frame) -> FaceParams:
        """The face parameters of one timestep."""
        return self.faces[frame.sequence][frame.timestep]


def moved(experiment: Experiment, like: Tensor) -> Experiment:
    """The experiment with a copy of its avatar, which draws on the device of `like`. Pictures come back to the CPU."""
    avatar = copy.deepcopy(experiment.avatar)
    move_avatar(avatar, like)
    return replace(experiment, avatar=avatar)


def head_box(experiment: Experiment, frames: Items[Frame]) -> Box:
    """A box around the head crops of some frames, with a margin. One box for all frames keeps motion visible."""
    crops = np.array([experiment.crop(frame) for frame in frames])
    left, top = crops[:, :2].min(0)
    right, bottom = (crops[:, :2] + crops[:, 2:]).max(0)
    margin = int(_HEAD_MARGIN * max(right - left, bottom - top))
    return int(left) - margin, int(top) - margin, int(right - left) + 2 * margin, int(bottom - top) + 2 * margin


def target_image(
    experiment: Experiment, frame: Frame, background: tuple[int, int, int] = WHITE
) -> Float[Tensor, "h w 3"]:
    """The target of a rendering, at 8 bits: the person inside the frozen scoring mask or the matte, over a colour."""
    return target_images(experiment, frame, (background,))[0]


def target_images(
    experiment: Experiment, frame: Frame, backgrounds: Items[tuple[int, int, int]]
) -> list[Float[Tensor, "h w 3"]]:
    """`target_image` over several colours. The picture is read and cleaned once."""
    capture = experiment.sequences[frame.sequence].capture
    picture = np.asarray(capture.images[frame[1:]])
    if experiment.edges == "cleaned":
        picture = foreground_colors(picture, np.asarray(capture.mattes[frame[1:]]))
    masks = capture.mattes if experiment.whole_mattes else experiment.scorings[frame.sequence].masks
    mask = np.asarray(masks[frame[1:]])
    return [torch.from_numpy(composite(picture, mask, np.array(each, np.uint8))).float() / 255 for each in backgrounds]


def scored_on(experiment: Experiment, frames: Items[Frame]) -> dict[str, dict[str, str]]:
    """The hashes of pictures and mask of each sequence among some frames. Only figures with equal hashes compare."""
    if not experiment.digests:
        return {}
    return {experiment.sequences[i].name: experiment.digests[i] for i in sorted({frame.sequence for frame in frames})}


def avatar_image(
    experiment: Experiment,
    frame: Frame,
    face: FaceParams | None = None,
    background: tuple[int, int, int] = WHITE,
) -> Float[Tensor, "h w 3"]:
    """The avatar posed and seen as in a frame, over a colour, clamped to 0..1.

    `face` poses the avatar instead of the experiment's face parameters.
    """
    return drawn_image(experiment, frame, posed_avatar(experiment, frame, face), background)


@torch.no_grad()
def posed_avatar(experiment: Experiment, frame: Frame, face: FaceParams | None = None) -> Gaussians:
    """The avatar posed as in a frame, or by other face parameters."""
    face = experiment.face(frame) if face is None else face
    return experiment.avatar.pose(face.to(experiment.avatar.face_model.template)).gaussians.timestep(0)


@torch.no_grad()
def drawn_image(
    experiment: Experiment, frame: Frame, gaussians: Gaussians, background: tuple[int, int, int] = WHITE
) -> Float[Tensor, "h w 3"]:
    """Gaussians of `posed_avatar` seen as in a frame, over a colour, clamped to 0..1."""
    color = (torch.tensor(background) / 255).to(gaussians.means)
    with drawable(f"{experiment.sequences[frame.sequence].name}, timestep {frame.timestep}", "train again"):
        drawn = rasterize(gaussians, experiment.camera(frame).to(color), color)
    image = experiment.lit(drawn, color, frame).image.clamp(0, 1)
    return close_holes(image, experiment.avatar.extras.closing).cpu()
