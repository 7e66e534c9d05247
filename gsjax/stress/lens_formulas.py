"""The published formulas of the lenses in NumPy, for the oracle of stress cases.

No code is shared with the lenses of the renderer. The fold is searched on a grid.

Axis legend: P points.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

_SAMPLES = 20001


class Plane(NamedTuple):
    """A lens that distorts a plane of directions.

    Attributes:
      wide: whether the plane is θ (x, y) / ρ instead of (x, y) / z.
      plane: (c, a, b) → distorted (a, b).
      radial: c → coefficients without those that depend on the direction.
      end: c → the largest radius of the model.
    """

    wide: bool
    plane: Callable
    radial: Callable = np.asarray
    end: Callable = lambda _: np.inf


def _without(*places):
    def radial(c):
        return np.where(np.isin(np.arange(len(c)), places), 0, c)

    return radial


def _opencv(c, a, b):
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = np.pad(c, (0, 12 - len(c)))
    r2 = a * a + b * b
    below = 1 + k4 * r2 + k5 * r2**2 + k6 * r2**3
    scale = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / np.where(below > 0, below, np.nan)
    return (
        a * scale + 2 * p1 * a * b + p2 * (r2 + 2 * a * a) + s1 * r2 + s2 * r2**2,
        b * scale + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b + s3 * r2 + s4 * r2**2,
    )


def _fisheye(c, a, b):
    t = a * a + b * b
    scale = 1 + c[0] * t + c[1] * t**2 + c[2] * t**3 + c[3] * t**4
    return a * scale, b * scale


def _thin_prism(c, a, b):
    k1, k2, p1, p2, k3, k4, s1, s2 = c
    t = a * a + b * b
    scale = 1 + k1 * t + k2 * t**2 + k3 * t**3 + k4 * t**4
    return (
        a * scale + 2 * p1 * a * b + p2 * (t + 2 * a * a) + s1 * t,
        b * scale + 2 * p2 * a * b + p1 * (t + 2 * b * b) + s2 * t,
    )


def _rad_tan(c, a, b):
    t = a * a + b * b
    scale = 1 + sum(c[i] * t ** (i + 1) for i in range(6))
    p0, p1, s0, s1, s2, s3 = c[6:]
    a, b = a * scale, b * scale
    t = a * a + b * b
    return (
        a + p0 * (2 * a * a + t) + 2 * p1 * a * b + s0 * t + s1 * t * t,
        b + p1 * (2 * b * b + t) + 2 * p0 * a * b + s2 * t + s3 * t * t,
    )


def _along(function):
    """Return the plane of a function of coefficients and radius."""

    def plane(c, a, b):
        r = np.maximum(np.hypot(a, b), 1e-12)
        scale = function(c, r) / r
        return a * scale, b * scale

    return plane


def _fov(c, r):
    return np.arctan(2 * r * np.tan(c[0] / 2)) / c[0]


def _division(c, r):
    with np.errstate(invalid="ignore"):
        return 2 * r / (1 + np.sqrt(1 - 4 * c[0] * r * r))


def _affine(function):
    def plane(c, a, b):
        p, q = _along(function)(c, a, b)
        return c[6] * p + c[7] * q, c[8] * p + q

    return plane


def _ftheta(c, r):
    return np.polynomial.polynomial.polyval(r, c[:6])


def _ftheta_inverse(c, r):
    pixels = np.linspace(0, 4 * c[9] / c[1], 2000)
    angles = np.polynomial.polynomial.polyval(pixels, c[:6])
    last = np.argmax(np.append(np.diff(angles) <= 0, True))
    x = np.interp(r, angles[: last + 1], pixels[: last + 1])
    rise = np.polynomial.polynomial.polyder(c[:6])
    for _ in range(4):
        off = np.polynomial.polynomial.polyval(x, c[:6]) - r
        x = x - off / np.polynomial.polynomial.polyval(x, rise)
    return x


def _last(c):
    return c[9]


def _straight(c):
    return np.concatenate([c[:6], [1, 0, 0], c[9:]])


PLANES = {
    "opencv": Plane(False, _opencv, _without(2, 3, 8, 9, 10, 11)),
    "fisheye": Plane(True, _fisheye),
    "thin_prism_fisheye": Plane(True, _thin_prism, _without(2, 3, 6, 7)),
    "rad_tan_thin_prism_fisheye": Plane(True, _rad_tan, _without(*range(6, 12))),
    "fov": Plane(False, _along(_fov)),
    "division": Plane(
        False,
        _along(_division),
        end=lambda c: 0.5 / np.sqrt(c[0]) if c[0] > 0 else np.inf,
    ),
    "ftheta": Plane(True, _affine(_ftheta), _straight, _last),
    "ftheta_inverse": Plane(True, _affine(_ftheta_inverse), _straight, _last),
}


def first_end(lens: str, c, target: float = np.inf) -> float:
    """Return the first radius of the plane that folds or is imaged at ``target``."""
    model = PLANES[lens]
    angles = np.linspace(0, 1, _SAMPLES)[:-1]
    r = np.pi * angles if model.wide else np.tan(0.5 * np.pi * angles)
    with np.errstate(all="ignore"):
        value = model.plane(model.radial(c), r, 0 * r)[0]
        stops = ~((np.diff(value) > 0) & (value[1:] < target))
    at = np.argmax(np.append(stops, True))
    end = np.pi if model.wide else np.inf
    if at < len(stops):
        low, high, known = r[at], r[at + 1], value[at + 1]
        end = low
        if known >= target > value[at]:
            end += (high - low) * (target - value[at]) / (known - value[at])
    return min(end, model.end(c))


def fold_angle(lens: str, c) -> float:
    """Return the angle from the axis at which an image ends, or a right angle."""
    if lens not in PLANES:
        return 0.5 * np.pi
    end = first_end(lens, c)
    return end if PLANES[lens].wide else np.arctan(end)


def _length(points):
    return np.linalg.norm(points, axis=-1)


def _pixels(K, a, b):
    return np.stack([K[0, 0] * a + K[0, 2], K[1, 1] * b + K[1, 2]], -1)


def _edge(K, size) -> float:
    corners = np.array([[x, y] for x in (0, size[0]) for y in (0, size[1])])
    return 1.15 * np.hypot(*((corners - K[:2, 2]) / (K[0, 0], K[1, 1])).T).max()


def _plane_lens(lens: str, K, c, size):
    """Return the functions project and limit, see `functions`."""
    model, fold = PLANES[lens], first_end(lens, c)
    largest = first_end(lens, c, _edge(K, size))

    def project(points):
        x, y, z = points.T
        rho = np.maximum(np.hypot(x, y), 1e-300)
        r = np.arctan2(rho, z) if model.wide else rho / np.where(z > 0, z, np.nan)
        a, b, step = x / rho * r, y / rho * r, 1e-6
        image = model.plane(c, a, b)
        by_a = np.subtract(model.plane(c, a + step, b), model.plane(c, a - step, b))
        by_b = np.subtract(model.plane(c, a, b + step), model.plane(c, a, b - step))
        good = (r < fold) & (by_a[0] * by_b[1] > by_a[1] * by_b[0])
        return np.where(good[:, None], _pixels(K, *image), np.nan)

    def limit(points):
        rho, z, far = np.hypot(*points.T[:2]), points[:, 2], _length(points)
        if not model.wide:
            scale = np.minimum(1, largest * z / np.maximum(rho, 1e-300))
            return np.column_stack([points[:, :2] * scale[:, None], z])
        angle = np.minimum(np.arctan2(rho, z), largest)
        flat = far * np.sin(angle) / np.maximum(rho, 1e-300)
        return np.column_stack([points[:, :2] * flat[:, None], far * np.cos(angle)])

    return project, limit


def _eucm_lens(K, c, size):
    alpha, beta = c
    bend = (2 * alpha - 1) * beta
    most = min(_edge(K, size), 0.999 / np.sqrt(bend) if bend > 0 else np.inf)
    square = beta * most**2
    ahead = (1 - alpha**2 * square) / (
        alpha * np.sqrt(1 - (2 * alpha - 1) * square) + 1 - alpha
    )

    def below(points):
        x, y, z = points.T
        d = np.sqrt(beta * (x * x + y * y) + z * z)
        ratio = min(alpha, 1 - alpha) / max(alpha, 1 - alpha)
        value = alpha * d + (1 - alpha) * z
        return np.where((value > 0) & (z > -ratio * d), value, np.nan)

    def project(points):
        return _pixels(K, *(points[:, :2] / below(points)[:, None]).T)

    def limit(points):
        rho, far = np.hypot(*points.T[:2]), _length(points)
        norm = far / np.hypot(most, ahead)
        out = rho > most * below(points)
        flat = np.where(out, most * norm / np.maximum(rho, 1e-300), 1)
        z = np.where(out, ahead * norm, points[:, 2])
        return np.column_stack([points[:, :2] * flat[:, None], z])

    return project, limit


def _panorama_lens(K):
    def project(points):
        x, y, z = points.T
        return _pixels(K, np.arctan2(x, z), np.arcsin(y / _length(points)))

    return project, _off_the_poles(min(1 / K[1, 1], 0.5))


def _off_the_poles(margin: float):
    """Return the limit of points to an angle from the poles."""

    def limit(points):
        far, most = _length(points), np.pi / 2 - margin
        latitude = np.arcsin(points[:, 1] / far)
        near = np.clip(latitude, -most, most)
        flat = np.cos(near) / np.cos(latitude)
        x, z = points[:, 0] * flat, points[:, 2] * flat
        return np.column_stack([x, far * np.sin(near), z])

    return limit


def _lidar_lens(K, c, size):
    rows, width = size[1], size[0]
    elevations, azimuths = c[:rows], c[rows : rows + width]

    def place(table, value):
        """Return the place in a falling table, extended linearly."""
        low = np.clip(np.searchsorted(-table, -value) - 1, 0, len(table) - 2)
        return low + (value - table[low]) / (table[low + 1] - table[low])

    def project(points):
        x, y, z = points.T
        azimuth, middle = np.arctan2(-x, z), 0.5 * (azimuths[0] + azimuths[-1])
        azimuth = azimuth + 2 * np.pi * np.round((middle - azimuth) / (2 * np.pi))
        row = place(elevations, np.arcsin(-y / _length(points)))
        return _pixels(K, place(azimuths, azimuth), row)

    step = abs(elevations[0] - elevations[-1]) / (rows - 1)
    return project, _off_the_poles(min(step, 0.5))


def functions(lens: str, K, c, size):
    """Return project, limit and the period in px, or None.

    Args:
      lens: a name of the stress cases' lenses.
      K: [3, 3].
      c: [M].
      size: width and height in px.

    Returns:
      project: camera points [P, 3] → pixels [P, 2], NaN where there is no image; limit:
      points [P, 3] → those at which the Jacobian is evaluated; and the period.
    """
    if lens == "eucm":
        return *_eucm_lens(K, c, size), None
    if lens == "equirectangular":
        return *_panorama_lens(K), 2 * np.pi * K[0, 0]
    if lens == "lidar":
        step = abs(c[size[1]] - c[size[1] + size[0] - 1]) / (size[0] - 1)
        return *_lidar_lens(K, c, size), K[0, 0] * 2 * np.pi / step
    return *_plane_lens(lens, K, c, size), None
