"""Gaussians in SPZ files (Niantic, https://github.com/nianticlabs/spz).

A file is a gzip stream of a header and then, each for all Gaussians, means of 24 bits a
number, opacities, colours and log scales of 8, quaternions of 32 bits, and harmonics of
8. Its axes are x right, y up, z backward: ours after half a turn about x. Versions 2
and 3 are read, 3 is written.
"""

import gzip
import math
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from struct import Struct
from typing import BinaryIO, cast

import jax.numpy as jnp
import numpy as np

from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, make_gaussians
from gsjax.io import common
from gsjax.io.ply_rows import CHUNK_ROWS
from gsjax.math.sh import num_bases, sh_basis
from gsjax.runtime.files import opened, replacing
from gsjax.runtime.memory import Estimate, require

_MAGIC = b"NGSP"
_REMEDY = "export or download it again"
_HEADER = Struct("<4sIIBBBB")
# Flags: trained with antialiasing; data follow the harmonics.
_ANTIALIASED, _EXTENSIONS = 1, 2
_MAX_WRITTEN_DEGREE = 3  # more is not read by most programs
# A mean is an integer of 24 bits divided by 2 to the power of ``fraction``.
_MAX_FRACTION, _MAX_MEAN = 20, 2**23 - 1
_COLOR, _SCALE, _SHIFT = 0.15, 16, 10
_BITS = (6, 5)  # kept of harmonics of degree 1, and above; zero bits compress well
_MAX_RATIO = 1032  # of any deflated data
_HALF_TURN = np.array([1.0, -1.0, -1.0])
_MIN_OPACITY = 0.25 / 255  # rounds to 0


def render_mode(path: str | PathLike[str]) -> str | None:
    """Return "mip" if an SPZ file says that its scene was trained with antialiasing.

    The flag does not tell the size of the filter; gsjax draws such files with that of
    Mip-Splatting.

    Raises:
      InputError: as `read_spz`, from the header alone.
    """
    path = Path(path)
    with _opened(path) as (stream, _):
        return "mip" if _read_header(stream, path)[-1] & _ANTIALIASED else None


@contextmanager
def _opened(path: Path) -> Iterator[tuple[BinaryIO, int]]:
    """Yield the inflated stream of a file, and the size of the file."""
    with opened(path, "an .spz file") as file:
        size = file.seek(0, 2)
        file.seek(0)
        if file.read(4) == _MAGIC:
            what = "expected SPZ of version 2 or 3, got 4 or later"
            raise InputError(f"{path}: {what}; convert it, for example with SuperSplat")
        file.seek(0)
        try:
            with gzip.GzipFile(fileobj=file) as stream:
                yield cast(BinaryIO, stream), size
        except (gzip.BadGzipFile, zlib.error, EOFError) as error:
            what = f"not an SPZ file, or damaged or truncated: {error}"
            raise InputError(f"{path}: {what}; {_REMEDY}") from error


def read_spz(path: str | PathLike[str]) -> Gaussians:
    """Read an SPZ file of version 2 or 3 and SH degree 0 to 4.

    Trailing bytes and extensions are ignored with a warning. A file that was trained
    with antialiasing is warned about: `RasterConfig` must be told. See
    `render_mode`.

    Returns:
      Gaussians with capacity max(N, 1), in the order of the file.

    Raises:
      InputError: if the file cannot be read, is not an SPZ, has another version, or is
        damaged or truncated.
      CapacityError: if memory is too small; raised before the body is read.
    """
    path = Path(path)
    with _opened(path) as (stream, size):
        return _read(stream, path, size)


def _read(stream: BinaryIO, path: Path, size: int) -> Gaussians:
    version, count, degree, fraction, flags = _read_header(stream, path)
    bases = num_bases(degree)
    widths = {"means": 9, "opacities": 1, "colors": 3, "scales": 3}
    widths["quats"] = 3 if version == 2 else 4
    widths["sh"] = 3 * (bases - 1)
    if count * sum(widths.values()) > _MAX_RATIO * size:
        raise InputError(
            f"{path}: the header declares {count:,} Gaussians, which {size:,} bytes "
            f"cannot hold; the file is truncated or damaged: {_REMEDY}"
        )
    estimate = Estimate({"values as read": count * (220 + 16 * 3 * bases)})
    remedy = "reduce the file with the tool that made it"
    require(estimate, f"{path}: {count:,} Gaussians", remedy)
    parts: dict[str, np.ndarray] = {}
    for name, width in widths.items():
        raw = stream.read(count * width)
        if len(raw) < count * width:
            raise InputError(
                f"{path}: expected {count * width:,} bytes of {name}, got {len(raw):,}"
                f"; the file is truncated: {_REMEDY}"
            )
        parts[name] = np.frombuffer(raw, np.uint8).reshape(count, width)
    if stream.read(1):
        what = "bytes after the last Gaussian are ignored"
        if flags & _EXTENSIONS:
            what = "extensions are ignored, and may change colours"
        common.warn(f"{path}: {what}")
    if flags & _ANTIALIASED:
        remedy = "render it with RasterConfig(antialias=True, dilation=0.1)"
        common.warn(f"{path}: the scene was trained with antialiasing; {remedy}")
    sh = np.zeros((count, bases, 3), np.float32)
    sh[:, 0] = (parts["colors"] / 255 - 0.5) / _COLOR
    rest = parts["sh"].reshape(count, bases - 1, 3)
    signs = _signs(degree)
    sh[:, 1:] = (rest.astype(np.float32) - 128) / 128 * signs[1:, None]
    return make_gaussians(
        means=_integers(parts["means"]) / 2.0**fraction * _HALF_TURN,
        quats=_unpack_quats(parts["quats"]),
        log_scales=parts["scales"].astype(np.float32) / _SCALE - _SHIFT,
        logit_opacities=_logits(parts["opacities"][:, 0]),
        sh=sh,
        capacity=None,
    )


def _read_header(stream: BinaryIO, path: Path) -> tuple[int, int, int, int, int]:
    """Return version, number of Gaussians, degree, fraction and flags."""
    raw = stream.read(_HEADER.size)
    if len(raw) < _HEADER.size or raw[:4] != _MAGIC:
        raise InputError(
            f"{path}: expected an SPZ header of {_HEADER.size} bytes that starts with "
            f"{_MAGIC!r}, got {raw[:8]!r}; {_REMEDY}"
        )
    _, version, rows, degree, fraction, flags, _ = _HEADER.unpack(raw)
    for name, value, least, most in (
        *(("version", version, 2, 3), ("degree", degree, 0, 4)),
        ("fraction", fraction, 0, 24),
    ):
        if not least <= value <= most:
            expected = f"a header with {name} {least} to {most}, got {value}"
            raise InputError(
                f"{path}: expected {expected}; export it in another version"
            )
    return version, rows, degree, fraction, flags


def _logits(opacities: np.ndarray) -> np.ndarray:
    """Return logits of [N] bytes; 0 and 255 stand for a quarter of a step within."""
    share = np.clip(opacities / 255, _MIN_OPACITY, 1 - _MIN_OPACITY)
    return np.log(share / (1 - share))


def _integers(raw: np.ndarray) -> np.ndarray:
    """Return [N, 3] signed integers of 24 bits, little-endian, of [N, 9] bytes."""
    low, middle, high = (raw[:, k::3].astype(np.int32) for k in range(3))
    return low + 256 * middle + 65536 * (high - 256 * (high > 127))


def _unpack_quats(raw: np.ndarray) -> np.ndarray:
    """Return unit quaternions wxyz [N, 4] in our axes, from 3 or 4 bytes."""
    xyzw = np.zeros((len(raw), 4))
    if raw.shape[1] == 3:
        xyzw[:, :3] = raw / 127.5 - 1
        largest = np.full(len(raw), 3)
    else:
        packed = np.ascontiguousarray(raw).view("<u4")[:, 0].astype(np.int64)
        largest = packed >> 30
        for axis in reversed(range(4)):
            stored = largest != axis
            value = (packed & 511) / 511 * math.sqrt(0.5)
            value = np.where(packed & 512, -value, value)
            xyzw[:, axis] = np.where(stored, value, 0)
            packed = np.where(stored, packed >> 10, packed)
    rest = np.sqrt(np.maximum(0, 1 - np.sum(xyzw**2, 1)))
    xyzw[np.arange(len(raw)), largest] = rest
    xyzw[:, :3] *= _HALF_TURN
    return xyzw[:, [3, 0, 1, 2]]


def _pack_quats(wxyz: np.ndarray) -> np.ndarray:
    """Pack the three smallest components and the index of the largest in 4 bytes."""
    xyzw = wxyz[:, [1, 2, 3, 0]] * [*_HALF_TURN, 1]
    largest = np.abs(xyzw).argmax(1)
    # The largest is made positive: -q is the rotation q.
    xyzw = xyzw * np.where(np.take_along_axis(xyzw, largest[:, None], 1) < 0, -1, 1)
    packed = largest.astype(np.int64)
    for axis in range(4):
        value = xyzw[:, axis]
        size = np.rint(511 * np.abs(value) / math.sqrt(0.5)).astype(np.int64)
        one = np.where(value < 0, 512, 0) + np.minimum(size, 511)
        packed = np.where(largest == axis, packed, (packed << 10) + one)
    return packed.astype("<u4")


def _signs(degree: int) -> np.ndarray:
    """Return the factor [K] of each basis function under half a turn about x."""
    direction = np.array([0.48, 0.6, 0.64])  # where no basis function is zero
    ours, theirs = (
        np.asarray(sh_basis(degree, *jnp.asarray(d)))
        for d in (direction, direction * _HALF_TURN)
    )
    return np.sign(ours * theirs).astype(np.float32)


def write_spz(
    path: str | PathLike[str],
    gaussians: Gaussians,
    *,
    overwrite: bool = False,
    mode: str | None = None,
) -> None:
    """Write the active Gaussians as an SPZ file of version 3.

    Means are rounded to 2⁻²⁰, or to 2⁻²³ of the largest; log scales to 1/16 from -10
    to 5.9; opacities and colours to 8 bits; harmonics to 6 bits of -1 to 1 in degree 1,
    5 above. Values out of range are clipped with a warning.

    Args:
      path, gaussians, overwrite: as `gsjax.io.formats.save`; SH degree 0 to 3.
      mode: "mip" records that the scene was trained with antialiasing.

    Raises:
      InputError: as `write_ply`; if a value is NaN, or infinite and not a logit, if a
        mean exceeds 8 million, if the degree is 4, or if nothing would be drawn.
      CapacityError: if memory is too small.
    """
    path = Path(path)
    common.require_new(path, overwrite)
    rows, fraction = _checked_rows(path, gaussians)
    _warn_of_losses(path, rows, fraction)
    count, degree = len(rows["means"]), gaussians.sh_degree
    means = np.rint(rows["means"].astype(np.float64) * 2.0**fraction * _HALF_TURN)
    scales = _SCALE * (rows["log_scales"].astype(np.float64) + _SHIFT)
    flags = _ANTIALIASED * (mode == "mip")
    with (
        replacing(path, durable=True) as file,
        gzip.GzipFile("", "wb", 6, file, mtime=0) as stream,
    ):
        stream.write(_HEADER.pack(_MAGIC, 3, count, degree, fraction, flags, 0))
        integers = np.ascontiguousarray(means.astype("<i4")).view(np.uint8)
        stream.write(integers.reshape(-1, 4)[:, :3].tobytes())
        stream.write(common.opacity_bytes(rows["logit_opacities"]).tobytes())
        stream.write(common.to_bytes(255 * (0.5 + _COLOR * rows["sh"][:, 0])).tobytes())
        stream.write(common.to_bytes(scales).tobytes())
        stream.write(_pack_quats(rows["quats"]).tobytes())
        for start in range(0, count, CHUNK_ROWS):
            some = rows["sh"][start : start + CHUNK_ROWS]
            stream.write(_harmonics(some, degree).tobytes())


def _checked_rows(
    path: Path, gaussians: Gaussians
) -> tuple[dict[str, np.ndarray], int]:
    """Return the Gaussians to write, and the bits of the fraction of their means."""
    degree = gaussians.sh_degree
    if degree > _MAX_WRITTEN_DEGREE:
        raise InputError(
            f"{path}: expected SH degree 0 to {_MAX_WRITTEN_DEGREE}, got {degree}; cut "
            "it with gsjax.with_sh_degree (--sh-degree)"
        )
    slots, bases = gaussians.capacity, num_bases(degree)
    estimate = Estimate({"values to be written": slots * (300 + 16 * 3 * bases)})
    remedy = "leave some out (export --min-opacity), or write a .ply"
    require(estimate, f"{path}: {slots:,} Gaussians", remedy)
    rows = common.visible_rows(path, gaussians)
    largest = float(np.abs(rows["means"]).max(initial=0))
    if largest > _MAX_MEAN:
        raise InputError(
            f"{path}: expected means up to {_MAX_MEAN:,}, the limit of SPZ, got "
            f"{largest:.3g}; move the scene nearer to the origin, or write a .ply"
        )
    fraction = math.log2(_MAX_MEAN / largest) if largest else _MAX_FRACTION
    return rows, min(_MAX_FRACTION, math.floor(fraction))


def _harmonics(sh: np.ndarray, degree: int) -> np.ndarray:
    """Return [N, K - 1, 3] bytes of [N, K, 3]: 128 (1 + value), to the bits kept."""
    turned = sh[:, 1:] * _signs(degree)[1:, None]
    first, above = _BITS
    steps = np.full((turned.shape[1], 1), 2.0 ** (8 - above))
    steps[:3] = 2.0 ** (8 - first)
    return common.to_bytes(np.rint(128 * (1 + turned) / steps) * steps)


def _warn_of_losses(path: Path, rows: dict[str, np.ndarray], fraction: int) -> None:
    scales, sh = rows["log_scales"], rows["sh"]
    sizes = np.exp(np.minimum(scales.max(1, initial=-np.inf), 80).astype(np.float64))
    losses = {
        "log scales beyond -10 to 5.9": (np.abs(scales + 2.03) > 8.0).any(1),
        "colours beyond -0.44 to 1.44": (np.abs(sh[:, 0]) > 3.35).any(1),
        "harmonics beyond -1 to 1": (np.abs(sh[:, 1:]) > 1.05).any((1, 2)),
        "means rounded by a tenth of their size": 2.0**-fraction / 2
        > common.MAX_SHIFT * sizes,
    }
    for what, lost in losses.items():
        if lost.any():
            common.warn(
                f"{path}: {lost.sum():,} of {len(lost):,} Gaussians have {what}"
            )


FORMAT = common.Format("SPZ", (".spz",), read_spz, write_spz, render_mode, ("mip",))
