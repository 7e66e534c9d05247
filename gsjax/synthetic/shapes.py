"""Solids of the ray caster: ray intersections, signed distances and normals.

Arrays are [3, R], float32 or float64 (results have the same type), in coordinates of
the shape, whose centre is the origin.

Axis legend: R rays or points.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

_TORUS_STEPS = 40  # then a ray counts as a miss: 2 in 1000 hits need more
_TORUS_NEAR = 2e-6  # ten times the rounding error of float32


class Shape(NamedTuple):
    """The geometry of a solid.

    Attributes:
      reach: radius of a ball about the origin that contains the shape.
      convex: whether it casts no shadow on itself.
      hit: (origin [3], directions [3, R]) → [R], the smallest t > 0 at which
        origin + t · direction is on the surface; inf if there is none.
      distance: points [3, R] → [R] signed distance, negative inside.
      normal: points [3, R] on the surface → [3, R], unit, outward.
    """

    reach: float
    convex: bool
    hit: Callable[[np.ndarray, np.ndarray], np.ndarray]
    distance: Callable[[np.ndarray], np.ndarray]
    normal: Callable[[np.ndarray], np.ndarray]


class Solid(NamedTuple):
    """A shape with a pose and an albedo.

    Attributes:
      shape: the geometry.
      centre: [3] in the world.
      axes: [3, 3], whose columns are the axes of the shape in the world.
      albedo: points [3, R] of the shape → [3, R] in [0, 1].
    """

    shape: Shape
    centre: np.ndarray
    axes: np.ndarray
    albedo: Callable[[np.ndarray], np.ndarray]

    def local(self, points: np.ndarray) -> np.ndarray:
        """Transform points [3, R] from the world to the shape."""
        centre, axes = (a.astype(points.dtype) for a in (self.centre, self.axes))
        return axes.T @ (points - centre[:, None])


def sphere(radius: float) -> Shape:
    """Return a ball about the origin."""
    return Shape(
        reach=radius,
        convex=True,
        hit=lambda origin, directions: ball_interval(origin, directions, radius)[0],
        distance=lambda points: np.sqrt(dot(points, points)) - radius,
        normal=lambda points: points / np.sqrt(dot(points, points)),
    )


def box(half: tuple[float, float, float]) -> Shape:
    """Return a box from −half to half, intersected by the slab method."""

    def hit(origin, directions):
        sizes = np.asarray(half, directions.dtype)[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            first = (-sizes - origin[:, None]) / directions
            second = (sizes - origin[:, None]) / directions
        enter = np.fmax.reduce(np.minimum(first, second))
        leave = np.fmin.reduce(np.maximum(first, second))
        t = np.where(enter > 0, enter, leave)
        return np.where((enter <= leave) & (t > 0), t, np.inf)

    def distance(points):
        beyond = np.abs(points) - np.asarray(half, points.dtype)[:, None]
        outside = np.maximum(beyond, 0)
        return np.sqrt(dot(outside, outside)) + np.minimum(beyond.max(axis=0), 0)

    def normal(points):
        face = (np.abs(points) / np.asarray(half)[:, None]).argmax(axis=0)
        return np.sign(points) * (face == np.arange(3)[:, None])

    return Shape(float(np.linalg.norm(half)), True, hit, distance, normal)


def torus(major: float, minor: float) -> Shape:
    """Return a torus about the z axis, intersected by sphere tracing."""

    def distance(points):
        x, y, z = points
        return np.hypot(np.hypot(x, y) - major, z) - minor

    def hit(origin, directions):
        found = np.full(directions.shape[1], np.inf, directions.dtype)
        enter, leave = ball_interval(origin, directions, major + minor)
        rays = np.flatnonzero(np.isfinite(leave))
        along, leave = directions[:, rays], leave[rays]
        speed = np.sqrt(dot(along, along))
        # Inside the ball, start at the origin of the ray.
        t = np.where(enter[rays] < leave, enter[rays], 0.0)
        for _ in range(_TORUS_STEPS):
            x, y, z = origin[:, None] + t * along
            ring = np.hypot(x, y)
            gap = np.hypot(ring - major, z) - minor
            # Newton steps near the surface: they do not pass the root at a convex part,
            # where distance is convex along a ray; at a concave part they return.
            inward = 1 - major / np.maximum(ring, 1e-6)
            fall = -(inward * (x * along[0] + y * along[1]) + z * along[2])
            fall = fall / (speed * (gap + minor))
            steep = np.where((gap < 0.1 * minor) & (fall > 0), fall, 1)
            t = t + gap / (speed * np.maximum(steep, 0.05))
            done = np.abs(gap) < _TORUS_NEAR
            found[rays[done]] = t[done]
            going = ~done & (t < leave)
            rays, along, t = rays[going], along[:, going], t[going]
            speed, leave = speed[going], leave[going]
        return found

    def normal(points):
        x, y, z = points
        ring = np.hypot(x, y)
        inward = 1 - major / ring
        away = np.stack([x * inward, y * inward, z])
        return away / np.sqrt(dot(away, away))

    return Shape(major + minor, False, hit, distance, normal)


def disc(radius: float) -> Shape:
    """Return a disc without thickness in the plane z = 0, facing +z."""

    def hit(origin, directions):
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -origin[2] / directions[2]
            square = (origin[0] + t * directions[0]) ** 2
            square += (origin[1] + t * directions[1]) ** 2
        return np.where((t > 0) & (square < radius * radius), t, np.inf)

    def distance(points):
        beyond = np.maximum(np.hypot(points[0], points[1]) - radius, 0)
        return np.hypot(beyond, points[2])

    def normal(points):
        return np.broadcast_to(np.eye(3, dtype=points.dtype)[:, 2:], points.shape)

    return Shape(radius, True, hit, distance, normal)


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return dot products [R] of [3, R]; faster than a sum over axis 0."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def ball_interval(origin, directions, radius: float):
    """Return (first t > 0, last t) at which rays meet a ball about 0; inf if missed.

    For an origin inside the ball, both are where the ray leaves it.
    """
    square = dot(directions, directions)
    middle = -(origin @ directions) / square
    half = middle * middle - (origin @ origin - radius * radius) / square
    with np.errstate(invalid="ignore"):
        root = np.sqrt(half)
    leave = middle + root
    missed = np.isnan(root) | (leave <= 0)
    enter = np.where(middle - root > 0, middle - root, leave)
    return np.where(missed, np.inf, enter), np.where(missed, np.inf, leave)
