"""Forms: functions that evaluate a splat at a pixel.

A form knows α, and the depth where the ray of a pixel meets the splat, as functions of
a few values that are linear in the place of the pixel. So the cotangents of all pixels
of a tile reduce to three moments for each such value, whatever the form: to those of
1, x and y. The rest follows by automatic differentiation, once a splat.

Ellipsoids with the depth of their mean have no `Form`: compositing has kernels of their
own for α = opacity · exp(−½ (y1² + y2²)).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax

Array = jax.Array
Numbers = tuple[Array, ...]
Once = Callable[[Array], Array]


class Plane(NamedTuple):
    """A value that is linear in the offset (dx, dy) of a pixel from the centre, px.

    Plain numbers in place of arrays are constants of the form.

    Attributes:
      at: value at the centre.
      by_x, by_y: its derivatives by dx and dy.
    """

    at: Array | float
    by_x: Array | float
    by_y: Array | float

    def value(self, dx: Array, dy: Array) -> Array:
        """Return the value at an offset."""
        terms = []
        for factor, offset in ((self.by_x, dx), (self.by_y, dy)):
            if isinstance(factor, float):
                terms += [offset] if factor == 1 else []
            else:
                terms.append(factor * offset)
        if not isinstance(self.at, float) or self.at:
            terms.append(self.at)
        return sum(terms[1:], terms[0])


class Parts(NamedTuple):
    """Numbers that a form evaluates at pixels.

    Attributes:
      planes: all that α depends on.
      depth: depth at the centre; or None.
      limits: numbers of which no derivative is taken.
    """

    planes: tuple[Plane, ...]
    depth: Array | None = None
    limits: Numbers = ()


class AtPixel(NamedTuple):
    """A splat at a pixel.

    Attributes:
      power: log(α / opacity), at most 0.
      depth: depth of the point of the splat that the pixel shows; or None.
      disparity: 1 / depth; or None.
    """

    power: Array
    depth: Array | None = None
    disparity: Array | None = None


class Form(NamedTuple):
    """Pure functions that evaluate a splat at a pixel.

    Attributes:
      parts: numbers of `Splat.shape` without the last, the opacity → `Parts`.
      evaluate: (values of the planes, depth, limits, once) → `AtPixel`. Finite, with
        finite derivatives, for all values. ``power`` does not depend on the depth.
        ``once`` is the identity; XLA computes what it marks, and the cotangent of that,
        only once.
      has_depth: whether ``evaluate`` returns depth and disparity.
      convex_parts: in place of ``parts`` to find what a splat hides: with them
        ``evaluate`` gives no higher α, and where it exceeds any limit is convex. None
        if ``parts`` do that.
    """

    parts: Callable[[Numbers], Parts]
    evaluate: Callable[[Numbers, Array | None, Numbers, Once], AtPixel]
    has_depth: bool = False
    convex_parts: Callable[[Numbers], Parts] | None = None


def values_at(parts: Parts, dx: Array, dy: Array) -> Numbers:
    """Return the values of planes at offsets (dx, dy) of pixels from the centre, px."""
    return tuple(plane.value(dx, dy) for plane in parts.planes)


def unmarked(value: Array) -> Array:
    """Return ``value``: the ``once`` of `Form.evaluate` where nothing is to be done."""
    return value


def gaussian_power(y1: Array, y2: Array) -> Array:
    """Return −½ (y1² + y2²)."""
    return -0.5 * (y1 * y1 + y2 * y2)
