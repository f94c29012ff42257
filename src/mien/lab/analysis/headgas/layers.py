"""Gaussians removed gradually, from near to far along the view (Fig. 2 of the supplement)."""

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from mien.camera import Camera
from mien.gaussians import Gaussians, world_means
from mien.lab.analysis.context import Context
from mien.lab.analysis.result import Film, PartResult, Picture
from mien.lab.analysis.views import draw_avatar, head_camera, labeled, mouth_camera
from mien.media.pictures import side_by_side
from mien.media.video import write_video

_SHARES = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5)
"""Shares of the Gaussians in view that pictures lack."""
SIDE = 224
"""Width and height of a picture, in pixels."""
_FRAMES, _FPS = 75, 25
_FAINT = 1 / 255
"""Opacity below which a Gaussian is not drawn."""


def layers(context: Context) -> PartResult:
    """The avatar at rest, and its mouth, without the nearest Gaussians."""
    avatar, model = context.avatar, context.avatar.face_model
    with torch.no_grad():
        gaussians = avatar.pose(avatar.subject).gaussians.timestep(0)
    views = {
        "head": head_camera(model, avatar.subject, context.camera, SIDE),
        "mouth": mouth_camera(model, avatar.subject, context.camera, SIDE),
    }
    orders = {name: near_to_far(gaussians, camera) for name, camera in views.items()}
    pictures, values = [], {"gaussians": len(gaussians), "faint": int((gaussians.opacities < _FAINT).sum())}
    for name, camera in views.items():
        values[f"in_{name}"] = len(orders[name])
        drawn = [
            labeled(_without(context, camera, orders[name], share), f"without {100 * share:.0f} %") for share in _SHARES
        ]
        caption = (
            f"The {name} of the person at rest, without the nearest Gaussians among the {len(orders[name]):,} in view."
        )
        pictures.append(Picture(f"layers-{name}", side_by_side(drawn), caption))
    write_video(context.folder / "layers.mp4", _film(context, views, orders), _FPS)
    faint = values["faint"] / max(len(gaussians), 1)
    return PartResult(
        values,
        (
            f"{100 * faint:.0f} % of the {len(gaussians):,} Gaussians are not drawn in this expression, because "
            "they are fainter than 1/255.",
        ),
        pictures=tuple(pictures),
        films=(Film("layers.mp4", "Head and mouth, while up to half of the Gaussians in view are removed."),),
        notes=(
            "The supplement finds teeth behind closed lips. Look whether they appear here too: that needs frames with "
            "visible teeth.",
            "Only Gaussians that are drawn and whose centre is in the picture count. White shows through where no "
            "Gaussian is behind, because no frame shows what is there.",
        ),
    )


def near_to_far(gaussians: Gaussians, camera: Camera) -> Int[Tensor, " p"]:
    """Indices of the Gaussians that a camera draws and whose centre it sees, nearest first."""
    pixels, depth = camera.project(world_means(gaussians))
    size = pixels.new_tensor([camera.width, camera.height])
    seen = ((pixels >= 0) & (pixels < size)).all(-1) & (depth > 0) & (gaussians.opacities >= _FAINT)
    indices = seen.nonzero()[:, 0]
    return indices[depth[indices].argsort(stable=True)]


def without_nearest(count: int, order: Int[Tensor, " p"], share: float) -> Bool[Tensor, " n"]:
    """All of `count` Gaussians but the first of `order`, of which `share` is left out."""
    kept = torch.ones(count, dtype=torch.bool)
    kept[order[: round(share * len(order))]] = False
    return kept


def _without(context: Context, camera: Camera, order: Tensor, share: float) -> np.ndarray:
    kept = without_nearest(len(context.avatar.gaussian_store()), order, share)
    return draw_avatar(context.avatar, context.avatar.subject, camera, kept)


def _film(context: Context, views: dict[str, Camera], orders: dict[str, Tensor]) -> Iterator[np.ndarray]:
    for frame in range(_FRAMES):
        share = _SHARES[-1] * frame / (_FRAMES - 1)
        pair = side_by_side([_without(context, camera, orders[name], share) for name, camera in views.items()])
        yield labeled(pair, f"without {100 * share:.0f} %")
