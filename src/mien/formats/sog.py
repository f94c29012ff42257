"""The .sog format (PlayCanvas, version 2): Gaussians as pixels of lossless WebP pictures, with meta.json, in a zip.

Source: the specification at developer.playcanvas.com, "The SOG Format".
"""

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from mien.disk.files import write_atomically
from mien.disk.limits import checked_whole
from mien.disk.reading import open_archive, open_member, open_ordinary, parse_json
from mien.errors import UserError
from mien.formats.format import Content, SplatOptions, pose_words
from mien.formats.shared.splats import MAX_GAUSSIANS, finite_arrays, gaussians_of, unit_quats
from mien.gaussians import Gaussians
from mien.media.decoding import announced_size

_VERSION, _CODES, _PALETTE_COLUMNS, _MODE = 2, 256, 64, 252
"""Numbers of the specification."""
_MIN_SCALE = 1e-7
"""Least standard deviation in metres, so that Gaussians without a width do not take values from the others."""
_BANDS = {3: 1, 8: 2, 15: 3}
"""Number of bands by the number of SH coefficients after the first."""
_MAX_MEMBER, _MAX_META = 1 << 26, 1 << 20
_PALETTE, _SPARE_PIXELS = 1 << 16, 1 << 16
"""Most rows of coefficients that Gaussians share; and pixels that a picture may have besides two for each Gaussian,
since other programs round its sides up."""


def write_sog(path: Path, gaussians: Gaussians) -> None:
    """Write unbatched Gaussians in world space as .sog: +x right, +y up, +z to the viewer, in metres.

    Positions have 16 bits of their range, scales and colour coefficients the nearest of 256 values that fit them,
    opacities steps of 1/255, and rotations 8 bits for each of the three smallest components. SH coefficients of higher
    degrees have the nearest of 256 values; with more than 65,536 Gaussians, similar ones share them. The same Gaussians
    give the same bytes.
    """
    means, quats, scales, opacities, sh = finite_arrays(path, gaussians)
    width = max(1, int(np.ceil(np.sqrt(len(means)))))
    logged = np.sign(means) * np.log1p(np.abs(means.astype(np.float64)))
    low, high = (limit(logged, axis=0) if len(logged) else np.zeros(3) for limit in (np.min, np.max))
    steps = np.round((logged - low) / np.maximum(high - low, 1e-12) * 65535).astype(np.uint16)
    scale_codes, scale_book = _coded(np.log(np.maximum(scales, _MIN_SCALE)))
    color_codes, color_book = _coded(sh[:, 0])
    alpha = np.clip(np.round(opacities * 255), 0, 255).astype(np.uint8)
    pictures = {
        "means_l.webp": _picture((steps & 255).astype(np.uint8), width),
        "means_u.webp": _picture((steps >> 8).astype(np.uint8), width),
        "scales.webp": _picture(scale_codes, width),
        "quats.webp": _picture(_packed_quats(unit_quats(quats)), width),
        "sh0.webp": _picture(np.concatenate([color_codes, alpha[:, None]], axis=1), width),
    }
    meta: dict[str, Any] = {
        "version": _VERSION, "count": len(means), "antialias": False,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_book, "files": ["scales.webp"]}, "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_book, "files": ["sh0.webp"]},
    }  # fmt: skip
    if sh.shape[1] > 1:
        meta["shN"] = _add_palette(pictures, sh[:, 1:], width)
    members = {"meta.json": json.dumps(meta, allow_nan=False).encode(), **pictures}
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, data in members.items():
            archive.writestr(zipfile.ZipInfo(name), data)
    write_atomically(path, lambda temporary: temporary.write_bytes(file.getvalue()))


def read_sog(path: Path) -> Gaussians:
    """Read a .sog file of version 2."""
    try:
        with open_ordinary(path) as file, open_archive(file) as members:
            meta = parse_json(_member(members, "meta.json", _MAX_META).decode())
            if meta["version"] != _VERSION:
                raise ValueError(f"it has version {meta['version']!r:.20}")
            try:
                checked_whole(meta["count"], 0, MAX_GAUSSIANS)
            except ValueError:
                most = f"at most {MAX_GAUSSIANS:,} are read"
                raise ValueError(f"it has {meta['count']!r:.20} Gaussians, and {most}") from None
            with np.errstate(over="ignore"):  # infinity is told below
                arrays = _decoded(members, meta)
    except Exception as error:  # damaged archives and pictures may fail in any way
        reason = getattr(error, "strerror", None) or error
        raise UserError(f"{path}: cannot be read as .sog ({str(reason)[:100]}); "
                        "give a .sog of version 2, as `mien export` writes") from None  # fmt: skip
    gaussians = gaussians_of(arrays)
    finite_arrays(path, gaussians)
    return gaussians


def _decoded(members: zipfile.ZipFile, meta: dict[str, Any]) -> tuple[np.ndarray, ...]:
    count = meta["count"]

    def pixels(part: str, index: int, channels: int) -> np.ndarray:
        data = _member(members, meta[part]["files"][index])
        size, most = announced_size(data), _PALETTE * 15 if (part, index) == ("shN", 0) else 2 * count
        if size is None or size[0] * size[1] > most + _SPARE_PIXELS:
            raise ValueError(f"{part} has more pixels than its {count:,} Gaussians need")
        with Image.open(io.BytesIO(data)) as picture:
            if picture.size != size:
                raise ValueError(f"{part} has two sizes")
            values = np.asarray(picture.convert("RGBA")).reshape(-1, 4)[:, :channels]
        if part != "shN" or index == 1:
            if len(values) < count:
                raise ValueError(f"{part} has too few pixels")
            return values[:count]
        return values

    def book(part: str, kind: type = np.float32) -> np.ndarray:
        values = np.array(meta[part]["codebook"], kind)
        if values.shape != (_CODES,):
            raise ValueError(f"{part} has no codebook of {_CODES} numbers")
        return values

    steps = pixels("means", 0, 3).astype(int) + 256 * pixels("means", 1, 3).astype(int)
    low, high = (np.array(meta["means"][name], np.float64) for name in ("mins", "maxs"))
    logged = low + (high - low) * steps / 65535
    shades = pixels("sh0", 0, 4)
    sh = book("sh0")[shades[:, :3]][:, None]
    if "shN" in meta:
        rest = (checked_whole(meta["shN"]["bands"], 1, 3) + 1) ** 2 - 1
        labels = pixels("shN", 1, 2).astype(int) @ np.array([1, 256])
        palette = pixels("shN", 0, 3).reshape(-1, rest, 3)
        sh = np.concatenate([sh, book("shN")[palette[labels]]], axis=1)
    return (
        np.sign(logged) * np.expm1(np.abs(logged)), _unpacked_quats(pixels("quats", 0, 4)),
        np.exp(book("scales", np.float64)[pixels("scales", 0, 3)]), shades[:, 3] / 255, sh,
    )  # fmt: skip


def _coded(values: np.ndarray) -> tuple[np.ndarray, list[float]]:
    """Values as indices of the nearest of 256 numbers, and these numbers: k-means, which starts from even steps."""
    flat = np.sort(values.astype(np.float64), axis=None)
    if not len(flat):
        return np.zeros(values.shape, np.uint8), [0.0] * _CODES
    book = np.linspace(flat[0], flat[-1], _CODES)
    sums = np.concatenate([[0], np.cumsum(flat)])
    for _ in range(20):
        ends = np.concatenate([[0], np.searchsorted(flat, (book[1:] + book[:-1]) / 2), [len(flat)]])
        counts = np.diff(ends)
        book = np.where(counts > 0, np.diff(sums[ends]) / np.maximum(counts, 1), book)
    book = np.sort(book.astype(np.float32))
    return np.searchsorted((book[1:] + book[:-1]) / 2, values).astype(np.uint8), book.tolist()


def _add_palette(pictures: dict[str, bytes], higher: np.ndarray, width: int) -> dict[str, Any]:
    """Add the coefficients of higher degrees to the pictures, and return their part of meta.json."""
    rows = higher.reshape(len(higher), 3 * higher.shape[1])
    labels = cells_of(rows, _PALETTE)
    size = int(labels.max(initial=0)) + 1
    palette, _ = _means(rows, labels, size)
    codes, book = _coded(palette.reshape(size, *higher.shape[1:]))
    lines = -(-size // _PALETTE_COLUMNS)
    padded = np.zeros((lines * _PALETTE_COLUMNS, *higher.shape[1:]), np.uint8)
    padded[:size] = codes
    pictures["shN_centroids.webp"] = _picture(padded.reshape(-1, 3), _PALETTE_COLUMNS * higher.shape[1])
    split = np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], axis=1).astype(np.uint8)
    pictures["shN_labels.webp"] = _picture(split, width)
    files = ["shN_centroids.webp", "shN_labels.webp"]
    return {"count": size, "bands": _BANDS[higher.shape[1]], "codebook": book, "files": files}


def cells_of(rows: np.ndarray, most: int) -> np.ndarray:
    """The number of a cell for each row. There are at most `most` cells, which medians cut from all rows."""
    if len(rows) <= most:
        return np.arange(len(rows))
    cells = np.zeros(len(rows), int)
    for level in range(int(np.log2(most))):
        means, counts = _means(rows, cells, 1 << level)
        widest = (_means(np.square(rows), cells, 1 << level)[0] - np.square(means)).argmax(1)
        order = np.lexsort((rows[np.arange(len(rows)), widest[cells]], cells))
        starts = np.searchsorted(cells[order], np.arange(1 << level))
        rank = np.empty(len(rows), int)
        rank[order] = np.arange(len(rows)) - starts[cells[order]]
        cells = 2 * cells + (rank >= (counts[cells] + 1) // 2)
    return np.unique(cells, return_inverse=True)[1].reshape(-1)


def _means(rows: np.ndarray, cells: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean of the rows of each cell, and the number of its rows. An empty cell has the mean 0 and the number 1."""
    counts = np.maximum(np.bincount(cells, minlength=size), 1)
    sums = [np.bincount(cells, weights=column, minlength=size) for column in rows.T]
    return np.stack(sums, axis=1) / counts[:, None], counts


def _packed_quats(quats: np.ndarray) -> np.ndarray:
    """Quaternions wxyz as the three smallest components, and which one is the largest."""
    largest = np.abs(quats).argmax(1)
    signed = quats * np.where(np.take_along_axis(quats, largest[:, None], 1) < 0, -1, 1)
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    codes = np.clip(np.round((np.take_along_axis(signed, others, 1) / np.sqrt(2) + 0.5) * 255), 0, 255)
    return np.concatenate([codes, largest[:, None] + _MODE], axis=1).astype(np.uint8)


def _unpacked_quats(pixels: np.ndarray) -> np.ndarray:
    largest = pixels[:, 3].astype(int) - _MODE
    if (largest < 0).any():
        raise ValueError("a rotation has an unknown mode")
    kept = (pixels[:, :3] / 255 - 0.5) * np.sqrt(2)
    quats = np.zeros((len(pixels), 4))
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    np.put_along_axis(quats, others, kept, 1)
    quats[np.arange(len(quats)), largest] = np.sqrt(np.maximum(1 - (kept**2).sum(1), 0))
    return quats


def _picture(values: np.ndarray, width: int) -> bytes:
    """Rows of 3 or 4 bytes as the pixels of a lossless WebP picture. The last line ends with zeros."""
    height = max(1, -(-len(values) // width))
    pixels = np.zeros((height * width, values.shape[1]), np.uint8)
    pixels[: len(values)] = values
    file = io.BytesIO()
    # Without `exact`, pixels with an alpha of 0 lose their colours. More effort takes ten times as long.
    picture = Image.fromarray(pixels.reshape(height, width, -1))
    picture.save(file, "WEBP", lossless=True, exact=True, quality=20, method=2)
    return file.getvalue()


def _member(members: zipfile.ZipFile, name: str, most: int = _MAX_MEMBER) -> bytes:
    described = members.getinfo(str(name))
    if described.file_size > most:
        raise ValueError(f"{described.filename!r:.40} is too large")
    with open_member(members, described) as file:
        return file.read(most)


def write(path: Path, content: Content, options: SplatOptions) -> str:
    """Write the file, and return what is told of it."""
    write_sog(path, options.pose(content))
    return pose_words(path, content)
