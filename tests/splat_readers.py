"""Small readers of .spz, .sog and USD files, made from descriptions of the formats.

Tests read with them what mien writes, so nothing is checked."""

import gzip
import importlib
import io
import json
import struct
import zipfile
from pathlib import Path

import numpy as np
import zstandard
from PIL import Image

from mien.formats.shared.splats import gaussians_of
from mien.gaussians import Gaussians


def _with_largest(small: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """Unit quaternions from their three smaller components, and the index of the largest, which is positive."""
    quats = np.zeros((len(small), 4))
    quats[np.arange(4) != largest[:, None]] = small.reshape(-1)
    quats[np.arange(len(quats)), largest] = np.sqrt(np.maximum(1 - np.square(small).sum(1), 0))
    return quats


def read_spz(path: Path) -> Gaussians:
    """Read a .spz file of version 3, which is one gzip stream, or 4, which has a stream for each column."""
    data = path.read_bytes()
    data = data if data[:4] == b"NGSP" else gzip.decompress(data)
    magic, version, count, degree, fraction, _, streams = struct.unpack_from("<4sII4B", data)
    assert magic == b"NGSP"
    content = data[16:]
    if version == 4:
        (table,) = struct.unpack_from("<I", data, 16)
        sizes = np.frombuffer(data, "<u8", 2 * streams, table).reshape(-1, 2).tolist()
        end, content = table + 16 * streams, b""
        for packed, size in sizes:
            content += zstandard.ZstdDecompressor().decompress(data[end : end + packed], max_output_size=size)
            end += packed
        assert end == len(data)
    widths = (9, 1, 3, 3, 4, 3 * (degree + 1) ** 2 - 3)
    columns = np.split(np.frombuffer(content, np.uint8), count * np.cumsum(widths)[:-1])
    places, alpha, first, scales, turns, higher = (
        column.reshape(count, width) for column, width in zip(columns, widths, strict=True)
    )
    fixed = np.pad(places.reshape(-1, 3), ((0, 0), (1, 0))).view("<i4") >> 8
    words = np.ascontiguousarray(turns).view("<u4").astype(np.int64)
    fields = words >> np.array([20, 10, 0])
    small = (fields & 511) / 511 / np.sqrt(2) * np.where(fields & 512, -1, 1)
    sh = np.concatenate([(first / 255.0 - 0.5) / 0.15, higher / 128.0 - 1], axis=1).reshape(count, (degree + 1) ** 2, 3)
    quats = _with_largest(small, words[:, 0] >> 30)[:, [3, 0, 1, 2]]
    means, sizes = fixed.reshape(-1, 3) / 2.0**fraction, np.exp(scales / 16.0 - 10)
    return gaussians_of((means, quats, sizes, alpha[:, 0] / 255.0, sh))


def read_sog(path: Path) -> Gaussians:
    """Read a .sog file of version 2."""
    with zipfile.ZipFile(path) as archive:
        meta = json.loads(archive.read("meta.json"))
        assert meta["version"] == 2

        def pixels(part: str, index: int = 0) -> np.ndarray:
            with Image.open(io.BytesIO(archive.read(meta[part]["files"][index]))) as picture:
                return np.asarray(picture.convert("RGBA")).reshape(-1, 4).astype(int)

        def looked_up(part: str, codes: np.ndarray) -> np.ndarray:
            return np.array(meta[part]["codebook"])[codes]

        count = meta["count"]
        low, high = np.array(meta["means"]["mins"]), np.array(meta["means"]["maxs"])
        steps = (pixels("means") + 256 * pixels("means", 1))[:count, :3]
        logged = low + (high - low) * steps / 65535
        turns, shades, scales = (pixels(part)[:count] for part in ("quats", "sh0", "scales"))
        sh = looked_up("sh0", shades[:, :3])[:, None]
        if "shN" in meta:
            palette = pixels("shN")[:, :3].reshape(-1, (meta["shN"]["bands"] + 1) ** 2 - 1, 3)
            labels = pixels("shN", 1)[:count] @ np.array([1, 256, 0, 0])
            sh = np.concatenate([sh, looked_up("shN", palette[labels])], axis=1)
    quats = _with_largest((turns[:, :3] / 255 - 0.5) * np.sqrt(2), turns[:, 3] - 252)
    means, sizes = np.sign(logged) * np.expm1(np.abs(logged)), np.exp(looked_up("scales", scales[:, :3]))
    return gaussians_of((means, quats, sizes, shades[:, 3] / 255, sh))


def read_usd(path: Path, time: float | None = None) -> Gaussians:
    """Read the Gaussians of a USD file at a time sample (default: without time)."""
    Usd, UsdVol = (importlib.import_module(f"pxr.{name}") for name in ("Usd", "UsdVol"))
    stage = Usd.Stage.Open(str(path))
    field = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/avatar/gaussians"))
    attributes = (
        field.GetPositionsAttr(), field.GetOrientationsAttr(), field.GetScalesAttr(), field.GetOpacitiesAttr(),
        field.GetRadianceSphericalHarmonicsCoefficientsAttr(),
    )  # fmt: skip
    at = Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)
    means, turns, scales, opacities, sh = (np.array(attribute.Get(at)) for attribute in attributes)
    sh = sh.reshape(len(means), len(sh) // len(means), 3)
    return gaussians_of((means, turns[:, [3, 0, 1, 2]], scales, opacities, sh))
