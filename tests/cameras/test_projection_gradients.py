"""Derivatives of centres and covariances by every input, for every lens.

Set GSJAX_EVERY_LENS=1 for all lenses, which takes four minutes on one core.
"""

import os
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.cameras.shutter import expose
from gsjax.raster.primitives.ewa import covariance_factor
from gsjax.stress import lenses

SPECS = {
    name: spec
    for name, spec in lenses.SPECS.items()
    if spec.config is lenses.OPEN and name not in ("opencv 4", "opencv 5", "opencv 8")
}
ALWAYS = ("opencv 12", "equirectangular", "lidar", "rolling")
# Entries that make intrinsics and a pose.
MASKS = {
    "K": np.array([[1.0, 0, 1], [0, 1, 1], [0, 0, 0]]),
    "viewmat": np.array([[1.0], [1], [1], [0]]),
}
DIRECTIONS, STEP = 32, 1e-5
POINTS = np.array(
    [[0.31, -0.23, 1.9], [-0.42, 0.11, 2.3], [0.13, 0.37, 1.4], [-0.2, -0.3, 2.9]]
)


def weighted(camera, inputs):
    """Return a sum of centres and covariances with general weights."""
    names = ("K", "viewmat", "coefficients", "twist")
    camera = camera.replace(**{name: inputs.get(name) for name in names})
    exposure = expose(camera, tuple(inputs["means"].T))
    quats, scales = (tuple(inputs[name].T) for name in ("quats", "scales"))
    rows = jnp.array(covariance_factor(camera, exposure, quats, scales))
    cov = jnp.einsum("irn,jrn->ijn", rows, rows)
    centres = jnp.stack(camera.project(exposure.point))
    weights = np.cos(np.arange(centres.size)).reshape(centres.shape)
    more = np.cos(np.arange(1, 1 + cov.size)).reshape(cov.shape)
    return jnp.sum(weights * centres) + jnp.sum(more * cov)


@partial(jax.jit, compiler_options=lenses.QUICK)
def derivatives(camera, inputs, directions):
    """Return value, gradient, jvp and Hessian product at steps along directions."""
    value = jax.value_and_grad(partial(weighted, camera))

    def along(direction):
        def at(step):
            moved = jax.tree.map(lambda a, d: a + step * d, inputs, direction)
            return jax.jvp(value, (moved,), (direction,))

        return jax.lax.map(at, STEP * jnp.array([-2.0, -1, 0, 1, 2]))

    return jax.lax.map(along, directions)


def dot(a, b):
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return sum(float(np.vdot(x, y)) for x, y in pairs)


@pytest.mark.parametrize("name", SPECS)
def test_projections_have_the_derivatives_of_differences(name, report):
    if name not in ALWAYS and not os.environ.get("GSJAX_EVERY_LENS"):
        pytest.skip("GSJAX_EVERY_LENS is not set")
    camera = lenses.camera_of(SPECS[name])
    rng = np.random.default_rng(3)
    inputs = {
        "K": camera.K,
        "viewmat": camera.viewmat,
        "coefficients": camera.coefficients,
        "twist": camera.twist,
        "means": POINTS,
        "quats": rng.normal(size=(4, 4)) + (2, 0, 0, 0),
        "scales": rng.uniform(0.05, 0.2, (4, 3)),
    }
    inputs = {k: np.float64(v) for k, v in inputs.items() if v is not None}
    camera = jax.tree.map(np.float64, camera)
    directions = {k: np.zeros((DIRECTIONS, *v.shape)) for k, v in inputs.items()}
    # A lidar's or polynomial's coefficients differ in size.
    sizes = {"coefficients": 0.05, "twist": 0.1}
    for number in range(DIRECTIONS):
        which = list(inputs)[(number - 1) % len(inputs)]
        for some in inputs if number == 0 else [which]:
            drawn = rng.normal(size=inputs[some].shape) * MASKS.get(some, 1)
            directions[some][number] = drawn * sizes.get(some, 1)
    found = derivatives(camera, inputs, directions)
    (values, gradients), (tangents, products) = jax.tree.map(np.asarray, found)
    gradient = {k: v[0, 2] for k, v in gradients.items()}
    for number in range(DIRECTIONS):
        direction = {k: v[number] for k, v in directions.items()}
        low, near, _, far, high = values[number]
        wanted = (8 * (far - near) - (high - low)) / (12 * STEP)
        moved = [k for k in inputs if direction[k].any()]
        size = sum(np.linalg.norm(gradient[k] * (direction[k] != 0)) for k in moved)
        size *= dot(direction, direction) ** 0.5
        error = abs(dot(gradient, direction) - wanted) / max(size, 1e-9)
        report(f"{name}, {' '.join(moved)}", error, 1e-5)
        assert error <= 1e-5, moved
        tangent = tangents[number, 2]
        assert abs(tangent - dot(gradient, direction)) <= 1e-10 * max(size, 1e-9)
    for k in inputs:  # in a direction of everything
        low, near, _, far, high = gradients[k][0]
        wanted = (8 * (far - near) - (high - low)) / (12 * STEP)
        error = np.linalg.norm(products[k][0, 2] - wanted)
        assert error <= 1e-5 * np.linalg.norm(wanted) + 1e-7, k
