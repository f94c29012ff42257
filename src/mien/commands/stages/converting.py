"""From an avatar in a .mien or .glb file to another file, without its workspace."""

from pathlib import Path

import torch

from mien import runtime
from mien.export import WebcamFiles, in_world, read_glb_avatar, write_packed, write_page, write_pose
from mien.gaussians import Gaussians
from mien.progress import say
from mien.runtime import PortableAvatar, read_portable, write_portable


def convert(
    source: Path, out: Path, webcam: WebcamFiles | None = None, webgpu: bool = False, sh: int | None = None
) -> None:
    """Write the avatar in a file as .mien, .html, .packed, or at rest with the head at the origin, and report it.

    `webcam` are files of the face landmarker for a .html page, and `webgpu` says whether it draws with WebGPU where the
    browser has it. `sh` is the degree of the spherical harmonics in a .ply (`mien.export.write_ply`).

    Raises:
        UserError: the file is missing, damaged or foreign, or the avatar cannot be written so.
    """
    avatar = read_glb_avatar(source) if source.suffix.lower() == ".glb" else read_portable(source)
    ending = out.suffix.lower()
    if ending == ".mien":
        write_portable(out, avatar)
    elif ending == ".html":
        write_page(out, avatar, webcam=webcam, webgpu=webgpu)
    elif ending == ".packed":
        write_packed(out, avatar)
    else:
        write_pose(out, _at_rest(avatar), sh)
    say(f"{out}: {avatar.about.name!r} of {source}, {out.stat().st_size / 1e6:.1f} MB")


def _at_rest(avatar: PortableAvatar) -> Gaussians:
    posed = runtime.Avatar(avatar).pose(head_rotation=(0, 0, 0), head_translation=(0, 0, 0))
    arrays = (posed.means, posed.quats, posed.scales, posed.opacities, posed.sh)
    pose = None if posed.T_world_local is None else torch.from_numpy(posed.T_world_local.copy())
    return in_world(Gaussians(*(torch.from_numpy(array.copy()) for array in arrays), T_world_local=pose))
