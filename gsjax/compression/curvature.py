"""Errors of pictures by the square of a small change of a number of a Gaussian.

The diagonal of JᵀJ. For opacities it follows from the error of a removal. For the
others, that error and the shape of a Gaussian give an estimate: with standardised
offsets y from the centre and weights like exp(−y²), the mean of y² is 1/2, of y⁴ 3/4,
and of y1² y2² 1/4. For one isolated Gaussian seen from all sides it is within a factor
of 2.

Axis legend: N Gaussians.
"""

from collections.abc import Mapping

import numpy as np
from scipy.special import expit

_SEEN = 2 / 3  # mean squared share of an axis that lies in the picture


def shape_curvature(
    rows: Mapping[str, np.ndarray], removal: np.ndarray, blur: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the estimate for each number of a Gaussian.

    Args:
      rows: [N, …] parameters, with unit quaternions.
      removal: [N] error if a Gaussian is removed.
      blur: [N] variance, in world units, that the filter of the image adds.
    """
    squares = np.exp(2 * np.asarray(rows["log_scales"], np.float64))
    wide = squares + blur[:, None]
    w, x, y, z = np.asarray(rows["quats"], np.float64).T
    axes = _axes(w, x, y, z)
    inverse = np.einsum("nij,nj->ni", np.square(axes), 1 / wide)
    turns = np.empty_like(wide)
    for axis in range(3):
        j, k = (axis + 1) % 3, (axis + 2) % 3
        shear = np.square(squares[:, j] - squares[:, k])
        turns[:, axis] = shear / (wide[:, j] * wide[:, k]) / 4
    # A change of the quaternion turns by twice its product with the conjugate.
    products = np.stack([[-x, w, z, -y], [-y, -z, w, x], [-z, y, -x, w]])
    of_quats = 4 * np.einsum("lcn,nl->nc", np.square(products), turns)
    opacity = expit(np.asarray(rows["logit_opacities"], np.float64))
    seen = _SEEN * removal[:, None]
    return {
        "means": seen * inverse / 2,
        "quats": seen * of_quats,
        "log_scales": seen * np.square(squares / wide) * 3 / 4,
        "logit_opacities": removal * np.square(1 - opacity),
    }


def _axes(w, x, y, z) -> np.ndarray:
    """Return rotation matrices [N, 3, 3], whose columns are the axes."""
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)
