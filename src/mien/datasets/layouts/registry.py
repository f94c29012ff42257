"""The list of layouts in which a capture is written. A new one is one file in this folder, and one line here."""

from mien.datasets.layouts.layout import Layout

LAYOUTS = (
    Layout("insta", "INSTA, GaussianBlendshapes and RGBAvatar"),
    Layout("imavatar", "IMavatar, PointAvatar, MonoGaussianAvatar and SplattingAvatar", needs_flame=True),
    Layout("nerface", "NeRFace"),
    Layout("nersemble", "the NeRSemble benchmark (version 2)", one_camera=False),
)


def find_layout(name: str | None) -> Layout | None:
    """Return a layout by its name; None if there is none."""
    return next((each for each in LAYOUTS if each.name == name), None)
