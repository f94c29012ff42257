"""Erosion, then dilation of a finished picture: what PointAvatar does about holes between points."""

import torch
from jaxtyping import Float
from torch import Tensor


def close_holes(image: Float[Tensor, "h w c"], reach: int) -> Float[Tensor, "h w c"]:
    """The picture after erosion and dilation, each channel alone.

    Erosion gives each pixel the darkest value around it, dilation the brightest. Bright specks that are at most twice
    `reach` wide go, such as a white background that shows through holes; the rest keeps its size. Transparent pictures
    have no background that could show through.

    Args:
        image: The picture.
        reach: Pixels in every direction that count. 0 changes nothing.
    """
    if reach == 0:
        return image
    planes, side = image.movedim(-1, 0)[None], 2 * reach + 1
    eroded = -torch.nn.functional.max_pool2d(-planes, side, stride=1, padding=reach)
    dilated = torch.nn.functional.max_pool2d(eroded, side, stride=1, padding=reach)
    return dilated[0].movedim(0, -1).contiguous()
