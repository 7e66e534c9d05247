"""Search for the Gaussians that do not move, so that they can be kept still.

Axis legend: N Gaussians (capacity), V cameras.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera
from gsjax.gaussians import Gaussians, activate
from gsjax.math.sh import C0
from gsjax.train.mip import VARIANCE, filter_radii
from gsjax.train.models import SceneParams

Array = jax.Array

_TIMES = 9
_CAMERAS = 16  # evenly among those given; more would hardly be finer


class Limits(NamedTuple):
    """Changes above which a Gaussian moves.

    Attributes:
      shift: in px of the photograph that samples the Gaussian most finely.
      change: of opacity and colour.
    """

    shift: float = 0.25
    change: float = 1 / 64


_LIMITS = Limits()


def refreshed(
    at: Callable[[SceneParams, Array], Gaussians],
    freeze: float,
    params: SceneParams,
    cameras: Camera,
    fraction: Array,
    limits: Limits = _LIMITS,
) -> Array:
    """Return the buffer ``moving`` [N]: 1, and from a share of the run on 0 if still.

    Args:
      at: ``(SceneParams, time) → Gaussians``, in which slots with ``moving`` of 0 are
        still.
      freeze: share of the steps after which Gaussians that do not move are kept still.
      params: N slots, with a buffer ``moving``.
      cameras: batch of V cameras.
      fraction: completed share of the run.
      limits: of what counts as still.
    """
    buffers = params.model.buffers
    everything = jnp.ones_like(buffers["moving"])

    def find() -> Array:
        free = params.model._replace(buffers={**buffers, "moving": everything})
        loose = params._replace(model=free)
        found = find_moving(lambda t: at(loose, t), params.gaussians, cameras, limits)
        return found.astype(everything.dtype)

    return jax.lax.cond(fraction >= freeze, find, lambda: everything)


def find_moving(
    at: Callable[[Array], Gaussians],
    still: Gaussians,
    cameras: Camera,
    limits: Limits = _LIMITS,
) -> Array:
    """Return [N] bool: the Gaussians that visibly change over time.

    A Gaussian changes if between the first and any other of 9 times its mean or an end
    of an axis moves, or its opacity or colour changes, by more than the limits. Its
    pixel is that of the photograph that samples it most finely, of some 16.

    Args:
      at: time [] → Gaussians, N slots.
      still: N slots, whose places tell which cameras see them.
      cameras: batch of V cameras.
      limits: of what counts as still.
    """
    step = -(-cameras.viewmat.shape[0] // _CAMERAS)
    some = jax.tree.map(lambda a: a[::step], cameras)
    radii = filter_radii(still.params.means, still.active, some)
    pixel = radii / math.sqrt(VARIANCE)
    first = at(jnp.zeros(()))

    def differs(time: Array) -> Array:
        now = at(time)
        a, b = activate(first.params), activate(now.params)
        shift = jnp.linalg.norm(now.params.means - first.params.means, axis=1)
        size = jnp.max(a["scales"], 1)
        wider = jnp.max(jnp.abs(a["scales"] - b["scales"]), 1)
        turn = jnp.linalg.norm(_unit(a["quats"]) - _unit(b["quats"]), axis=1)
        moved = shift + wider + 2 * turn * size
        shade = C0 * jnp.abs(now.params.sh[:, 0] - first.params.sh[:, 0])
        change = jnp.abs(a["opacities"] - b["opacities"]) + jnp.max(shade, 1)
        return (moved > limits.shift * pixel) | (change > limits.change)

    times = jnp.asarray(np.linspace(0, 1, _TIMES)[1:], still.params.means.dtype)
    return jnp.any(jax.lax.map(differs, times), 0)


def _unit(quats: Array) -> Array:
    return quats / jnp.maximum(jnp.linalg.norm(quats, axis=1, keepdims=True), 1e-12)
