"""The numbers that a file format can store, and rounding to every 2ᵏth of them.

A number is stored as a whole code, ``forward(value)`` rounded. Where an error is
tolerated, a multiple of 2ᵏ is stored instead, which takes k bits less after entropy
coding. Formats without entropy coding have no lattice: there nothing is gained.

Codes are computed for NumPy arrays, and for JAX arrays in training.

Axis legend: N Gaussians.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.math.clustering import codebook

Rows = Mapping[str, np.ndarray]

_MOST_BITS = 5  # left out of a number: curvature describes small changes only
_MOST_OF_MEANS = 12
_FINEST = 1 / 64  # steps of log scales and of colours in SOG, whose tables are free
_TABLE = 256  # entries of a table of SOG
_QUARTER = 0.25 / 255  # opacities of the bytes 0 and 255 are this far within


class Axis(NamedTuple):
    """Codes of one kind of number.

    Attributes:
      forward: values → codes, before rounding.
      inverse: codes → values.
      low, high: least and greatest code.
      most: number of distinct values that the file can hold; 0 for no limit.
      most_bits: largest k.
    """

    forward: Callable[[np.ndarray], np.ndarray]
    inverse: Callable[[np.ndarray], np.ndarray]
    low: float = -np.inf
    high: float = np.inf
    most: int = 0
    most_bits: int = _MOST_BITS


class Lattice(NamedTuple):
    """The axes of a format.

    Attributes:
      means, log_scales, logit_opacities, colors: axes; colours are SH degree 0.
      quats: axis of the three smaller components of a unit quaternion.
    """

    means: Axis
    log_scales: Axis
    logit_opacities: Axis
    colors: Axis
    quats: Axis


def has_lattice(suffix: str) -> bool:
    """Return whether a format has entropy coding, and so a lattice."""
    return suffix in _LATTICES


def lattice_of(
    suffix: str, rows: Rows, part: np.ndarray | None = None
) -> Lattice | None:
    """Return the lattice of a format for these Gaussians, or None if it has none.

    ``part`` [N] is the file in which each is stored; None for one file.
    """
    if not has_lattice(suffix):
        return None
    count = len(rows["means"])
    return _LATTICES[suffix](rows, np.zeros(count, int) if part is None else part)


def _of_sog(rows: Rows, part: np.ndarray) -> Lattice:
    means = np.asarray(rows["means"], np.float64)
    logs = np.sign(means) * np.log1p(np.abs(means))
    # Each file has a box of its own.
    low, span = np.empty_like(logs), np.empty_like(logs)
    for one in np.unique(part):
        inside = part == one
        low[inside] = logs[inside].min(0)
        width = logs[inside].max(0) - logs[inside].min(0)
        span[inside] = np.where(width > 0, width, 1.0)

    def forward(values):
        xp = module_of(values)
        return (xp.sign(values) * xp.log1p(xp.abs(values)) - low) / span * 65535

    def inverse(codes):
        xp = module_of(codes)
        logs = low + codes / 65535 * span
        return xp.sign(logs) * xp.expm1(xp.abs(logs))

    return Lattice(
        means=Axis(forward, inverse, 0, 65535, most_bits=_MOST_OF_MEANS),
        log_scales=_uniform(_FINEST)._replace(most=_TABLE),
        logit_opacities=_OPACITY,
        colors=_uniform(_FINEST)._replace(most=_TABLE),
        quats=Axis(
            lambda v: (v * np.sqrt(2) + 1) * 127.5,
            lambda c: (c / 127.5 - 1) / np.sqrt(2),
            0,
            255,
        ),
    )


def _of_spz(rows: Rows, part: np.ndarray) -> Lattice:
    del part  # steps are powers of two: those of all hold in each file
    largest = float(np.abs(rows["means"]).max(initial=0))
    bits = np.floor(np.log2((2**23 - 1) / largest)) if largest else 20
    return Lattice(
        means=_uniform(2.0 ** -min(bits, 20))._replace(most_bits=_MOST_OF_MEANS),
        log_scales=Axis(lambda v: 16 * (v + 10), lambda c: c / 16 - 10, 0, 255),
        logit_opacities=_OPACITY,
        colors=Axis(
            lambda v: 255 * (0.5 + 0.15 * v), lambda c: (c / 255 - 0.5) / 0.15, 0, 255
        ),
        quats=_uniform(np.sqrt(0.5) / 511),
    )


def _uniform(step: float) -> Axis:
    return Axis(lambda v: v / step, lambda c: c * step)


def _opacity_code(logits):
    return 255 * (1 + module_of(logits).tanh(logits / 2)) / 2


def _opacity_of(codes):
    xp = module_of(codes)
    opacities = xp.clip(codes / 255, _QUARTER, 1 - _QUARTER)
    return xp.log(opacities) - xp.log1p(-opacities)


_OPACITY = Axis(_opacity_code, _opacity_of, 0, 255)


_LATTICES = {".sog": _of_sog, ".spz": _of_spz}


def module_of(values: Any) -> Any:
    """Return `jax.numpy` for JAX arrays, else NumPy."""
    return jnp if isinstance(values, jax.Array) else np


def snap(axis: Axis, values, steps):
    """Return values whose codes are multiples of ``steps``."""
    xp = module_of(values)
    codes = xp.clip(axis.forward(values), axis.low, axis.high)
    return axis.inverse(xp.clip(xp.rint(codes / steps) * steps, axis.low, axis.high))


def snap_quats(axis: Axis, quats, steps):
    """Return unit quaternions [N, 4] whose three smaller components are snapped."""
    xp = module_of(quats)
    rounded = snap(axis, quats, steps)
    largest = xp.abs(quats).argmax(1)[:, None] == xp.arange(4)
    rest = 1 - xp.sum(xp.where(largest, 0, xp.square(rounded)), 1, keepdims=True)
    most = xp.sqrt(xp.maximum(0, rest))
    return xp.where(largest, xp.where(quats < 0, -most, most), rounded)


class Rounded(NamedTuple):
    """Result of `round_to`.

    Attributes:
      values: multiples of the steps, or those of a table if the file can hold too few.
      steps: of the codes, powers of two.
      error: squared error that they add, Σ curvature · change².
    """

    values: np.ndarray
    steps: np.ndarray
    error: float


def round_to(
    axis: Axis,
    values: np.ndarray,
    curvature: np.ndarray,
    allowed: float,
    coarsest: np.ndarray | float = np.inf,
) -> Rounded:
    """Round each value as coarsely as its error allows.

    Args:
      axis: the codes.
      values: [...] numbers.
      curvature: [...] error per squared change of each.
      allowed: mean error of a number; rounding to steps Δ adds curvature · Δ² / 12.
      coarsest: largest step Δ, in the units of the values.
    """
    values = np.asarray(values, np.float64)
    codes = np.clip(axis.forward(values), axis.low, axis.high)
    left_out = _bits_left_out(axis, codes, curvature, allowed, coarsest)
    coarser = 0
    while True:
        steps = np.exp2(np.maximum(left_out, coarser))
        rounded = snap(axis, values, steps)
        if not axis.most or len(np.unique(rounded)) <= axis.most:
            break
        coarser += 1
    error = float(np.sum(curvature * np.square(rounded - values)))
    if coarser:  # not as fine as allowed: a table of other values may err less
        table, indices = codebook(values, axis.most, weights=curvature.ravel())
        other = table[indices].reshape(values.shape)
        other_error = float(np.sum(curvature * np.square(other - values)))
        if other_error < error:
            return Rounded(other, steps, other_error)
    return Rounded(rounded, steps, error)


def _bits_left_out(
    axis: Axis, codes: np.ndarray, curvature: np.ndarray, allowed: float, coarsest
) -> np.ndarray:
    """Return k of the largest step 2ᵏ whose error is about ``allowed``."""
    inner = np.clip(codes, axis.low + 0.5, axis.high - 0.5)
    step = np.abs(axis.inverse(inner + 0.5) - axis.inverse(inner - 0.5))
    error = curvature * np.square(step) / 12
    with np.errstate(divide="ignore"):
        bits = np.round(np.log2(allowed / np.maximum(error, 1e-300)) / 2)
    most = np.floor(np.log2(coarsest / np.maximum(step, 1e-300)))
    return np.clip(np.minimum(bits, most), 0, axis.most_bits)
