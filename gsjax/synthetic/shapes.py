"""Solids of the demonstration's ray caster: where rays hit, and how far they are.

Axis legend: R rays or points. Arrays are [3, R], float32 or float64 (results are of
the same type), in coordinates of the shape: its centre is the origin. A shape is a
NamedTuple of functions, made by `sphere`, `box`, `torus` or `disc`; a `Solid` puts
one into the world, with its paint.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

# A ray is marched this often (2 of 1000 that hit would want more), then has missed.
_TORUS_STEPS = 40
_TORUS_NEAR = 2e-6  # ten times the rounding of float32


class Shape(NamedTuple):
    """The geometry of a solid.

    Attributes:
      reach: radius of a ball about the origin that holds all of it.
      convex: whether it cannot throw a shadow on itself.
      hit: (origin [3], directions [3, R]) → [R], the smallest t > 0 at which
        origin + t · direction is on the surface; inf where there is none.
      distance: points [3, R] → [R] signed distance, negative inside.
      normal: points [3, R] on the surface → [3, R], unit, outward.
    """

    reach: float
    convex: bool
    hit: Callable[[np.ndarray, np.ndarray], np.ndarray]
    distance: Callable[[np.ndarray], np.ndarray]
    normal: Callable[[np.ndarray], np.ndarray]


class Solid(NamedTuple):
    """A shape in the world.

    Attributes:
      shape: the geometry.
      centre: [3] in the world.
      axes: [3, 3], the columns are the axes of the shape in the world.
      paint: points [3, R] of the shape → albedo [3, R] in [0, 1].
    """

    shape: Shape
    centre: np.ndarray
    axes: np.ndarray
    paint: Callable[[np.ndarray], np.ndarray]

    def local(self, points: np.ndarray) -> np.ndarray:
        """Points [3, R] of the world in coordinates of the shape."""
        centre, axes = (a.astype(points.dtype) for a in (self.centre, self.axes))
        return axes.T @ (points - centre[:, None])


def sphere(radius: float) -> Shape:
    """A ball about the origin."""
    return Shape(
        reach=radius,
        convex=True,
        hit=lambda origin, directions: ball_span(origin, directions, radius)[0],
        distance=lambda points: np.sqrt(dot(points, points)) - radius,
        normal=lambda points: points / np.sqrt(dot(points, points)),
    )


def box(half: tuple[float, float, float]) -> Shape:
    """A box from −half to half (the method of slabs)."""

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
    """A ring about the z axis; rays are marched by the distance to it."""

    def distance(points):
        x, y, z = points
        return np.hypot(np.hypot(x, y) - major, z) - minor

    def hit(origin, directions):
        found = np.full(directions.shape[1], np.inf, directions.dtype)
        enter, leave = ball_span(origin, directions, major + minor)
        rays = np.flatnonzero(np.isfinite(leave))
        along, leave = directions[:, rays], leave[rays]
        speed = np.sqrt(dot(along, along))
        # From inside the ball, start at the origin of the ray.
        t = np.where(enter[rays] < leave, enter[rays], 0.0)
        for _ in range(_TORUS_STEPS):
            x, y, z = origin[:, None] + t * along
            ring = np.hypot(x, y)
            gap = np.hypot(ring - major, z) - minor
            # Near by, Newton: along a ray the distance to a bulge is convex, so that
            # it stays before the root; to a hollow it may pass it, and comes back.
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
    """A disc in the plane z = 0 that faces +z; it has no thickness."""

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
        up = np.asarray([[0.0], [0.0], [1.0]], points.dtype)
        return np.broadcast_to(up, points.shape)

    return Shape(radius, True, hit, distance, normal)


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[R] of [3, R] twice; three products are faster than a sum over axis 0."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def ball_span(origin, directions, radius: float):
    """(first t > 0, last t) of rays through a ball about 0; inf, inf where missed.

    From inside, both are where the ray leaves.
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
