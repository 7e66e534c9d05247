"""Gaussians in SPZ files, a fifth as large as a PLY.

A gzip stream of a header and then, each for all Gaussians: means in 24 bits a number,
opacities, colours and log scales in 8, quaternions in 32 bits together, and harmonics
in 8. Axes are x right, y up, z backward: ours after half a turn about x. Written is
version 3; 2 and 3 are read (Niantic, https://github.com/nianticlabs/spz).
"""

import gzip
import math
import zlib
from os import PathLike
from pathlib import Path
from struct import Struct
from typing import BinaryIO, NamedTuple, cast

import jax.numpy as jnp
import numpy as np

from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, make_gaussians
from gsjax.io.common import (
    MAX_SHIFT,
    drawn_rows,
    opacity_bytes,
    require_new,
    to_bytes,
    warn,
)
from gsjax.io.ply_rows import CHUNK_ROWS
from gsjax.math.sh import num_bases, sh_basis
from gsjax.runtime.files import opened, replacing
from gsjax.runtime.memory import Estimate, require

_MAGIC = b"NGSP"
_HEADER = Struct("<4sIIBBBB")
# Flags: opacities are to be compensated; there is more behind the harmonics.
_ANTIALIASED, _EXTENSIONS = 1, 2
_MOST_DEGREE = 3  # of what is written, as most programs read no more
# A mean is a whole number of 24 bits over 2 to the power of so many.
_MOST_FRACTION, _LARGEST = 20, 2**23 - 1
_COLOR, _SCALE, _SHIFT = 0.15, 16, 10
_BITS = (6, 5)  # kept of harmonics of degree 1, and above: what is zero packs well
_MOST_RATIO = 1032  # of any deflated bytes
_HALF_TURN = np.array([1.0, -1.0, -1.0])
_LEAST_OPACITY = 0.25 / 255  # which rounds to 0


class _Header(NamedTuple):
    version: int
    rows: int
    degree: int
    fraction: int
    flags: int


def read_spz(path: str | PathLike[str]) -> Gaussians:
    """Gaussians of an SPZ file of version 2 or 3, of SH degree 0 to 4.

    Trailing bytes are warned of, and so are extensions, which are not read, and a scene
    that says it was trained with antialiasing, which is for `RasterConfig` to know.

    Returns:
      Gaussians with capacity max(N, 1), in the order of the file.

    Raises:
      InputError: if the file cannot be read, is no SPZ, of another version, damaged or
        truncated.
      CapacityError: if the memory would not hold it, before it is read.
    """
    path = Path(path)
    with opened(path, "an .spz file") as file:
        size = file.seek(0, 2)
        file.seek(0)
        if file.read(4) == _MAGIC:
            raise InputError(
                f"{path}: SPZ of version 4 or later, which is not read, only 2 and 3; "
                "convert it, with SuperSplat say"
            )
        file.seek(0)
        try:
            with gzip.GzipFile(fileobj=file) as stream:
                return _read(cast(BinaryIO, stream), path, size)
        except (gzip.BadGzipFile, zlib.error, EOFError) as error:
            raise InputError(
                f"{path}: no SPZ file, damaged or truncated: {error}; a whole one is "
                "wanted"
            ) from error


def _read(stream: BinaryIO, path: Path, size: int) -> Gaussians:
    header = _read_header(stream, path)
    bases = num_bases(header.degree)
    turned = 3 if header.version == 2 else 4
    widths = {"means": 9, "opacities": 1, "colors": 3, "scales": 3}
    widths |= {"quats": turned, "sh": 3 * (bases - 1)}
    count = header.rows
    if count * sum(widths.values()) > _MOST_RATIO * size:
        raise InputError(
            f"{path}: {count:,} Gaussians by its header, and {size:,} bytes cannot "
            "hold so many: truncated or damaged; a whole file is wanted"
        )
    require(
        Estimate({"values as read": count * (220 + 16 * 3 * bases)}),
        f"{path}: {count:,} Gaussians",
        "make the file smaller where it was made",
    )
    parts: dict[str, np.ndarray] = {}
    for name, width in widths.items():
        raw = stream.read(count * width)
        if len(raw) < count * width:
            raise InputError(
                f"{path}: truncated within {name}: {len(raw):,} of {count * width:,} "
                "bytes are there; a whole file is wanted"
            )
        parts[name] = np.frombuffer(raw, np.uint8).reshape(count, width)
    if stream.read(1):
        what = "extensions are not read, and colours may be others with them"
        if not header.flags & _EXTENSIONS:
            what = "bytes behind the last Gaussian are ignored"
        warn(f"{path}: {what}")
    if header.flags & _ANTIALIASED:
        warn(
            f"{path}: says that it was trained with antialiasing, and looks right with "
            "RasterConfig(antialias=True)"
        )
    signs = _signs(header.degree)
    sh = np.zeros((count, bases, 3), np.float32)
    sh[:, 0] = (parts["colors"] / 255 - 0.5) / _COLOR
    rest = parts["sh"].reshape(count, bases - 1, 3)
    sh[:, 1:] = (rest.astype(np.float32) - 128) / 128 * signs[1:, None]
    return make_gaussians(
        means=_whole(parts["means"]) / 2.0**header.fraction * _HALF_TURN,
        quats=_quats(parts["quats"]),
        log_scales=parts["scales"].astype(np.float32) / _SCALE - _SHIFT,
        logit_opacities=_logits(parts["opacities"][:, 0]),
        sh=sh,
        capacity=None,
    )


def _read_header(stream: BinaryIO, path: Path) -> _Header:
    raw = stream.read(_HEADER.size)
    if len(raw) < _HEADER.size or raw[:4] != _MAGIC:
        raise InputError(
            f"{path}: begins with {raw[:8]!r} where an SPZ file has {_MAGIC!r} and a "
            f"header of {_HEADER.size} bytes; one that is whole is wanted"
        )
    _, version, rows, degree, fraction, flags, _ = _HEADER.unpack(raw)
    header = _Header(version, rows, degree, fraction, flags)
    wanted = {"version": (2, 3), "degree": range(5), "fraction": range(25)}
    for name, values in wanted.items():
        value = getattr(header, name)
        if value not in values:
            raise InputError(
                f"{path}: {name} {value} in its header; {values[0]} to {values[-1]} "
                "are read"
            )
    return header


def _logits(opacities: np.ndarray) -> np.ndarray:
    """Logits of [N] bytes: of 0 and 255 those of a quarter of a step within."""
    share = np.clip(opacities / 255, _LEAST_OPACITY, 1 - _LEAST_OPACITY)
    return np.log(share / (1 - share))


def _whole(raw: np.ndarray) -> np.ndarray:
    """[N, 3] of [N, 9] bytes: whole numbers of 24 bits, the lowest first."""
    low, middle, high = (raw[:, k::3].astype(np.int32) for k in range(3))
    return low + 256 * middle + 65536 * (high - 256 * (high > 127))


def _quats(raw: np.ndarray) -> np.ndarray:
    """[N, 4] wxyz of norm 1, in our axes, from 3 or 4 bytes."""
    xyzw = np.zeros((len(raw), 4))
    if raw.shape[1] == 3:
        xyzw[:, :3] = raw / 127.5 - 1
        largest = np.full(len(raw), 3)
    else:
        packed = np.ascontiguousarray(raw).view("<u4")[:, 0].astype(np.int64)
        largest = packed >> 30
        for axis in reversed(range(4)):
            there = largest != axis
            value = (packed & 511) / 511 * math.sqrt(0.5)
            value = np.where(packed & 512, -value, value)
            xyzw[:, axis] = np.where(there, value, 0)
            packed = np.where(there, packed >> 10, packed)
    rest = np.sqrt(np.maximum(0, 1 - np.sum(xyzw**2, 1)))
    xyzw[np.arange(len(raw)), largest] = rest
    xyzw[:, :3] *= _HALF_TURN
    return xyzw[:, [3, 0, 1, 2]]


def _packed_quats(wxyz: np.ndarray) -> np.ndarray:
    """What `_quats` reads from 4 bytes: the three smallest, and which the largest is.

    -q is the same rotation as q; so of the largest, which is positive, nothing else is
    to be said.
    """
    xyzw = wxyz[:, [1, 2, 3, 0]] * [*_HALF_TURN, 1]
    largest = np.abs(xyzw).argmax(1)
    xyzw = xyzw * np.where(np.take_along_axis(xyzw, largest[:, None], 1) < 0, -1, 1)
    packed = largest.astype(np.int64)
    for axis in range(4):
        value = xyzw[:, axis]
        size = np.rint(511 * np.abs(value) / math.sqrt(0.5)).astype(np.int64)
        one = np.where(value < 0, 512, 0) + np.minimum(size, 511)
        packed = np.where(largest == axis, packed, (packed << 10) + one)
    return packed.astype("<u4")


def _signs(degree: int) -> np.ndarray:
    """[K] the factor of each band's functions under half a turn about x."""
    direction = np.array([0.48, 0.6, 0.64])  # where none is zero
    here, there = (
        np.asarray(sh_basis(degree, *jnp.asarray(d)))
        for d in (direction, direction * _HALF_TURN)
    )
    return np.sign(here * there).astype(np.float32)


def write_spz(
    path: str | PathLike[str],
    gaussians: Gaussians,
    *,
    overwrite: bool = False,
    antialias: bool = False,
) -> None:
    """Write the active Gaussians as an SPZ file of version 3.

    Means are rounded to 2⁻²⁰, or to 2⁻²³ of the largest; log scales to 1/16 from -10
    to 5.9; opacities and colours to 8 bits; harmonics to 6 bits of -1 to 1 in degree 1,
    5 above. What lies beyond is warned of.

    Args:
      path: the file to write; it appears complete or not at all.
      gaussians: the scene, of SH degree 0 to 3; inactive slots are left out.
      overwrite: whether an existing file may be replaced.
      antialias: whether it was trained with that, which the file says then.

    Raises:
      InputError: as `write_ply`; if a value is NaN, or infinite and no opacity, a mean
        larger than 8 million, or the degree 4, or none of the Gaussians is drawn.
      CapacityError: if the memory would not hold what is made.
    """
    path, degree = Path(path), gaussians.sh_degree
    require_new(path, overwrite)
    if degree > _MOST_DEGREE:
        raise InputError(
            f"{path}: SH degree {degree}; SPZ has up to {_MOST_DEGREE}: cut it with "
            "gsjax.with_sh_degree (--sh-degree)"
        )
    slots, bases = gaussians.capacity, num_bases(degree)
    require(
        Estimate({"values to be written": slots * (300 + 16 * 3 * bases)}),
        f"{path}: {slots:,} Gaussians",
        "leave some out (export --min-opacity), or write a .ply",
    )
    rows = drawn_rows(path, gaussians)
    largest = float(np.abs(rows["means"]).max(initial=0))
    if largest > _LARGEST:
        raise InputError(
            f"{path}: a mean of {largest:.3g} is beyond the {_LARGEST:,} of SPZ; move "
            "the scene nearer to the origin, or write a .ply"
        )
    room = math.log2(_LARGEST / largest) if largest else _MOST_FRACTION
    fraction = min(_MOST_FRACTION, math.floor(room))
    _warn_of_values(path, rows, fraction)
    means = np.rint(rows["means"].astype(np.float64) * 2.0**fraction * _HALF_TURN)
    colors = 255 * (0.5 + _COLOR * rows["sh"][:, 0])
    count = len(means)
    flags = _ANTIALIASED * antialias
    header = _HEADER.pack(_MAGIC, 3, count, degree, fraction, flags, 0)
    with (
        replacing(path, durable=True) as file,
        gzip.GzipFile("", "wb", 6, file, mtime=0) as stream,
    ):
        stream.write(header)
        whole = np.ascontiguousarray(means.astype("<i4")).view(np.uint8)
        stream.write(whole.reshape(-1, 4)[:, :3].tobytes())
        stream.write(opacity_bytes(rows["logit_opacities"]).tobytes())
        stream.write(to_bytes(colors).tobytes())
        scales = _SCALE * (rows["log_scales"].astype(np.float64) + _SHIFT)
        stream.write(to_bytes(scales).tobytes())
        stream.write(_packed_quats(rows["quats"]).tobytes())
        for start in range(0, count, CHUNK_ROWS):
            some = rows["sh"][start : start + CHUNK_ROWS]
            stream.write(_harmonics(some, degree).tobytes())


def _harmonics(sh: np.ndarray, degree: int) -> np.ndarray:
    """[N, K - 1, 3] bytes of [N, K, 3]: 128 (1 + value), to the bits that are kept."""
    turned = sh[:, 1:] * _signs(degree)[1:, None]
    first, above = _BITS
    steps = np.full((turned.shape[1], 1), 2.0 ** (8 - above))
    steps[:3] = 2.0 ** (8 - first)
    return to_bytes(np.rint(128 * (1 + turned) / steps) * steps)


def _warn_of_values(path: Path, rows: dict[str, np.ndarray], fraction: int) -> None:
    """Of what SPZ holds only clipped, or rounds too far."""
    scales, sh = rows["log_scales"], rows["sh"]
    sizes = np.exp(np.minimum(scales.max(1, initial=-np.inf), 80).astype(np.float64))
    told = {
        "log scales beyond -10 to 5.9": (np.abs(scales + 2.03) > 8.0).any(1),
        "colours beyond -0.44 to 1.44": (np.abs(sh[:, 0]) > 3.35).any(1),
        "harmonics beyond -1 to 1": (np.abs(sh[:, 1:]) > 1.05).any((1, 2)),
        "means rounded by a tenth of their size": 2.0**-fraction / 2
        > MAX_SHIFT * sizes,
    }
    for what, wrong in told.items():
        if wrong.any():
            warn(f"{path}: {wrong.sum():,} of {len(wrong):,} Gaussians have {what}")
