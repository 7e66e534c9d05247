"""A dense float64 renderer in NumPy, the oracle of the stress cases of lenses.

It shares no code with the renderer. Jacobians are central differences of the whole way
from the world to the image, times of exposure are found by fixed-point iterations, the
unscented transform has its usual weights, and splats are blended at every pixel without
bounds.

Axis legend: N Gaussians, P points.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from gsjax.stress import lens_formulas

_STEP = 1e-6
_C0 = 0.28209479177387814  # of the spherical harmonics
# (start, along u, along v) of the time of exposure, from 0 to 1.
_TIMES = {"top_to_bottom": (0, 0, 1), "right_to_left": (1, -1, 0)}


class Optics(NamedTuple):
    """A camera at the origin.

    Attributes:
      project, limit, period: see `gsjax.stress.lens_formulas.functions`.
      perspective: whether splats are ordered by z, not by distance.
      size: width and height in px.
      shutter: name of the shutter.
      twist: [6] of a rolling shutter.
    """

    project: Any
    limit: Any
    period: float | None
    perspective: bool
    size: tuple[int, int]
    shutter: str = "global"
    twist: Any = None

    def expose(self, points):
        """Return points [P, 3] in camera coordinates at the time of their exposure."""
        if self.shutter == "global":
            return points
        start, along_u, along_v = _TIMES[self.shutter]

        def seen(time):
            turned = Rotation.from_rotvec(time[:, None] * self.twist[:3]).apply(points)
            return turned + time[:, None] * self.twist[3:]

        found = np.full(len(points), np.nan)
        for first in (0.5, 0.0, 1.0):  # the lens may not image a point at one of them
            time = np.full(len(points), first)
            for _ in range(60):
                u, v = self.project(seen(time)).T
                time = start + along_u * u / self.size[0] + along_v * v / self.size[1]
                time = np.clip(time, -0.5, 1.5)
            found = np.where(np.isnan(found), time, found)
        return seen(found)

    def image(self, points):
        """Return pixels [P, 2] of points [P, 3]; NaN where there is no image."""
        return self.project(self.expose(points))

    def offset(self, pixels, centres):
        """Return pixels − centres, the shorter way around the image."""
        offset = pixels - centres
        if self.period:
            offset[..., 0] -= self.period * np.round(offset[..., 0] / self.period)
        return offset

    def jacobian(self, points):
        """Return [P, 2, 3], by world points; of the lens alone at their limits."""
        at = self.limit(points) if self.shutter == "global" else points
        columns = []
        for axis in np.eye(3):
            step = _STEP * np.linalg.norm(at, axis=-1, keepdims=True)
            change = self.offset(
                self.image(at + step * axis), self.image(at - step * axis)
            )
            columns.append(change / (2 * step))
        return np.stack(columns, -1)


def optics_of(camera, lens: str) -> Optics:
    """Return the optics of a camera at the origin; ``lens`` is the name of its lens."""
    K, size = np.asarray(camera.K, np.float64), (camera.width, camera.height)
    c, twist = camera.coefficients, camera.twist
    c = None if c is None else np.asarray(c, np.float64)
    planes = lens_formulas.PLANES
    return Optics(
        *lens_formulas.functions(lens, K, c, size),
        perspective=lens in planes and not planes[lens].wide,
        size=size,
        shutter=camera.shutter.name,
        twist=None if twist is None else np.asarray(twist, np.float64),
    )


def within_limits(fields, optics: Optics) -> dict[str, np.ndarray]:
    """Return fields in which splats beyond the limit of the lens are transparent.

    Their Jacobian is not that of their image.
    """
    points = optics.expose(np.asarray(fields["means"], np.float64))
    moved = np.linalg.norm(optics.limit(points) - points, axis=-1)
    good = moved <= 1e-9 * np.linalg.norm(points, axis=-1)
    logits = np.where(good, fields["logit_opacities"], -30)
    return {**fields, "logit_opacities": logits.astype(np.float32)}


def _unscented(optics: Optics, means, axes, weights):
    """Return means [N, 2] and covariances [N, 2, 2]; NaN where a point has no image.

    Args:
      optics: the camera.
      means: [N, 3].
      axes: [N, 3, 3], columns of length σ.
      weights: (α, β, κ).
    """
    alpha, beta, kappa = weights
    spread = alpha**2 * (3 + kappa)
    step = np.sqrt(spread) * np.moveaxis(axes, -1, 0)
    points = np.stack([means, *(means + step), *(means - step)])
    pixels = optics.image(points.reshape(-1, 3)).reshape(7, -1, 2)
    offsets = optics.offset(pixels, pixels[0])
    w = np.full(7, 0.5 / spread)
    w[0] = (spread - 3) / spread
    shift = np.einsum("p,pni->ni", w, offsets)
    w[0] += 1 - alpha**2 + beta
    about = offsets - shift
    return pixels[0] + shift, np.einsum("p,pni,pnj->nij", w, about, about)


def picture(fields, optics: Optics, unscented=None, dilation: float = 0.3):
    """Return the picture [H, W, 3] over black.

    Args:
      fields: of `gsjax.stress.scenes.gaussian_fields`, degree 0.
      optics: the camera.
      unscented: (α, β, κ) of the unscented transform, or None for EWA.
      dilation: px² added to the variances.
    """
    fields = {name: np.asarray(a, np.float64) for name, a in fields.items()}
    seen, centres = optics.expose(fields["means"]), optics.image(fields["means"])
    depth = seen[:, 2] if optics.perspective else np.linalg.norm(seen, axis=-1)
    good = np.isfinite(centres).all(-1) & (depth > 0.01)
    order = np.argsort(np.where(good, depth, np.inf), kind="stable")[: good.sum()]
    means, centres = fields["means"][order], centres[order]
    turns = Rotation.from_quat(np.roll(fields["quats"][order], -1, 1)).as_matrix()
    axes = turns * np.exp(fields["log_scales"][order])[:, None]
    half = optics.jacobian(means) @ axes
    # Not finite for a transparent splat on the edge of a lens.
    covariance = np.nan_to_num(half @ np.swapaxes(half, 1, 2))
    if unscented is not None:
        mean, spread = _unscented(optics, means, axes, unscented)
        holds = np.isfinite(mean).all(-1)
        centres = np.where(holds[:, None], mean, centres)
        covariance = np.where(holds[:, None, None], spread, covariance)
    inverse = np.linalg.inv(covariance + dilation * np.eye(2))
    opacity = 1 / (1 + np.exp(-fields["logit_opacities"][order]))
    color = np.maximum(0.5 + _C0 * fields["sh"][order, 0], 0)
    pixels = np.stack(np.meshgrid(*(np.arange(n) + 0.5 for n in optics.size)), -1)
    image, left = np.zeros((*pixels.shape[:2], 3)), np.ones(pixels.shape[:2])
    for i in range(len(order)):
        for turn in (0,) if optics.period is None else (-1, 0, 1):
            offset = pixels - centres[i]
            offset[..., 0] -= turn * (optics.period or 0)
            power = np.einsum("hwi,ij,hwj->hw", offset, inverse[i], offset)
            alpha = opacity[i] * np.exp(-0.5 * power)
            image += (left * alpha)[..., None] * color[i]
            left *= 1 - alpha
    return image
