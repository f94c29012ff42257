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
from mien.formats.format import Content, SplatOptions, pose_words
from mien.formats.shared.splats import finite_arrays, unit_quats
from mien.gaussians import Gaussians

_VERSION, _CODES, _PALETTE_COLUMNS, _MODE = 2, 256, 64, 252
"""Numbers of the specification."""
_MIN_SCALE = 1e-7
"""Least standard deviation in metres, so that Gaussians without a width do not take values from the others."""
_BANDS = {3: 1, 8: 2, 15: 3}
"""Number of bands by the number of SH coefficients after the first."""
_PALETTE = 1 << 16
"""Most rows of coefficients that Gaussians share."""


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


def write(path: Path, content: Content, options: SplatOptions) -> str:
    """Write the file, and return what is told of it."""
    write_sog(path, options.pose(content))
    return pose_words(path, content)
