"""Files of Gaussians in one pose, by the ending of a path."""

from pathlib import Path

from mien.export.ply import write_ply
from mien.export.sog import write_sog
from mien.export.spz import write_spz
from mien.export.usd import write_usd
from mien.export.usd_package import USD_ENDINGS
from mien.gaussians import Gaussians

_WRITERS = {".spz": write_spz, ".sog": write_sog}


def write_pose(path: Path, gaussians: Gaussians, degree: int | None = None) -> None:
    """Write unbatched Gaussians in world space as .ply, .spz, .sog or USD, by the ending of `path`.

    `degree` is that of the spherical harmonics in a .ply (`write_ply`). The other formats say their own.

    Raises:
        UserError: a value is NaN or infinite, a package is missing, or the Gaussians have a higher degree.
    """
    ending = path.suffix.lower()
    if ending == ".ply":
        write_ply(path, gaussians, degree)
    elif ending in USD_ENDINGS:
        write_usd(path, [gaussians])
    else:
        _WRITERS[ending](path, gaussians)
