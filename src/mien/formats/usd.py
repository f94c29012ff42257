"""USD files with a ParticleField3DGaussianSplat (OpenUSD 26.03 or newer, by usd-core): a pose, or a sequence."""

import errno
import importlib
import importlib.util
import math
import os
import tempfile
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mien.disk.files import write_atomically
from mien.errors import UserError
from mien.formats.format import Content, PoseOptions, check_options, pose_words
from mien.formats.shared.splats import finite_arrays, unit_quats

if TYPE_CHECKING:
    import mien.gaussians


def check_usd(path: Path, options: PoseOptions | None = None) -> None:
    """Check the options, if any, and that usd-core, which writes `path`, is installed."""
    if options is not None:
        check_options(path, options)
    if importlib.util.find_spec("pxr") is None:
        raise UserError(f"{path}: needs the package usd-core, which is missing; run `pip install 'mien[usd]'`")


def write_usd(path: Path, poses: Iterable["mien.gaussians.Gaussians"], fps: float | None = None) -> int:
    """Write unbatched Gaussians in world space (+y up, metres) as a USD stage, and return the number of poses.

    Values are float32 and not compressed with loss. With `fps`, each pose is a time sample (0, 1, 2, ...); without it,
    there is one pose and no time. The ending of `path` chooses the container: .usd, .usda, .usdc or .usdz.
    """
    check_usd(path)
    Usd, UsdVol = _pxr("Usd", "UsdVol")

    if not hasattr(UsdVol, "ParticleField3DGaussianSplat"):
        version = ".".join(map(str, Usd.GetVersion()))
        raise UserError(f"{path}: needs usd-core 26.3 or newer, not {version}; run `pip install -U 'mien[usd]'`")
    count = 0

    def write(temporary: Path) -> None:
        nonlocal count
        # USD writes its files beside the output, so that only one disk can be full. It replaces files by renaming.
        with tempfile.TemporaryDirectory(dir=temporary.parent.absolute(), prefix=".usd-") as folder, _usd_errors():
            # A package is made of a finished file.
            packed = path.suffix.lower() == ".usdz"
            inner = Path(folder) / (path.with_suffix(".usdc").name if packed else path.name)
            count = _write_stage(path, inner, poses, fps)
            if packed:
                _write_package(inner, temporary)
            else:
                inner.replace(temporary)

    write_atomically(path, write)
    return count


def _pxr(*names: str) -> list[Any]:
    """Modules of usd-core, which have no types."""
    return [importlib.import_module(f"pxr.{name}") for name in names]


@contextmanager
def _usd_errors() -> Iterator[None]:
    """Raise errors of USD as the system's error that is named in their text."""
    (Tf,) = _pxr("Tf")
    try:
        yield
    except Tf.ErrorException as error:
        code = next((code for code in errno.errorcode if os.strerror(code) in str(error)), errno.EIO)
        raise OSError(code, os.strerror(code)) from None


def _write_stage(path: Path, file: Path, poses: Iterable["mien.gaussians.Gaussians"], fps: float | None) -> int:
    """Write the poses into `file`, and return their number. Messages name `path`."""
    Usd, UsdGeom, UsdVol = _pxr("Usd", "UsdGeom", "UsdVol")

    stage = Usd.Stage.CreateNew(str(file))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, "/avatar")
    stage.SetDefaultPrim(root.GetPrim())
    Usd.ModelAPI(root.GetPrim()).SetKind("component")
    field = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/avatar/gaussians")
    count = 0
    for count, gaussians in enumerate(poses, 1):  # noqa: B007
        _add_pose(path, field, gaussians, None if fps is None else float(count - 1))
    if fps is not None:
        stage.SetTimeCodesPerSecond(fps)
        stage.SetFramesPerSecond(fps)
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(max(count - 1, 0))
    stage.GetRootLayer().Save()
    return count


def _write_package(stage: Path, package: Path) -> None:
    """Write the package of a stage's file. USD gives no reason if it is not whole; the usual one is a full disk."""
    Sdf, UsdUtils = _pxr("Sdf", "UsdUtils")

    whole = UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(stage)), str(package))
    try:
        with zipfile.ZipFile(package) as members:
            whole = whole and members.testzip() is None
    except zipfile.BadZipFile:
        whole = False
    if not whole:
        raise OSError(errno.ENOSPC, "its package is incomplete")


def _add_pose(path: Path, field: Any, gaussians: "mien.gaussians.Gaussians", time: float | None) -> None:
    Usd, Vt = _pxr("Usd", "Vt")

    means, quats, scales, opacities, sh = finite_arrays(path, gaussians)
    at = Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)
    degree = math.isqrt(sh.shape[1]) - 1
    turns = np.ascontiguousarray(unit_quats(quats)[:, [1, 2, 3, 0]])  # USD keeps the real part last in memory
    reach = 3 * scales.max(1, keepdims=True)  # in standard deviations
    extent = np.stack([(means - reach).min(0), (means + reach).max(0)]) if len(means) else np.zeros((2, 3), np.float32)
    field.CreatePositionsAttr().Set(Vt.Vec3fArray.FromNumpy(means), at)
    field.CreateOrientationsAttr().Set(Vt.QuatfArray.FromNumpy(turns), at)
    field.CreateScalesAttr().Set(Vt.Vec3fArray.FromNumpy(scales), at)
    field.CreateOpacitiesAttr().Set(Vt.FloatArray.FromNumpy(opacities), at)
    coefficients = np.ascontiguousarray(sh.reshape(-1, 3))
    field.CreateRadianceSphericalHarmonicsCoefficientsAttr().Set(Vt.Vec3fArray.FromNumpy(coefficients), at)
    field.CreateExtentAttr().Set(Vt.Vec3fArray.FromNumpy(extent), at)
    if not field.GetRadianceSphericalHarmonicsDegreeAttr().HasAuthoredValue():
        field.CreateRadianceSphericalHarmonicsDegreeAttr().Set(degree)
        field.CreateProjectionModeHintAttr().Set("perspective")
        field.CreateSortingModeHintAttr().Set("zDepth")


def write(path: Path, content: Content, options: PoseOptions) -> str:
    """Write the file, and return what is told of it."""
    moving = content.poses()
    if moving is None:
        write_usd(path, [content.pose()])
        return pose_words(path, content)
    frames, fps = moving
    count = write_usd(path, (frame.pose() for frame in frames), fps)
    return f"{count} time samples, {path.stat().st_size / 1e6:.1f} MB"
