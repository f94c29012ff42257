"""Image metrics: pure functions of float32 RGB images in 0..1."""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from mien.camera import Box
from mien.training.losses import C1, C2, WINDOW_RADIUS, WINDOW_SIGMA

Border = Literal["zeros", "inside"]
"""Windows of SSIM at the border of a picture: with zeros beyond it, or only those that lie inside."""
MAX_PSNR = 100.0
"""PSNR of identical images in dB, so that results stay finite."""


def crop_to(image: Shaped[Tensor, "h w *c"], box: Box | None) -> Shaped[Tensor, "y x *c"]:
    """The part of an image inside `box`, cut at the image's border, or the whole image if the box is None."""
    if box is None:
        return image
    left, top, width, height = box
    cut = image[max(top, 0) : max(top + height, 0), max(left, 0) : max(left + width, 0)]
    assert min(cut.shape[:2]) > 0, f"box {box} does not meet the {image.shape[1]}x{image.shape[0]} image"
    return cut


def l1(image: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"]) -> float:
    """Mean absolute difference over all channels, 0..1."""
    return float((image - target).abs().double().mean())


def psnr(image: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], box: Box | None = None) -> float:
    """Peak signal-to-noise ratio in dB for a peak of 1: -10 log10 of the mean squared difference.

    The mean is over the channels of the pixels in `box`, in double precision. The result is at most `MAX_PSNR`. The
    figure for a set of frames is the mean of the figures of its frames, as is usual in the field.
    """
    squared = ((crop_to(image, box) - crop_to(target, box)) ** 2).double().mean()
    return float(-10 * torch.log10(squared.clamp_min(10 ** (-MAX_PSNR / 10))))


@dataclass(frozen=True, eq=False)
class Windows:
    """The means and variances that SSIM needs of one picture. Pictures compared with one target share the target's."""

    picture: Float[np.ndarray, "h w 3"]
    mean: Float[np.ndarray, "h w 3"]
    """Mean in the window around each pixel."""
    squared_mean: Float[np.ndarray, "h w 3"]
    variance: Float[np.ndarray, "h w 3"]

    @staticmethod
    def of(image: Float[Tensor, "h w 3"]) -> "Windows":
        """The windows of a picture."""
        picture = np.ascontiguousarray(image.detach().cpu().numpy())
        mean = _blur(picture)
        squared = mean * mean
        variance = _blur(picture * picture)
        return Windows(picture, mean, squared, np.subtract(variance, squared, out=variance))


def ssim(image: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"] | Windows, border: Border = "zeros") -> float:
    """Structural similarity (Wang et al. 2004): the mean of `ssim_map` over pixels and channels.

    With `inside`, pixels whose window reaches beyond the picture do not count, unless the picture is smaller than that.
    """
    found, r = ssim_map(image, target), WINDOW_RADIUS
    if border == "inside" and min(found.shape[:2]) > 2 * r:
        found = found[r:-r, r:-r]
    return float(found.double().mean())


def ssim_map(image: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"] | Windows) -> Float[Tensor, "h w 3"]:
    """Structural similarity of every pixel and channel, -1..1.

    The definition is that of training codes for 3D Gaussians: an 11x11 Gaussian window of sigma 1.5, zeros beyond the
    border, C1 = 0.01^2 and C2 = 0.03^2 for a range of 1, and each channel separately. That of the loss
    (`differentiable_ssim_map`) has the same definition, but other rounding: OpenCV blurs twenty times as fast as torch,
    and scores need no gradient.
    """
    x, y = Windows.of(image), target if isinstance(target, Windows) else Windows.of(target)
    # Work in place, because large new buffers cost as much as the arithmetic on them.
    product = x.mean * y.mean
    covariance = _blur(x.picture * y.picture)
    covariance -= product
    for shared in (product, covariance):
        shared *= 2
    product += C1
    covariance += C2
    squares, variances = x.squared_mean + y.squared_mean, x.variance + y.variance
    squares += C1
    variances += C2
    product /= squares
    covariance /= variances
    product *= covariance
    return torch.from_numpy(product)


def _blur(image: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """The mean around every pixel, weighted by the Gaussian window, with zeros beyond the border."""
    offsets = np.arange(-WINDOW_RADIUS, WINDOW_RADIUS + 1)
    window = np.exp(-(offsets**2) / (2 * WINDOW_SIGMA**2)).astype(image.dtype)
    window = window / window.sum()
    return cv2.sepFilter2D(image, -1, window, window, borderType=cv2.BORDER_CONSTANT)
