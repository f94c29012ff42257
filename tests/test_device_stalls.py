"""Nothing between posing and the optimiser may read a number of a GPU: the host would wait, every step, for all of it.

There need not be a GPU: tensors on torch's `meta` device have no numbers, so that whoever asks for one raises.
"""

import pytest
import torch
from torch import Tensor

from mien.avatar import GaussianAvatarsConfig, Photometric, Progress, method_named
from mien.avatar.store import Moments
from mien.face import load_face_model
from mien.render.rendering import Rendering
from mien.training.adam import Adam
from mien.training.density import density_strategy
from mien.training.losses import picture_losses
from mien.training.sequence import Target

META = torch.zeros((), device="meta")
HEIGHT, WIDTH = 24, 32


def test_meta_tensors_show_who_asks_for_a_number() -> None:
    for ask in (Tensor.item, bool, Tensor.tolist, Tensor.nonzero, Tensor.cpu):
        with pytest.raises((RuntimeError, NotImplementedError)):
            ask(META + 1)


@pytest.mark.parametrize("sh_degree", [0, 3])
def test_a_step_of_gaussian_avatars_asks_for_no_number(sh_degree: int) -> None:
    face_model = load_face_model().to(META)
    face = load_face_model().neutral(1).to(META)
    config = GaussianAvatarsConfig(sh_degree=sh_degree)
    avatar = method_named("gaussian_avatars").avatar(config, face_model, face)
    density, adam, progress = density_strategy(avatar.density(), avatar.gaussian_store()), Adam(), Progress(3, 10, 0)
    for _ in range(2):
        posed = avatar.pose(face, progress)
        rendering = _rendered(posed.gaussians.timestep(0))
        losses = picture_losses(rendering, _target(), Photometric(alpha_weight=0.1))
        losses |= avatar.regularizers(posed, rendering, progress)
        torch.stack(list(losses.values())).sum().backward()
        density.observe(posed, rendering)
        adam.step(avatar.parameter_groups(), progress)


def test_steps_are_counted_on_the_host() -> None:
    assert Moments.zeros(META).step.device.type == "cpu"


def _rendered(gaussians) -> Rendering:
    """What a rasterizer would return, with the same dependences."""
    count = len(gaussians)
    offset = torch.zeros(count, 2, device="meta", requires_grad=True)
    parts = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh, offset)
    value = torch.stack([part.sum() for part in parts]).sum()
    image = value + torch.zeros(HEIGHT, WIDTH, 3, device="meta")
    return Rendering(image, image[..., 0], torch.ones(count, dtype=torch.int32, device="meta"), offset)


def _target() -> Target:
    picture = torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8, device="meta")
    return Target(picture, picture[..., 0], (0, 0, WIDTH, HEIGHT), torch.ones(3, device="meta"))
