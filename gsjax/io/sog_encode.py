"""The files of a SOG scene of version 2, from the rows of a scene.

Attributes of few distinct values are stored exactly, so that a scene that was read from
a SOG, or quantised before, loses nothing. Axis legend: N Gaussians, C entries of the
palette, K spherical-harmonic bases.
"""

import json
import math
from typing import Any, NamedTuple

import numpy as np

from gsjax.io import common
from gsjax.io.morton import morton_order
from gsjax.io.packed_quats import pack_quats
from gsjax.io.sog_decode import BYTE, FIRST_INDEX, WORD, dequantise_means
from gsjax.io.sog_files import META
from gsjax.io.sog_meta import ENTRIES, MODELS, PALETTE_COLUMNS, palette_height
from gsjax.io.sog_textures import encode_rows, encode_texture
from gsjax.math.clustering import codebook, kmeans
from gsjax.math.sh import degree_of

_UNIT, _MAX_UNITS = 1024, 64  # a palette has a power of two of units
_BINS = 1024
_THIN = 7.0  # by which the log of a third scale is less, where surfels have none


class MeanCodes(NamedTuple):
    """Means in whole numbers.

    Attributes:
      codes: [N, 3] int64 from 0 to 65535.
      mins, maxs: [3] float64 bounds of sign(x) ln(1 + |x|).
    """

    codes: np.ndarray
    mins: np.ndarray
    maxs: np.ndarray


def encode_scene(
    rows: dict[str, np.ndarray], means: MeanCodes, mode: str | None
) -> dict[str, bytes]:
    """Return the files by name, meta.json last.

    Args:
      rows: at least one Gaussian, see `gsjax.io.common.visible_rows`; SH degree 0 to 3.
      means: of `quantise_means`.
      mode: render mode: "mip", "2dgs" or None.
    """
    codes, mins, maxs = means
    # By the means as they are read, so that the order is kept when they are written.
    order = morton_order(dequantise_means(codes, mins, maxs))
    codes = codes[order]
    files = {"means_l.webp": encode_rows((codes & 0xFF).astype(np.uint8))}
    files["means_u.webp"] = encode_rows((codes >> 8).astype(np.uint8))
    packed = pack_quats(rows["quats"][order], BYTE)
    texels = np.column_stack([packed.codes, FIRST_INDEX + packed.dropped])
    files["quats.webp"] = encode_rows(texels.astype(np.uint8))
    scales, axes = _indexed(_stored_scales(rows["log_scales"][order], mode))
    files["scales.webp"] = encode_rows(axes)
    colors, channels = _indexed(rows["sh"][order, 0])
    opacities = common.opacity_bytes(rows["logit_opacities"][order])
    files["sh0.webp"] = encode_rows(np.column_stack([channels, opacities]))
    meta: dict[str, Any] = {"version": 2, "asset": {"generator": "gsjax"}}
    meta["count"] = len(order)
    if mode in MODELS:
        meta["model"] = MODELS[mode]
    bounds = {"mins": mins.tolist(), "maxs": maxs.tolist()}
    meta["means"] = {**bounds, "files": ["means_l.webp", "means_u.webp"]}
    meta["scales"] = {"codebook": _decimals(scales, axes), "files": ["scales.webp"]}
    meta["quats"] = {"files": ["quats.webp"]}
    meta["sh0"] = {"codebook": _decimals(colors, channels), "files": ["sh0.webp"]}
    if rows["sh"].shape[1] > 1:
        meta["shN"] = _encode_harmonics(rows["sh"][order, 1:], files)
    files[META] = json.dumps(meta, separators=(",", ":"), allow_nan=False).encode()
    return files


def quantise_means(means: np.ndarray) -> MeanCodes:
    """Round means to 65536 steps of sign(x) ln(1 + |x|) along each axis.

    Args:
      means: [N, 3] float32, N at least 1.
    """
    wide = means.astype(np.float64)
    logs = np.copysign(np.log1p(np.abs(wide)), wide)
    mins, maxs = logs.min(axis=0), logs.max(axis=0)
    extent = np.where(maxs > mins, maxs - mins, 1)
    codes = np.rint((logs - mins) / extent * WORD).astype(np.int64)
    return MeanCodes(codes, mins, maxs)


def _stored_scales(log_scales: np.ndarray, mode: str | None) -> np.ndarray:
    """Return the log scales [N, 3] to store.

    Surfels have no third scale, so one value takes its place unless the codebook holds
    all of them: the others are then more precise.
    """
    if mode != "2dgs" or len(np.unique(log_scales)) <= ENTRIES:
        return log_scales
    thin = np.full(len(log_scales), log_scales[:, :2].min() - _THIN)
    return np.column_stack([log_scales[:, :2], thin])


def _indexed(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a codebook [256] float32, and indices uint8 in the shape of values."""
    entries, indices = codebook(values, ENTRIES, weights=_rarity(values.ravel()))
    return entries, indices.reshape(values.shape).astype(np.uint8)


def _rarity(values: np.ndarray) -> np.ndarray:
    """Return weights [M] of numbers: n^-1/3 for n numbers that are about as large.

    With equal weights, rare values such as the largest scales have large errors.
    """
    low, extent = values.min(), np.ptp(values)
    share = (values - low) / (extent or 1)
    bins = np.minimum(share * _BINS, _BINS - 1).astype(int)
    return np.bincount(bins)[bins] ** (-1 / 3)


def _decimals(entries: np.ndarray, indices: np.ndarray) -> list[float]:
    """Return a codebook [256] float32 with as few decimals as tell its entries apart.

    Entries after the last of the ``indices`` are 0, which is short. Some programs
    expect 256 numbers.
    """
    used = entries[: int(indices.max()) + 1]
    short = [float(str(value)) for value in used]
    same = np.asarray(short).astype(np.float32) == used
    found = [a if good else float(b) for a, b, good in zip(short, used, same)]
    return found + [0] * (ENTRIES - len(used))


def palette_size(count: int) -> int:
    """Return the largest number C of entries of the palette of ``count`` Gaussians.

    1024 · 2^k, at most ``count`` but for small scenes, and at most 65,536.
    """
    units = 1 << max(0, int(math.log2(max(count, 1) / _UNIT)))
    return _UNIT * min(units, _MAX_UNITS)


def _encode_harmonics(rest: np.ndarray, files: dict[str, bytes]) -> dict[str, Any]:
    """Add the textures of coefficients [N, K - 1, 3], and return their metadata."""
    count, coefficients, _ = rest.shape
    found = kmeans(rest.reshape(count, -1), palette_size(count))
    order = _order_of_use(found.labels)
    palette, places = found.centroids[order], np.zeros(len(found.centroids), int)
    places[order] = np.arange(len(order))
    labels = places[found.labels]
    # Values matter by the number of Gaussians that use them.
    uses = np.bincount(labels, minlength=len(palette)).astype(np.float64)
    weights = np.repeat(uses, palette.shape[1])
    entries, indices = codebook(palette, ENTRIES, weights=weights)
    height = palette_height(len(palette))
    texels = np.zeros((height * PALETTE_COLUMNS, coefficients, 3), np.uint8)
    texels[: len(palette)] = indices.reshape(-1, coefficients, 3)
    names = ["shN_centroids.webp", "shN_labels.webp"]
    files[names[0]] = encode_texture(texels.reshape(height, -1, 3))
    split = np.column_stack([labels & 0xFF, labels >> 8, np.zeros_like(labels)])
    files[names[1]] = encode_rows(split.astype(np.uint8))
    return {
        "count": len(palette),
        "bands": degree_of(coefficients + 1),
        "codebook": _decimals(entries, indices),
        "files": names,
    }


def _order_of_use(labels: np.ndarray) -> np.ndarray:
    """Return the distinct labels of [N], in the order in which they first occur.

    Neighbouring labels then often differ by 1, which compresses better than an order by
    the values of the entries.
    """
    used, first = np.unique(labels, return_index=True)
    return used[np.argsort(first)]
