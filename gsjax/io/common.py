"""The protocol of a file format, and functions that the formats share."""

import sys
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from gsjax.errors import InputError
from gsjax.gaussians import Gaussians
from gsjax.math.sh import C0

# Rounding that moves a Gaussian by more than this part of its size is warned about.
MAX_SHIFT = 0.1
ANY_MODE = "*"
_TINY = np.finfo(np.float64).tiny
_NEARER = "move the scene nearer to the origin, or write a .ply"
_MIN_OPACITY = 0.25 / 255  # rounds to 0
_LEAST_SCALE = np.exp(-80.0)


class Format(NamedTuple):
    """A file format of Gaussians, for `gsjax.io.formats.load` and `save`.

    Attributes:
      name: short name.
      suffixes: lower-case ends of file names: (".ply",). The longest that fits selects
        the format.
      load: ``load(path) -> Gaussians``, or None if the format is only written.
      save: ``save(path, gaussians, *, overwrite) -> None``, or None if it is only read.
        With ``modes`` it also takes ``mode``, one of them or None.
      mode: ``mode(path) -> str | None``, the render mode that a file records, see
        `gsjax.io.formats.render_mode`; None if the format records none.
      modes: render modes that ``save`` records; `ANY_MODE` stands for every word.
    """

    name: str
    suffixes: tuple[str, ...]
    load: Callable[[Path], Gaussians] | None
    save: Callable[..., None] | None
    mode: Callable[[Path], str | None] | None = None
    modes: tuple[str, ...] = ()


def warn(message: str) -> None:
    """Warn at the line outside of this package that led here."""
    frame, level = sys._getframe(1), 2
    inside = ("gsjax", "contextlib")
    while frame.f_back and frame.f_globals["__name__"].partition(".")[0] in inside:
        frame, level = frame.f_back, level + 1
    warnings.warn(message, UserWarning, stacklevel=level)


def require_new(path: Path, overwrite: bool) -> None:
    """Raise `InputError` if a file exists without ``overwrite``, or has no folder."""
    if path.is_dir():
        raise InputError(f"{path}: expected a file, got a folder; pass a file name")
    if path.exists() and not overwrite:
        raise InputError(f"{path}: exists; pass overwrite=True or another name")
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} is missing; create it")


def read_exactly(file: BinaryIO, size: int, path: Path, what: str) -> bytes:
    """Return the next ``size`` bytes of a file or an inflated stream.

    Args:
      file: the stream.
      size: number of bytes, checked against the size of the file before.
      path, what: the file and the name of its part, for the message.

    Raises:
      InputError: if there are fewer.
    """
    raw = file.read(size)
    if len(raw) < size:
        raise InputError(
            f"{path}: expected {size:,} bytes of {what}, got {len(raw):,}; the file is "
            "truncated: export or download it again"
        )
    return raw


def require_degree(path: Path, degree: int, most: int) -> None:
    """Raise `InputError` if a format cannot store harmonics of this degree."""
    if degree > most:
        raise InputError(
            f"{path}: expected SH degree 0 to {most}, got {degree}; cut it with "
            "gsjax.with_sh_degree (--sh-degree)"
        )


def to_bytes(values: np.ndarray) -> np.ndarray:
    """Round to the nearest whole numbers from 0 to 255."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def opacity_bytes(logits: np.ndarray) -> np.ndarray:
    """Return opacities of [N] logits in a byte each, 255 for 1."""
    with np.errstate(over="ignore"):
        return to_bytes(255 / (1 + np.exp(-logits.astype(np.float64))))


def byte_logits(opacities: np.ndarray) -> np.ndarray:
    """Return logits [N] float32 of opacities in a byte each, 255 for 1.

    The bytes 0 and 255 stand for opacities a quarter of a step within (0, 1), or
    training could never change them.
    """
    shares = np.clip(np.arange(256) / 255, _MIN_OPACITY, 1 - _MIN_OPACITY)
    return np.log(shares / (1 - shares)).astype(np.float32)[opacities]


def byte_colors(colors: np.ndarray) -> np.ndarray:
    """Return SH coefficients of degree 0, float32, of colours in a byte each."""
    return ((np.arange(256) / 255 - 0.5) / C0).astype(np.float32)[colors]


def scale_logs(scales: np.ndarray) -> np.ndarray:
    """Return natural logarithms, float32, of σ of any shape; NaN if one is negative.

    A σ of 0, which some writers give surfels, is read as e^-80.
    """
    with np.errstate(invalid="ignore"):
        small = (scales >= 0) & (scales < _LEAST_SCALE)
        return np.log(np.where(small, _LEAST_SCALE, scales)).astype(np.float32)


_FAULTS = {
    "means": "a mean that is not finite",
    "log_scales": "a scale that is negative or not finite",
    "quats": "a quaternion that is zero or not finite",
    "sh": "a colour that is not finite",
}


def check_rows(path: Path, fields: Mapping[str, np.ndarray]) -> None:
    """Reject values that a writer of Gaussians cannot have meant.

    Args:
      path: the file, for messages.
      fields: arrays [N, …] by their names in `GaussianParams`.

    Raises:
      InputError: if a value is not finite, or a quaternion is zero; names the first
        such row.
    """
    found = {}
    for name, fault in _FAULTS.items():
        values = fields[name]
        axes = tuple(range(1, values.ndim))
        found[fault] = ~np.isfinite(values).all(axis=axes)
        if name == "quats":
            found[fault] |= ~values.any(axis=axes)
    rows = np.logical_or.reduce([*found.values()])
    if rows.any():
        first = int(rows.argmax())
        fault = next(fault for fault, bad in found.items() if bad[first])
        raise InputError(
            f"{path}: expected finite values, got {rows.sum():,} of {len(rows):,} rows "
            f"without, the first is row {first} with {fault}; the file is damaged or "
            "has another layout: export it again"
        )


def visible_rows(path: Path, gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Return the active Gaussians for a format that stores only visible ones.

    Quaternions are normalised. Gaussians whose quaternion is zero are never drawn;
    they are left out with a warning.

    Raises:
      InputError: if a value is NaN, or infinite and not a logit, or if all quaternions
        are zero.
    """
    params = gaussians.params.__dict__
    slots = np.flatnonzero(np.asarray(gaussians.active))
    rows = {name: np.asarray(array)[slots] for name, array in params.items()}
    bad = np.zeros(len(slots), bool)
    for name, array in rows.items():
        wrong = np.isnan(array) if name == "logit_opacities" else ~np.isfinite(array)
        bad |= wrong.any(axis=tuple(range(1, array.ndim)))
    if bad.any():
        raise InputError(
            f"{path}: {bad.sum()} of {len(bad)} Gaussians are NaN or infinite, which "
            f"{path.suffix} cannot store; write a .ply, or drop them (gsjax.select)"
        )
    quats = rows["quats"].astype(np.float64)
    quats /= np.maximum(np.abs(quats).max(1, initial=0), _TINY)[:, None]
    norms = np.linalg.norm(quats, axis=1)
    visible = norms > 0
    rows["quats"] = quats / np.where(visible, norms, 1)[:, None]
    if visible.all():
        return rows
    if not visible.any():
        what = f"the quaternions of all {len(visible)} Gaussians are zero"
        raise InputError(f"{path}: {what}, so nothing would be drawn; check the scene")
    lost = f"{(~visible).sum()} of {len(visible)} quaternions are zero"
    warn(f"{path}: {lost}; these Gaussians are never drawn and are left out")
    return {name: array[visible] for name, array in rows.items()}


def float32_means(path: Path, rows: dict[str, np.ndarray]) -> np.ndarray:
    """Return the means [N, 3] of rows to write, rounded to float32.

    Raises:
      InputError: if a mean exceeds float32.
    """
    means = rows["means"]
    with np.errstate(over="ignore"):
        rounded = means.astype(np.float32)
    far = np.any(~np.isfinite(rounded), axis=1)
    if far.any():
        what = f"{far.sum():,} of {len(far):,} means exceed float32"
        raise InputError(f"{path}: {what}; {_NEARER}")
    return rounded


def warn_of_moves(path: Path, stored: np.ndarray, rows: dict[str, np.ndarray]) -> None:
    """Warn if rounding moves Gaussians by a tenth of their size or more.

    Args:
      path: the file.
      stored: [N, 3] means as a file stores them.
      rows: the Gaussians, see `visible_rows`.
    """
    shift = np.abs(stored - rows["means"].astype(np.float64)).max(1, initial=0)
    largest = rows["log_scales"].max(1, initial=-np.inf).astype(np.float64)
    moved = shift > MAX_SHIFT * np.exp(np.minimum(largest, 80))
    if moved.any():
        warn(
            f"{path}: {moved.sum():,} of {len(moved):,} Gaussians have means rounded "
            f"by a tenth of their size or more; {_NEARER}"
        )
