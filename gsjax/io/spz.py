"""Gaussians in SPZ files (Niantic, https://github.com/nianticlabs/spz).

A file holds, each for all Gaussians, means of 24 bits a number, opacities, colours and
log scales of 8, quaternions of 24 or 32 bits, and harmonics of 8. Its axes are x right,
y up, z backward: ours after half a turn about x. Versions 2, 3 and 4 are read, 3 and 4
are written; `gsjax.io.spz_container` has the difference. Some writers, such as
splat-transform 3.7, store our axes and do not say so.
"""

import math
from collections.abc import Iterator
from os import PathLike
from pathlib import Path

import numpy as np

from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, make_gaussians
from gsjax.io import common
from gsjax.io import spz_container as container
from gsjax.io.packed_quats import (
    PackedQuats,
    join_words,
    pack_quats,
    split_words,
    unpack_quats,
)
from gsjax.io.ply_rows import CHUNK_ROWS
from gsjax.math.sh import num_bases
from gsjax.runtime.files import replacing
from gsjax.runtime.memory import Estimate, require

_COMMON_DEGREE = 3  # more is not read by most programs
# A mean is an integer of 24 bits divided by 2 to the power of ``fraction``.
_MAX_FRACTION, _MAX_MEAN = 20, 2**23 - 1
_COLOR, _SCALE, _SHIFT = 0.15, 16, 10
_BITS = (6, 5)  # of harmonics of degree 1, and above; zero bits compress well
_LEVELS = 1022  # of a component of a quaternion: a sign and 9 bits
# Signs of x, y and z by the name of the axes: right up back, right down forward.
_AXES = {"rub": (1, -1, -1), "rdf": (1, 1, 1)}
# Axes in which each basis function of `gsjax.math.sh.sh_basis` is odd.
_ODD = ("", "y", "z", "x", "xy", "yz", "", "xz", "")
_ODD += ("y", "xyz", "y", "z", "x", "z", "x")
_ODD += ("xy", "yz", "xy", "yz", "", "xz", "", "xz", "")
_AXES_RECORD = 0xADBE0003  # extension whose payload is one of these numbers
_AXES_NUMBERS = {4: "rub", 6: "rdf"}
_CAMERA_RECORD = 0xADBE0002  # limits of an orbit camera; does not concern Gaussians


def render_mode(path: str | PathLike[str]) -> str | None:
    """Return "mip" if an SPZ file says that its scene was trained with antialiasing.

    The flag does not tell the size of the filter; gsjax draws such files with that of
    Mip-Splatting.

    Raises:
      InputError: as `read_spz`, from the header alone.
    """
    flags = container.read_spz_header(Path(path)).flags
    return "mip" if flags & container.ANTIALIASED else None


def read_spz(path: str | PathLike[str], *, frame: str = "rub") -> Gaussians:
    """Read an SPZ file of version 2, 3 or 4 and SH degree 0 to 4.

    Bytes after the last Gaussian and unknown extensions are ignored with a warning. A
    file that was trained with antialiasing is warned about: `RasterConfig` must be
    told. See `render_mode`.

    Args:
      path: the file.
      frame: axes of a file that does not record them: "rub" (right, up, back), as the
        specification says, or "rdf" (right, down, forward) for writers that store the
        axes of PLY files. A record of the axes in the file takes precedence.

    Returns:
      Gaussians with capacity max(N, 1), in the order of the file.

    Raises:
      InputError: if the file cannot be read, is not an SPZ, has another version or
        unknown axes, or is damaged or truncated; or if ``frame`` is unknown.
      CapacityError: if memory is too small; raised before the body is read.
    """
    path = Path(path)
    if frame not in _AXES:
        got = f"got {frame!r}; choose that of the program that wrote {path}"
        raise InputError(f"frame: expected one of {[*_AXES]}, {got}")
    header, blocks, extensions = container.read_spz_content(path)
    axes = _recorded_axes(path, extensions) or _AXES[frame]
    if header.flags & container.ANTIALIASED:
        remedy = "render it with RasterConfig(antialias=True, dilation=0.1)"
        common.warn(f"{path}: the scene was trained with antialiasing; {remedy}")
    bases = num_bases(header.degree)
    sh = np.zeros((header.rows, bases, 3), np.float32)
    sh[:, 0] = (blocks["colors"] / 255 - 0.5) / _COLOR
    rest = blocks["sh"].reshape(header.rows, bases - 1, 3)
    signs = _signs(header.degree, axes)[1:, None] / 128
    np.multiply(rest.astype(np.float32) - 128, signs, out=sh[:, 1:])
    return make_gaussians(
        means=_integers(blocks["means"]) / 2.0**header.fraction * axes,
        quats=_unpacked(blocks["quats"], axes),
        log_scales=blocks["scales"].astype(np.float32) / _SCALE - _SHIFT,
        logit_opacities=common.byte_logits(blocks["opacities"][:, 0]),
        sh=sh,
        capacity=None,
    )


def _recorded_axes(path: Path, extensions: dict[int, bytes]) -> tuple | None:
    """Return the signs of the axes that a file records, or None without a record."""
    unknown = sorted(extensions.keys() - {_AXES_RECORD, _CAMERA_RECORD})
    if unknown:
        kinds = ", ".join(f"{kind:#x}" for kind in unknown)
        common.warn(f"{path}: extensions of type {kinds} are ignored")
    payload = extensions.get(_AXES_RECORD)
    if payload is None:
        return None
    number = int.from_bytes(payload, "little")
    if len(payload) != 4 or number not in _AXES_NUMBERS:
        known = ", ".join(f"{key} ({axes})" for key, axes in _AXES_NUMBERS.items())
        raise InputError(
            f"{path}: expected axes of {known} in the extension {_AXES_RECORD:#x}, got "
            f"{payload[:8].hex() or 'no number'}; export the file in one of them"
        )
    return _AXES[_AXES_NUMBERS[number]]


def _integers(raw: np.ndarray) -> np.ndarray:
    """Return [N, 3] signed integers of 24 bits, little-endian, of [N, 9] bytes."""
    low, middle, high = (raw[:, k::3].astype(np.int32) for k in range(3))
    return low + 256 * middle + 65536 * (high - 256 * (high > 127))


def _quat_signs(axes: tuple[int, int, int]) -> np.ndarray:
    """Return the factors [4] of a quaternion xyzw in axes with other signs."""
    x, y, z = axes
    return np.asarray([y * z, x * z, x * y, 1])


def _unpacked(raw: np.ndarray, axes: tuple[int, int, int]) -> np.ndarray:
    """Return unit quaternions wxyz [N, 4] in our axes, from 3 or 4 bytes."""
    if raw.shape[1] == 3:
        xyzw = np.zeros((len(raw), 4))
        xyzw[:, :3] = raw / 127.5 - 1
        xyzw[:, 3] = np.sqrt(np.maximum(0, 1 - np.sum(xyzw**2, 1)))
    else:
        words = split_words(np.ascontiguousarray(raw).view("<u4")[:, 0])
        # A sign above a size of 9 bits.
        sizes, half = words.codes & 511, _LEVELS // 2
        codes = half + np.where(words.codes > 511, -sizes, sizes)
        xyzw = unpack_quats(PackedQuats(words.dropped, codes), _LEVELS)
    return (xyzw * _quat_signs(axes))[:, [3, 0, 1, 2]]


def _packed(wxyz: np.ndarray) -> np.ndarray:
    """Return quaternions [N, 4] in words [N] of 32 bits."""
    xyzw = wxyz[:, [1, 2, 3, 0]] * _quat_signs(_AXES["rub"])
    dropped, codes = pack_quats(xyzw, _LEVELS)
    signed = codes - _LEVELS // 2
    words = np.abs(signed) + 512 * (signed < 0)
    return join_words(PackedQuats(dropped, words)).astype("<u4")


def _signs(degree: int, axes: tuple[int, int, int]) -> np.ndarray:
    """Return the factor [K] of each basis function in axes with other signs."""
    sign = dict(zip("xyz", axes))
    factors = (math.prod(sign[axis] for axis in odd) for odd in _ODD)
    return np.fromiter(factors, np.float32)[: num_bases(degree)]


def write_spz(
    path: str | PathLike[str],
    gaussians: Gaussians,
    *,
    overwrite: bool = False,
    mode: str | None = None,
    version: int = container.PLAIN_VERSION,
    harmonic_bits: tuple[int, int] = _BITS,
) -> None:
    """Write the active Gaussians as an SPZ file of version 3 or 4.

    Means are rounded to 2⁻²⁰, or to 2⁻²³ of the largest; log scales to 1/16 from -10
    to 5.9; opacities and colours to 8 bits; harmonics to the given bits of -1 to 1.
    Values out of range are clipped with a warning, and so is SH degree 4
    warned about, which most programs reject. The axes are right, up, back.

    Args:
      path, gaussians, overwrite: as `gsjax.io.formats.save`.
      mode: "mip" records that the scene was trained with antialiasing.
      version: 4 is what Niantic's library and splat-transform write, and is smaller. 3
        is read by Spark and by programs older than version 4, not by PlayCanvas.
      harmonic_bits: bits that are kept of harmonics of degree 1, and above, 1 to 8; the
        default is that of Niantic's library.

    Raises:
      InputError: as `write_ply`; if a value is NaN, or infinite and not a logit, if a
        mean exceeds 8 million, if the version is unknown, or if nothing would be drawn.
      CapacityError: if memory is too small.
    """
    path = Path(path)
    if version not in container.VERSIONS[1:]:
        known, remedy = container.VERSIONS[1:], "pass one of them"
        raise InputError(f"version: expected one of {known}, got {version!r}; {remedy}")
    if not all(1 <= bits <= 8 for bits in harmonic_bits):
        raise InputError(f"harmonic_bits: expected 1 to 8, got {harmonic_bits}")
    common.require_new(path, overwrite)
    rows, fraction = _checked_rows(path, gaussians)
    _warn_of_losses(path, rows, fraction)
    count, degree = len(rows["means"]), gaussians.sh_degree
    flags = container.ANTIALIASED * (mode == "mip")
    header = container.SpzHeader(version, count, degree, fraction, flags)
    means = np.rint(rows["means"] * (2.0**fraction * np.asarray(_AXES["rub"])))
    integers = np.ascontiguousarray(means.astype("<i4")).view(np.uint8)
    scales = _SCALE * (rows["log_scales"].astype(np.float64) + _SHIFT)
    arrays = {
        "means": integers.reshape(-1, 4)[:, :3],
        "opacities": common.opacity_bytes(rows["logit_opacities"]),
        "colors": common.to_bytes(255 * (0.5 + _COLOR * rows["sh"][:, 0])),
        "scales": common.to_bytes(scales),
        "quats": _packed(rows["quats"]),
    }
    blocks = {name: iter([array.tobytes()]) for name, array in arrays.items()}
    blocks["sh"] = _harmonics(rows["sh"], degree, harmonic_bits)
    with replacing(path, durable=True) as file:
        container.write_spz_content(file, header, blocks)


def _checked_rows(
    path: Path, gaussians: Gaussians
) -> tuple[dict[str, np.ndarray], int]:
    """Return the Gaussians to write, and the bits of the fraction of their means."""
    degree = gaussians.sh_degree
    if degree > _COMMON_DEGREE:
        common.warn(
            f"{path}: most programs reject SPZ files of SH degree {degree}; cut it to "
            f"{_COMMON_DEGREE} with gsjax.with_sh_degree (--sh-degree)"
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


def _harmonics(sh: np.ndarray, degree: int, bits: tuple[int, int]) -> Iterator[bytes]:
    """Yield the bytes of harmonics [N, K, 3]: 128 (1 + value), to the bits kept."""
    signs = _signs(degree, _AXES["rub"])[1:, None]
    first, above = bits
    steps = np.full(signs.shape, 2.0 ** (8 - above))
    steps[:3] = 2.0 ** (8 - first)
    for start in range(0, len(sh), CHUNK_ROWS):
        turned = sh[start : start + CHUNK_ROWS, 1:] * signs
        yield common.to_bytes(np.rint(128 * (1 + turned) / steps) * steps).tobytes()


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
