"""Small avatars of MonoGaussianAvatar on a toy face, for tests."""

import torch

from mien.avatar.mono_gaussian_avatar.avatar import MonoGaussianAvatar
from mien.avatar.mono_gaussian_avatar.settings import MonoGaussianAvatarConfig
from mien.avatar.settings import Rate
from mien.face import FaceModel
from mien.gaussians import Rendering
from plain_settings import plain_mono_gaussian_avatar
from toy_scene import toy_face, toy_face_model

SMALL = plain_mono_gaussian_avatar(points=30, max_points=60, own_rate=Rate(1e-2))


def new_avatar(
    config: MonoGaussianAvatarConfig = SMALL, face_model: FaceModel | None = None, disturbed: bool = True
) -> MonoGaussianAvatar:
    torch.manual_seed(0)
    avatar = MonoGaussianAvatar(config, face_model or toy_face_model(), toy_face(5))
    if disturbed:
        with torch.no_grad():
            for network in (avatar.attributes, avatar.deformation, avatar.change):
                for parameter in network.parameters():
                    parameter.add_(0.05 * torch.randn(parameter.shape))
            if "own_attributes" in avatar.store.names():
                avatar.store["own_attributes"].normal_(std=0.05)
    return avatar


def pictured(n: int) -> Rendering:
    return Rendering(torch.zeros(4, 4, 3), torch.zeros(4, 4), torch.ones(n).int(), torch.zeros(n, 2))
