"""Gaussians as viser draws them.

Axis legend: N slots, M Gaussians that are shown.

viser stores covariances in half precision and one colour of 8 bits for all directions
(SH degree 0), and draws nothing below an opacity of `MIN_DRAWN_OPACITY`. This is all
NumPy: nothing is compiled for a new M, and nothing waits for a busy device.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from gsjax.compression.parts import part_ends
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians
from gsjax.math.sh import dc_to_rgb

MIN_DRAWN_OPACITY = 0.01
MANY = 100_000  # Gaussians: from here on a part is shown first
# Half precision has 11 bits from 6e-5 to 65504, which are scales of 0.008 to 255.
_LARGEST, _TYPICAL = 250.0, 0.1


class Cut(NamedTuple):
    """Limits, both included: opacity in [0, 1), and longest axis in world units."""

    min_opacity: float = 0.0
    max_scale: float = float("inf")


class Splats(NamedTuple):
    """Arguments of `viser.SceneApi.add_gaussian_splats`.

    Lengths are in units of ``scale``, so that covariances fit half precision.

    Attributes:
      centers: [M, 3] float32.
      covariances: [M, 3, 3] float32.
      rgbs: [M, 3] float32 in [0, 1].
      opacities: [M, 1] float32.
      scale: world units.
    """

    centers: np.ndarray
    covariances: np.ndarray
    rgbs: np.ndarray
    opacities: np.ndarray
    scale: float


def opacities_of(gaussians: Gaussians) -> np.ndarray:
    """Return opacities [N] float64."""
    logits = np.asarray(gaussians.params.logit_opacities, np.float64)
    with np.errstate(over="ignore"):
        return 1 / (1 + np.exp(-logits))


def longest_axes(gaussians: Gaussians) -> np.ndarray:
    """Return the largest of the three scales [N] float64, in world units."""
    logs = np.asarray(gaussians.params.log_scales, np.float64)
    with np.errstate(over="ignore"):
        return np.exp(logs.max(axis=1))


def within(gaussians: Gaussians, cut: Cut) -> np.ndarray:
    """Return a mask [N] of Gaussians that are active, finite, and within the cut."""
    p = gaussians.params
    leaves = [p.means, p.quats, p.log_scales, np.asarray(p.sh)[:, 0]]
    finite = [np.isfinite(np.asarray(leaf)).all(axis=1) for leaf in leaves]
    shown = np.logical_and.reduce([np.asarray(gaussians.active), *finite])
    shown &= opacities_of(gaussians) >= cut.min_opacity  # False for NaN
    return shown & (longest_axes(gaussians) <= cut.max_scale)


def by_importance(
    gaussians: Gaussians, shown: np.ndarray, ordered: bool = False
) -> np.ndarray:
    """Return the indices [M] of those ``shown`` [N], the most important first.

    Args:
      gaussians, shown: the scene, and which of its slots to list.
      ordered: the scene lists them by importance. Otherwise importance is opacity times
        the area of the two longest axes, a heuristic that ignores cameras and
        occlusion.
    """
    chosen = np.flatnonzero(shown)
    if ordered:
        return chosen
    logs = np.asarray(gaussians.params.log_scales, np.float64)[chosen]
    area = logs.sum(axis=1) - logs.min(axis=1)
    with np.errstate(divide="ignore"):
        weight = np.log(opacities_of(gaussians)[chosen]) + area
    return chosen[np.argsort(-weight, kind="stable")]


def most_important(
    gaussians: Gaussians, shown: np.ndarray, count: int | None, ordered: bool = False
) -> np.ndarray:
    """Return a mask [N] of the ``count`` (None: all) most important of those ``shown``.

    Importance is that of `by_importance`.
    """
    if count is None or shown.sum() <= count:
        return shown
    kept = np.zeros_like(shown)
    kept[by_importance(gaussians, shown, ordered)[:count]] = True
    return kept


def importance_parts(
    gaussians: Gaussians, shown: np.ndarray, parts: int, ordered: bool = False
) -> list[np.ndarray]:
    """Return masks [N] that divide those ``shown`` [N] in parts of falling importance.

    Their sizes are those of `part_ends`. Empty parts are left out.

    Raises:
      InputError: if ``parts`` is below 1.
    """
    if parts < 1:
        raise InputError(f"parts: expected at least 1, got {parts}; pass 1 for a whole")
    if parts == 1:
        return [shown]
    order = by_importance(gaussians, shown, ordered)
    masks = []
    for some in np.split(order, part_ends(len(order), parts)[:-1]):
        mask = np.zeros_like(shown)
        mask[some] = True
        masks.append(mask)
    return [mask for mask in masks if mask.any()] or [shown]


def pack(gaussians: Gaussians, shown: np.ndarray) -> Splats:
    """Convert the Gaussians that ``shown`` [N] marks and viser draws."""
    opacities = opacities_of(gaussians)
    shown = shown & (opacities >= MIN_DRAWN_OPACITY)
    params = gaussians.params
    logs = np.asarray(params.log_scales, np.float64)[shown]
    scale = _unit(logs.max(axis=1))
    half = np.minimum(np.exp(logs - np.log(scale)), _LARGEST).astype(np.float32)
    rotations = _rotations(np.asarray(params.quats, np.float64)[shown])
    axes = rotations * half[:, None, :]
    return Splats(
        centers=(np.asarray(params.means)[shown] / scale).astype(np.float32),
        covariances=axes @ axes.swapaxes(1, 2),
        rgbs=np.clip(dc_to_rgb(np.asarray(params.sh)[shown, 0]), 0, 1),  # pyright: ignore
        opacities=opacities[shown, None].astype(np.float32),
        scale=scale,
    )


def padded(packed: Splats, size: int) -> Splats:
    """Return ``size`` splats, the last of which are invisible."""
    more = size - len(packed.centers)

    def longer(array: np.ndarray) -> np.ndarray:
        return np.pad(array, [(0, more)] + [(0, 0)] * (array.ndim - 1))

    return Splats(
        centers=longer(packed.centers),
        covariances=longer(packed.covariances),
        rgbs=longer(packed.rgbs),
        opacities=longer(packed.opacities),
        scale=packed.scale,
    )


def _unit(longest: np.ndarray) -> float:
    """Return the world units in which half precision holds these log scales [M]."""
    if not len(longest):
        return 1.0
    # The largest fits, unless the median would then be too small.
    fits, typical = longest.max() - np.log(_LARGEST), np.median(longest)
    log_unit = min(fits, typical - np.log(_TYPICAL))
    return float(np.exp(np.clip(log_unit, -60, 60)))


def _rotations(quats: np.ndarray) -> np.ndarray:
    """Return matrices [M, 3, 3] float32; zero quaternions become the identity."""
    if not len(quats):  # scipy 1.14 rejects an empty array
        return np.zeros((0, 3, 3), np.float32)
    some = np.any(quats != 0, axis=1, keepdims=True)
    xyzw = np.roll(np.where(some, quats, (1.0, 0, 0, 0)), -1, axis=1)
    return Rotation.from_quat(xyzw).as_matrix().astype(np.float32)
