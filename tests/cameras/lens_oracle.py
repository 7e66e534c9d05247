"""A dense float64 renderer in NumPy whose lenses are those of OpenCV or of formulas.

Nothing of it comes from the renderer: the Jacobian is a central difference, and splats
are blended at every pixel without tiles, bounds or thresholds.
"""

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

import gsjax
from gsjax.math.sh import C0

STEP = 1e-6  # of the differences, relative to the range


class Oracle(NamedTuple):
    """An independent lens.

    Attributes:
      project: camera points [N, 3] → pixels [N, 2]; NaN where there is no image.
      depth: camera points [N, 3] → [N].
      limit: camera points [N, 3] → points at which the Jacobian is evaluated.
      period: width of one turn, px, or None.
    """

    project: Callable[[np.ndarray], np.ndarray]
    depth: Callable[[np.ndarray], np.ndarray]
    limit: Callable[[np.ndarray], np.ndarray]
    period: float | None = None


def z_depth(points):
    return points[:, 2]


def length(points):
    return np.linalg.norm(points, axis=-1)


def to_pixels(K, plane):
    return plane * (K[0, 0], K[1, 1]) + (K[0, 2], K[1, 2])


def opencv(K, c, size) -> Oracle:
    """OpenCV's perspective lens; along the radius it must not fold."""

    def plane(points, c):
        zero = np.zeros(3)
        seen, by = cv2.projectPoints(points[:, None], zero, zero, np.eye(3), c)
        # OpenCV's derivatives by the translation, of points without rotation.
        by = by[:, 3:5].reshape(-1, 2, 2)
        good = (points[:, 2] > 0) & (np.linalg.det(by) > 0)
        return np.where(good[:, None], seen[:, 0], np.nan)

    radial = np.where(
        np.isin(np.arange(len(c)), (2, 3)) | (np.arange(len(c)) > 7), 0, c
    )

    def distance(r):
        return plane(np.array([[r, 0, 1.0]]), radial)[0, 0]

    largest = brentq(lambda r: distance(r) - edge(K, size), 0, 3)

    def limit(points):
        ratio = np.hypot(points[:, 0], points[:, 1]) / points[:, 2]
        scale = np.where(ratio > largest, largest / np.maximum(ratio, 1e-9), 1)
        return points * np.stack([scale, scale, np.ones_like(scale)], -1)

    return Oracle(lambda p: to_pixels(K, plane(p, c)), z_depth, limit)


def edge(K, size):
    """Return 1.15 × the distance of the farthest corner, at unit focal length."""
    corners = np.array([[x, y] for x in (0, size[0]) for y in (0, size[1])])
    return 1.15 * np.hypot(*((corners - K[:2, 2]) / (K[0, 0], K[1, 1])).T).max()


def fisheye(K, k, size) -> Oracle:
    """Kannala–Brandt, by its formula: OpenCV's code is wrong behind the camera."""

    def distance(angle):
        return angle * (1 + np.polyval([*k[::-1], 0], angle**2))

    # The derivative's roots in θ², of which the smallest is the fold.
    roots = np.roots([9 * k[3], 7 * k[2], 5 * k[1], 3 * k[0], 1])
    roots = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
    fold = largest = min(np.pi, np.sqrt(min(roots, default=np.inf)))
    if distance(fold) > edge(K, size):
        largest = brentq(lambda a: distance(a) - edge(K, size), 0, fold)

    def project(points):
        rho = np.hypot(points[:, 0], points[:, 1])
        angle = np.arctan2(rho, points[:, 2])
        scale = distance(angle) / np.maximum(rho, 1e-300)
        seen = to_pixels(K, points[:, :2] * scale[:, None])
        return np.where(angle[:, None] < fold, seen, np.nan)

    def limit(points):
        rho, far = np.hypot(points[:, 0], points[:, 1]), length(points)
        angle = np.minimum(np.arctan2(rho, points[:, 2]), largest)
        flat = far * np.sin(angle) / np.maximum(rho, 1e-300)
        return np.column_stack([points[:, :2] * flat[:, None], far * np.cos(angle)])

    return Oracle(project, length, limit)


def equirectangular(width, height) -> Oracle:
    """Longitude and latitude."""

    def project(points):
        x, y, z = points.T
        u = width * (0.5 + np.arctan2(x, z) / (2 * np.pi))
        return np.stack([u, height * (0.5 + np.arcsin(y / length(points)) / np.pi)], -1)

    def limit(points):  # one row from the poles
        far, most = length(points), np.pi / 2 - np.pi / height
        latitude = np.arcsin(points[:, 1] / far)
        near = np.clip(latitude, -most, most)
        flat = np.cos(near) / np.cos(latitude)
        return np.column_stack(
            [points[:, 0] * flat, far * np.sin(near), points[:, 2] * flat]
        )

    return Oracle(project, length, limit, float(width))


def render(gaussians: gsjax.Gaussians, camera: gsjax.Camera, oracle: Oracle, config):
    """Return rgb [H, W, 3] over black; SH degree 0, no stop and no limit of α."""
    p = gaussians.params
    viewmat, active = np.asarray(camera.viewmat), np.asarray(gaussians.active)
    means = np.asarray(p.means)[active] @ viewmat[:3, :3].T + viewmat[:3, 3]
    seen = np.isfinite(oracle.project(means)).all(-1)
    depth = oracle.depth(means)
    seen &= (depth > float(camera.near)) & (depth < float(camera.far))
    at = oracle.limit(means[seen])
    columns = []
    for axis in np.eye(3):
        step = STEP * length(at)[:, None] * axis
        difference = oracle.project(at + step) - oracle.project(at - step)
        if oracle.period:
            difference[:, 0] -= oracle.period * np.round(
                difference[:, 0] / oracle.period
            )
        columns.append(difference / (2 * STEP * length(at)[:, None]))
    jacobian = np.stack(columns, -1) @ viewmat[:3, :3]
    quats = np.asarray(p.quats)[active][seen]
    turn = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()
    half = jacobian @ turn * np.exp(np.asarray(p.log_scales)[active][seen])[:, None]
    inverse = np.linalg.inv(
        half @ np.swapaxes(half, 1, 2) + config.dilation * np.eye(2)
    )
    opacity = 1 / (1 + np.exp(-np.asarray(p.logit_opacities)[active][seen]))
    color = np.maximum(0.5 + C0 * np.asarray(p.sh)[active][seen][:, 0], 0)
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    pixels = np.stack([columns, rows], -1).reshape(-1, 2)
    image, left = np.zeros((len(pixels), 3)), np.ones(len(pixels))
    turns = (0,) if oracle.period is None else (-1, 0, 1)
    centres = oracle.project(means[seen])
    for i in np.argsort(depth[seen], kind="stable"):
        for turn_ in turns:
            offset = pixels - centres[i]
            offset[:, 0] -= turn_ * (oracle.period or 0)
            power = np.einsum("pi,ij,pj->p", offset, inverse[i], offset)
            alpha = np.minimum(opacity[i] * np.exp(-0.5 * power), config.alpha_max)
            alpha = np.where(alpha < config.alpha_min, 0, alpha)
            image += (left * alpha)[:, None] * color[i]
            left *= 1 - alpha
    return image.reshape(camera.height, camera.width, 3)
