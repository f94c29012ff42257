"""Avatars without torch: load a .mien file, pose it, render it, with numpy and the native core alone.

Example:
    >>> from mien import runtime
    >>> avatar = runtime.load("me.mien")
    >>> image, alpha = avatar.render(avatar.pose({"jawOpen": 0.6}), avatar.camera.resized(512, 512))
"""

from mien.runtime.avatar import Avatar, load, render
from mien.runtime.baked import (
    AttributeNetwork,
    Attributes,
    BakedAvatar,
    BlendSkinned,
    Camera,
    ExpressionChanges,
    Filmed,
    LinearBases,
    MeshBound,
    PortableAvatar,
    Rig,
    Static,
)
from mien.runtime.file import read_portable, write_portable
from mien.runtime.named import presets, presets_for
from mien.runtime.posing import Face, Gaussians, pose

__all__ = [
    "AttributeNetwork",
    "Attributes",
    "Avatar",
    "BakedAvatar",
    "BlendSkinned",
    "Camera",
    "ExpressionChanges",
    "Face",
    "Filmed",
    "Gaussians",
    "LinearBases",
    "MeshBound",
    "PortableAvatar",
    "Rig",
    "Static",
    "load",
    "pose",
    "presets",
    "presets_for",
    "read_portable",
    "render",
    "write_portable",
]
