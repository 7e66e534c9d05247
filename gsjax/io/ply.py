"""Gaussians in standard 3DGS PLY files: read by property name, written in order.

Compressed PLY files are recognised by their properties, see `gsjax.io.packed_ply`.

Axis legend: N Gaussians, K spherical-harmonic bases.

Values are stored as in `GaussianParams` (log scales, logit opacities, wxyz), except
f_rest: all of red, then all of green, then all of blue. The body is read in pieces, so
reading holds the returned arrays and one copy on the way to the device.
"""

import math
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import BinaryIO

import jax.numpy as jnp
import numpy as np

from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, make_gaussians
from gsjax.io.common import ANY_MODE, MAX_SHIFT, Format, require_new, warn
from gsjax.io.packed_ply import is_packed, read_packed, write_packed_ply
from gsjax.io.ply_header import Header, check_properties, check_size, read_header
from gsjax.io.ply_rows import CHUNK_ROWS, read_rows
from gsjax.runtime.files import opened, replacing
from gsjax.runtime.memory import Estimate, require

_NORMALS = ("nx", "ny", "nz")
_SURFELS = "2dgs"  # of "comment SplatRenderMode"
_THIRD = "scale_2"
_THIN = 7.0  # by which the log of a third scale is less, where surfels have none
_FILTER = "filter_3D"  # of Mip-Splatting: σ of the filter of each Gaussian
# Exporters write ±inf for opacities of exactly 0 and 1; the range of `logit`.
_MAX_LOGIT = math.log((1 - 2.0**-23) / 2.0**-23)


def read_ply(path: str | PathLike[str], *, drop_nonfinite: bool = False) -> Gaussians:
    """Read a 3DGS PLY file, binary, ascii or compressed, of any SH degree up to 4.

    Properties are found by name, in any order and of any scalar type; others, such as
    normals, are ignored. Mip-Splatting's ``filter_3D`` is applied to scales and
    opacities (Yu et al., "Mip-Splatting", CVPR 2024, equation 9). Opacities of ±inf are
    clamped to the logit of [2^-23, 1 - 2^-23] with a warning. Zero quaternions, values
    that look activated and trailing bytes are warned about.

    Surfels have two scales, or "comment SplatRenderMode: 2dgs"; a third that is absent
    or −inf becomes a thousandth of the others. `render_mode` tells them apart.

    Compressed (packed) files have degree 0 to 3. Their opacities of 0 and 1 are read as
    a quarter of a step within.

    Args:
      path: the file.
      drop_nonfinite: leave out Gaussians with NaN or infinite values, with a
        warning, instead of raising; not in compressed files, whose bounds are shared.

    Returns:
      Gaussians with capacity max(N, 1), in the order of the file.

    Raises:
      InputError: if the file cannot be read, is not a PLY, is truncated, lacks
        properties, has an incomplete f_rest, or has values that are not finite.
      CapacityError: if memory is too small; raised before the body is read.
    """
    path = Path(path)
    with opened(path, "a .ply file") as file:
        header = read_header(file, path)
        if is_packed(header):
            return make_gaussians(**read_packed(file, header), capacity=None)
        needed = [*_columns(_allocate(0, 1, np.float32))]
        needed.remove(_THIRD)
        bases = check_properties(header, needed)
        check_size(header)
        fields = _read_body(file, header, bases)
    _check_values(path, fields, drop_nonfinite)
    return make_gaussians(**fields, capacity=None)


def render_mode(path: str | PathLike[str]) -> str | None:
    """Return how the Gaussians of a PLY file are to be drawn.

    Returns:
      "2dgs" for surfels, "mip" for ellipsoids trained with antialiasing ("comment
      antialiased 1" too), another word of "comment SplatRenderMode" in lower case, or
      None without one. The last comment counts.

    Raises:
      InputError: if the file cannot be read or is not a PLY.
    """
    path = Path(path)
    with opened(path, "a .ply file") as file:
        header = read_header(file, path)
    return _SURFELS if _has_surfels(header) else header.render_mode


def _has_surfels(header: Header) -> bool:
    types = header.vertex.types
    two = {"scale_0", "scale_1"} <= types.keys() and _THIRD not in types
    return two or header.render_mode == _SURFELS


def _fill_third_scales(header: Header, log_scales: np.ndarray) -> None:
    """Set the third scales [N] that a file of surfels leaves out, in place."""
    if _has_surfels(header):
        thin = log_scales[:, :2].min(axis=1, initial=np.inf) - _THIN
        if _THIRD not in header.vertex.types:
            log_scales[:, 2] = thin
        absent = np.isneginf(log_scales[:, 2])
        log_scales[absent, 2] = thin[absent]


def _allocate(count: int, bases: int, dtype) -> dict[str, np.ndarray]:
    """Return uninitialised arrays by their names in `GaussianParams`."""
    return {
        "means": np.empty((count, 3), dtype),
        "quats": np.empty((count, 4), dtype),
        "log_scales": np.empty((count, 3), dtype),
        "logit_opacities": np.empty(count, dtype),
        "sh": np.empty((count, bases, 3), dtype),
    }


def _columns(fields: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return each property of the file, in the standard order, as a view [N]."""
    sh = fields["sh"]
    rest = sh.shape[1] - 1
    views = dict(zip("xyz", fields["means"].T))
    views |= {f"f_dc_{c}": sh[:, 0, c] for c in range(3)}
    views |= {f"f_rest_{i}": sh[:, 1 + i % rest, i // rest] for i in range(3 * rest)}
    views["opacity"] = fields["logit_opacities"]
    views |= {f"scale_{i}": fields["log_scales"][:, i] for i in range(3)}
    views |= {f"rot_{i}": fields["quats"][:, i] for i in range(4)}
    return views


def _read_body(file: BinaryIO, header: Header, bases: int) -> dict[str, np.ndarray]:
    # float64 only if the file holds more than float32 can and jax would keep it.
    wide = not {"f8", "i4", "u4"}.isdisjoint(header.vertex.types.values())
    dtype = np.dtype(jnp.result_type(float)) if wide else np.dtype(np.float32)
    count = header.vertex.rows
    held = count * (11 + 3 * bases) * dtype.itemsize
    require(
        Estimate({"values as read": held, "values on the device": held}),
        f"{header.path}: {count:,} Gaussians",
        "reduce the file with the tool that made it",
    )
    fields = _allocate(count, bases, dtype)
    views = _columns(fields)
    if _THIRD not in header.vertex.types:
        del views[_THIRD]
    if _FILTER in header.vertex.types:
        views[_FILTER] = np.empty(count, dtype)
    moved = np.zeros(count)  # by rounding to float32, where it is much of the size
    with np.errstate(over="ignore", invalid="ignore"):  # _check_values finds them
        start = 0
        for size, columns in read_rows(file, header):
            rows = slice(start, start + size)
            for name, view in views.items():
                view[rows] = columns[name]
            if wide and dtype == np.float32:
                shift = np.max([abs(columns[a] - views[a][rows]) for a in "xyz"], 0)
                sizes = np.exp(np.max([views[f"scale_{i}"][rows] for i in range(2)], 0))
                far = np.isfinite(shift) & (shift > MAX_SHIFT * sizes)
                moved[rows] = np.where(far, shift, 0)
            start += size
        _fill_third_scales(header, fields["log_scales"])
        if _FILTER in views:
            _smooth(fields, views[_FILTER])
    if moved.any():
        warn(
            f"{header.path}: float32 moves {np.count_nonzero(moved)} of {count} "
            f"Gaussians, by up to {moved.max():.3g}, more than {MAX_SHIFT:g} of their "
            "size; read the file with jax_enable_x64, or move the scene to the origin"
        )
    return fields


def _smooth(fields: dict[str, np.ndarray], sigmas: np.ndarray) -> None:
    """Convolve Gaussians with isotropic ones of ``sigmas`` [N], in place.

    Scales s become √(s² + σ²), and opacities are multiplied by √(Π s² / Π (s² + σ²)).
    """
    scales = fields["log_scales"].astype(np.float64)
    with np.errstate(divide="ignore"):
        logs = np.log(np.abs(sigmas[:, None].astype(np.float64)))
        wide = np.logaddexp(2 * scales, 2 * logs) / 2
        loss = np.sum(scales - wide, axis=1)  # log of the factor of the opacity
        # logit(e^loss / (1 + e^-l)) without cancellation near 1.
        left = np.logaddexp(np.log(-np.expm1(loss)), -fields["logit_opacities"])
    fields["log_scales"][:] = wide
    fields["logit_opacities"][:] = loss - left


def _check_values(
    path: Path, fields: dict[str, np.ndarray], drop_nonfinite: bool
) -> None:
    """Clamp, drop, reject or warn about values, in place."""
    opacities = fields["logit_opacities"]
    infinite = np.isinf(opacities)
    if infinite.any():
        opacities[infinite] = np.copysign(_MAX_LOGIT, opacities[infinite])
        warn(f"{path}: {infinite.sum()} opacities of ±inf set to ±{_MAX_LOGIT:.4f}")
    bad = {
        name: ~np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
        for name, array in fields.items()
    }
    rows = np.logical_or.reduce([*bad.values()])
    if rows.any():
        which = ", ".join(f"{k}: {v.sum()}" for k, v in bad.items() if v.any())
        message = (
            f"{path}: values are not finite in {rows.sum()} of {len(rows)} Gaussians "
            f"({which}), the first: {np.flatnonzero(rows)[:5].tolist()}"
        )
        if not drop_nonfinite:
            remedy = "drop them with gsjax.io.ply.read_ply(path, drop_nonfinite=True)"
            raise InputError(f"{message}; repair the file, or {remedy}")
        warn(f"{message}; dropped")
        for name in fields:
            fields[name] = fields[name][~rows]
    _warn_of_values(path, fields)


def _warn_of_values(path: Path, fields: Mapping[str, np.ndarray]) -> None:
    quats, opacities = fields["quats"], fields["logit_opacities"]
    zero = np.abs(quats).max(axis=1, initial=0) < np.finfo(quats.dtype).tiny
    if zero.any():
        warn(
            f"{path}: {zero.sum()} of {len(zero)} quaternions are zero, the first: "
            f"{np.flatnonzero(zero)[:5].tolist()}; such Gaussians are culled"
        )
    # A heuristic: trained scenes have logits outside [0, 1] and scales below 1.
    probabilities = ((opacities >= 0) & (opacities <= 1)).all()
    if len(opacities) and probabilities and (fields["log_scales"] > 0).all():
        warn(
            f"{path}: all opacities lie in [0, 1] and all scales are positive, which "
            "looks like activated values, but they are read as logits and logarithms; "
            "check how the file was exported"
        )


def write_ply(
    path: str | PathLike[str],
    gaussians: Gaussians,
    *,
    overwrite: bool = False,
    mode: str | None = None,
) -> None:
    """Write the active Gaussians, in their order, as a standard 3DGS PLY.

    The file is binary, little-endian float32: x y z nx ny nz f_dc f_rest opacity scale
    rot, with normals of zero. Means are written as float64 if float32 would round them.
    Values that are not finite are written with a warning.

    Args:
      path, gaussians, overwrite: as `gsjax.io.formats.save` takes them.
      mode: written as "comment SplatRenderMode", see `render_mode`; or None.

    Raises:
      InputError: if the file exists and ``overwrite`` is not set, if its folder is
        missing, or if it cannot be written.
    """
    path = Path(path)
    require_new(path, overwrite)
    with replacing(path, durable=True) as file:
        nonfinite = _write_body(file, gaussians, mode)
    if nonfinite:
        warn(f"{path}: {nonfinite} of the Gaussians written are NaN or infinite")


def _write_body(file: BinaryIO, gaussians: Gaussians, mode: str | None) -> int:
    """Write header and rows; return the number of rows that are not finite."""
    params = gaussians.params.__dict__
    views = _columns({name: np.asarray(array) for name, array in params.items()})
    names = [*"xyz", *_NORMALS, *(name for name in views if name not in "xyz")]
    slots = np.flatnonzero(np.asarray(gaussians.active))
    wide = "xyz" if any(_is_rounded(views[axis][slots]) for axis in "xyz") else ""
    kinds = {name: "double" if name in wide else "float" for name in names}
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment SplatRenderMode: {mode}"] if mode else []
    lines += [f"element vertex {len(slots)}"]
    lines += [f"property {kind} {name}" for name, kind in kinds.items()]
    file.write("\n".join([*lines, "end_header", ""]).encode())
    codes = {"float": "<f4", "double": "<f8"}
    dtype = np.dtype([(name, codes[kind]) for name, kind in kinds.items()])
    nonfinite = 0
    for start in range(0, len(slots), CHUNK_ROWS):
        chosen = slots[start : start + CHUNK_ROWS]
        table = np.zeros(len(chosen), dtype)
        finite = np.ones(len(chosen), bool)
        with np.errstate(over="ignore"):
            for name, view in views.items():
                table[name] = view[chosen]
                finite &= np.isfinite(table[name])
        nonfinite += int((~finite).sum())
        file.write(table.tobytes())
    return nonfinite


def _is_rounded(values: np.ndarray) -> bool:
    """Return True if float32 does not represent all values."""
    with np.errstate(over="ignore"):
        return not np.array_equal(values.astype(np.float32), values, equal_nan=True)


FORMAT = Format("ply", (".ply",), read_ply, write_ply, render_mode, (ANY_MODE,))
PACKED_FORMAT = Format(
    "compressed ply",
    (".compressed.ply",),
    read_ply,
    write_packed_ply,
    render_mode,
    (ANY_MODE,),
)
