"""Erosion, then dilation of a finished picture: what PointAvatar does about holes between points."""

import torch
from jaxtyping import Float
from torch import Tensor


def close_holes(image: Float[Tensor, "h w c"], side: int) -> Float[Tensor, "h w c"]:
    """The picture after erosion and dilation by squares, each channel alone.

    Erosion gives each pixel the darkest value around it, dilation the brightest. Bright specks that are narrower than
    the square go, such as a white background that shows through holes; the rest keeps its size. For transparent
    pictures this has to be done over the background.

    Args:
        image: The picture.
        side: Side of the square in pixels, odd. 1 changes nothing.
    """
    assert side % 2 == 1, f"the side of the square is {side}, but needs a middle pixel"
    if side == 1:
        return image
    planes = image.movedim(-1, 0)[None]
    eroded = -torch.nn.functional.max_pool2d(-planes, side, stride=1, padding=side // 2)
    dilated = torch.nn.functional.max_pool2d(eroded, side, stride=1, padding=side // 2)
    return dilated[0].movedim(0, -1).contiguous()
