"""The arrays of a SOG scene, from its textures and tables.

Axis legend: N Gaussians, K spherical-harmonic bases.
"""

import numpy as np

from gsjax.errors import InputError
from gsjax.io.common import warn
from gsjax.io.packed_quats import PackedQuats, unpack_quats
from gsjax.io.sog_files import REMEDY, SogFiles
from gsjax.io.sog_meta import (
    MAX_DEGREE,
    MAX_PALETTE,
    PALETTE_COLUMNS,
    Harmonics,
    Meta,
    degree_of_width,
    palette_height,
)
from gsjax.io.sog_textures import decode_rows, decode_texture
from gsjax.math.sh import num_bases

BYTE = 255  # levels of a component of a quaternion
WORD = 65535  # levels of a coordinate
FIRST_INDEX = 252  # alpha of a quaternion without w; x, y and z follow
_MAX_WIDTH = 1 << 10  # of a palette


def decode_scene(files: SogFiles, meta: Meta) -> dict[str, np.ndarray]:
    """Return the fields of `gsjax.make_gaussians`, float32, in the order of the file.

    Raises:
      InputError: if a texture is missing, damaged, of another size, or has an index
        beyond its codebook; or if means exceed float32.
    """
    count = meta.gaussians

    def rows(name: str) -> np.ndarray:
        return decode_rows(files.where(name), files.read(name), count)

    scales = rows(meta.files["scales"])
    colors = rows(meta.files["sh0"])
    fields = {
        "means": _means(files, meta, rows),
        "quats": _quats(files, rows(meta.files["quats"])),
        "log_scales": _look_up(files, "scales", meta.scales, scales),
        "logit_opacities": meta.opacities[colors[:, 3]],
    }
    dc = _look_up(files, "sh0", meta.colors, colors)
    if meta.harmonics is None:
        return fields | {"sh": dc[:, None]}
    palette = _palette(files, meta.harmonics)
    sh = np.empty((count, 1 + palette.shape[1], 3), np.float32)
    sh[:, 0] = dc
    name = meta.harmonics.files[1]
    labels = rows(name)
    indices = labels[:, 0] + labels[:, 1].astype(np.int32) * 256
    wrong = indices >= len(palette)
    if wrong.any():
        got = f"got {indices.max()} ({wrong.sum():,} of {count:,} exceed it)"
        raise InputError(
            f"{files.where(name)}: expected indices below the {len(palette):,} entries "
            f"of the palette, {got}; {REMEDY}"
        )
    np.take(palette, indices, axis=0, out=sh[:, 1:])
    return fields | {"sh": sh}


def _means(files: SogFiles, meta: Meta, rows) -> np.ndarray:
    names = meta.files["means_l"], meta.files["means_u"]
    low, high = (rows(name)[:, :3] for name in names)
    means = dequantise_means(low + high.astype(np.uint16) * 256, meta.mins, meta.maxs)
    far = np.any(~np.isfinite(means), axis=1)
    if far.any():
        expected = "expected means within float32"
        got = f"{far.sum():,} of {len(far):,} exceed it"
        raise InputError(f"{files.path}: {expected}, {got}; check means.mins and maxs")
    return means


def dequantise_means(
    codes: np.ndarray, mins: np.ndarray, maxs: np.ndarray
) -> np.ndarray:
    """Return means [N, 3] float32 of codes [N, 3] from 0 to 65535.

    Args:
      codes: whole numbers.
      mins, maxs: [3] float64 bounds of sign(x) ln(1 + |x|).
    """
    extent = maxs - mins
    logs = mins + np.where(extent == 0, 1, extent) * (codes / WORD)
    with np.errstate(over="ignore"):
        return np.copysign(np.expm1(np.abs(logs)), logs).astype(np.float32)


def _quats(files: SogFiles, texels: np.ndarray) -> np.ndarray:
    invalid = texels[:, 3] < FIRST_INDEX
    dropped = np.maximum(texels[:, 3], FIRST_INDEX) - np.int64(FIRST_INDEX)
    quats = unpack_quats(PackedQuats(dropped, texels[:, :3]), BYTE).astype(np.float32)
    if invalid.any():
        found = f"{invalid.sum():,} of {len(texels):,} rotations"
        warn(
            f"{files.path}: {found} lack the index of a component and become the "
            "identity; check how the file was exported"
        )
        quats[invalid] = (1, 0, 0, 0)
    return quats


def _look_up(
    files: SogFiles, key: str, table: np.ndarray, texels: np.ndarray
) -> np.ndarray:
    """Return the values [N, 3] float32 of the bytes of three channels."""
    found = np.stack([table[c][texels[:, c]] for c in range(3)], axis=-1)
    _check_known(files, key, found)
    return found


def _check_known(files: SogFiles, key: str, values: np.ndarray) -> None:
    unknown = np.isnan(values)
    if unknown.any():
        got = f"{unknown.sum():,} of {unknown.size:,} point beyond its end"
        what = f"{key}: expected indices within its codebook"
        raise InputError(f"{files.path}: {what}, {got}; {REMEDY}")


def _palette(files: SogFiles, harmonics: Harmonics) -> np.ndarray:
    """Return the palette [entries, K - 1, 3] float32."""
    name = harmonics.files[0]
    where = files.where(name)
    most = _MAX_WIDTH * palette_height(MAX_PALETTE)
    texels = decode_texture(where, files.read(name), most=most)
    height, width, _ = texels.shape
    degree = degree_of_width(width)
    if degree is None or degree != (harmonics.degree or degree):
        degrees = [harmonics.degree] if harmonics.degree else range(1, MAX_DEGREE + 1)
        widths = [PALETTE_COLUMNS * (num_bases(d) - 1) for d in degrees]
        expected = f"a palette {' or '.join(map(str, widths))} texels wide"
        raise InputError(f"{where}: expected {expected}, got {width}; {REMEDY}")
    count = harmonics.entries or min(height * PALETTE_COLUMNS, MAX_PALETTE)
    if height < palette_height(count):
        expected = f"expected {palette_height(count)} rows for {count:,} entries"
        raise InputError(f"{where}: {expected}, got {height}; {REMEDY}")
    entries = texels.reshape(-1, num_bases(degree) - 1, 4)[:count, :, :3]
    values = harmonics.values[entries]
    _check_known(files, "shN", values)
    return values
