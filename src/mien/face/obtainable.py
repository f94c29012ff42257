"""Face models that users fetch themselves, because their licence does not let mien contain them."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ObtainableModel:
    """A face model that mien can use, and does not contain."""

    name: str
    """Name that mien gives it when its file is added."""
    file: str
    licence: str
    where: str
    use: str
    """What it is needed for."""
    options: str = ""
    """Options that `mien face-models --add` needs for that use, each after a space."""


OBTAINABLE = (
    ObtainableModel("generic_model", "generic_model.pkl (FLAME 2020)", "MPI's own; not commercial",
                    "flame.is.tue.mpg.de, with an account", "trackings of INSTA, FlashAvatar and IMavatar"),
    ObtainableModel("flame2023", "flame2023.pkl (FLAME 2023)", "MPI's own; not commercial",
                    "flame.is.tue.mpg.de, with an account", "trackings of VHAP and NeRSemble", " --teeth"),
    ObtainableModel("flame2023_open", "FLAME 2023 Open", "CC-BY-4.0", "flame.is.tue.mpg.de, with an account",
                    "avatars that may carry their face model", " --shareable"),
    ObtainableModel("ict", "the folder FaceXModel (ICT-FaceKit Light)", "MIT",
                    "github.com/ICT-VGL/ICT-FaceKit", "ARKit's expressions on a dense mesh with teeth and tongue"),
    ObtainableModel("gnm_head", "gnm_head.npz (GNM Head 3)", "Apache-2.0",
                    "github.com/google/GNM", "a statistical head with eyes, teeth and tongue"),
)  # fmt: skip
"""In the order in which they are listed."""
