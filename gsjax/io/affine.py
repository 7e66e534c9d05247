"""Gaussians under an affine map of space, as the nodes of a scene graph apply it.

Axis legend: N Gaussians, K spherical-harmonic bases.
"""

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from gsjax.math.sh_rotation import rotate_sh

# A map whose axes differ by less than this part of their length is a similarity.
_UNIFORM = 1e-6


def transform_gaussians(
    fields: Mapping[str, np.ndarray], matrix: np.ndarray
) -> dict[str, np.ndarray]:
    """Return Gaussians that are moved by an affine map.

    A rotation with a uniform scale changes quaternions and scales alone. Any other map
    A turns the covariance Σ into A Σ Aᵀ, whose axes and scales come from the singular
    values of A R S. Harmonics follow the orthogonal factor of A's polar decomposition,
    which mirrors them if A does: exact for similarities, and the nearest rotation
    otherwise.

    Args:
      fields: means [N, 3], quats [N, 4] wxyz of any norm, log_scales [N, 3],
        logit_opacities [N] and sh [N, K, 3], finite.
      matrix: [4, 4] of full rank, with a last row of 0, 0, 0, 1.

    Returns:
      The same fields, float64 except for ``sh`` and opacities, which keep their type.
    """
    linear, offset = matrix[:3, :3], matrix[:3, 3]
    orthogonal, scale = _similarity(linear)
    means, quats = (fields[n].astype(np.float64) for n in ("means", "quats"))
    log_scales = fields["log_scales"].astype(np.float64)
    if scale is not None:
        turn = Rotation.from_matrix(orthogonal * np.linalg.det(orthogonal))
        quats = _multiply(np.roll(turn.as_quat(), 1), quats)
        log_scales = log_scales + np.log(scale)
    else:
        quats, log_scales = _map_shapes(linear, quats, log_scales)
    return {
        **fields,
        "means": means @ linear.T + offset,
        "quats": quats,
        "log_scales": log_scales,
        "sh": rotate_sh(fields["sh"], orthogonal),
    }


def _similarity(linear: np.ndarray) -> tuple[np.ndarray, float | None]:
    """Return the orthogonal factor [3, 3] of a map, and its scale if it is uniform."""
    left, axes, right = np.linalg.svd(linear)
    scale = float(axes.mean())
    if axes[0] - axes[2] > _UNIFORM * scale:
        return left @ right, None
    if np.array_equal(linear @ linear.T, np.eye(3)):  # keeps signs and swaps exact
        return linear, 1.0
    return left @ right, scale


def _map_shapes(
    linear: np.ndarray, quats: np.ndarray, log_scales: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return quaternions [N, 4] and log scales [N, 3] of mapped Gaussians."""
    drawn = np.any(quats != 0, axis=1)  # a zero quaternion has no axes: left as it is
    axes = Rotation.from_quat(np.roll(quats[drawn], -1, axis=1)).as_matrix()
    # Relative to the largest scale, which may be far from 1.
    largest = log_scales[drawn].max(axis=1, keepdims=True, initial=-np.inf)
    scales = np.exp(log_scales[drawn] - largest)
    left, sizes, _ = np.linalg.svd(linear @ (axes * scales[:, None]))
    left[:, :, 2] *= np.linalg.det(left)[:, None]
    quats, log_scales = quats.copy(), log_scales.copy()
    quats[drawn] = np.roll(Rotation.from_matrix(left).as_quat(), 1, axis=1)
    tiny = np.finfo(np.float32).eps ** 2  # of the largest; smaller ones are rounding
    log_scales[drawn] = np.log(np.maximum(sizes, tiny * sizes[:, :1])) + largest
    return quats, log_scales


def _multiply(first: np.ndarray, quats: np.ndarray) -> np.ndarray:
    """Return the Hamilton products [N, 4] of a quaternion [4] and others, wxyz."""
    w, *xyz = first
    real = w * quats[:, 0] - quats[:, 1:] @ xyz
    imaginary = w * quats[:, 1:] + quats[:, :1] * xyz + np.cross(xyz, quats[:, 1:])
    return np.column_stack([real, imaginary])
