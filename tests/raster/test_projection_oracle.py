"""Projection against an independent float64 reference on real points.

The file holds float32 inputs and float64 outputs for 2000 points and 3 views.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import COMPAT, camera_of, cast, gaussians_at, oracle_data
from stages import conics_of, order_of, project

import gsjax
from gsjax.raster.reference import reference_colors

VALUE, DERIVATIVE = 1e-9, 1e-8
# Nothing is culled by its opacity; antialiasing fills in the compensation.
CONFIG = COMPAT.replace(alpha_min=1e-300, alpha_max=1.0, antialias=True)


@pytest.fixture(scope="module")
def data():
    return oracle_data("projection_oracle")


@jax.jit
def project_all(params, camera):
    """Return (u v, depth, conic, compensation) in the order of the file."""
    count = params.means.shape[0]
    gaussians = gsjax.Gaussians(params=params, active=jnp.ones(count, bool))
    out = project(gaussians, camera, CONFIG, jnp.arange(count), jnp.int32(count))
    means2d = jnp.stack([out.splat.u, out.splat.v], -1)
    compensation = out.splat.shape[3] / jax.nn.sigmoid(params.logit_opacities)
    return means2d, out.channels.depth, conics_of(out), compensation


def inputs(data, view):
    gaussians = gsjax.make_gaussians(
        means=data["in_means"],
        quats=data["in_quats"],
        log_scales=np.log(data["in_scales"].astype(np.float64)),
        logit_opacities=np.zeros(len(data["in_means"])),
        sh=np.zeros((len(data["in_means"]), 1, 3)),
    )
    camera = gsjax.make_camera(
        viewmat=data["in_viewmats"][view],
        K=data["in_Ks"][view],
        width=int(data["in_width"]),
        height=int(data["in_height"]),
        near=data["in_near"],
        far=data["in_far"],
    )
    return gaussians.params, camera


def relative(found, wanted):
    """Return the largest error of a row (a vector, a matrix) relative to its norm."""
    found, wanted = (np.asarray(a).reshape(len(a), -1) for a in (found, wanted))
    assert np.isfinite(found).all()
    size = np.linalg.norm(wanted, axis=-1)
    assert (size > 0).mean() > 0.99
    return np.max(np.linalg.norm(found - wanted, axis=-1) / np.maximum(size, 1e-30))


def test_projection_agrees(data, report):
    names = ("means2d", "depths", "conics", "compensations")
    for view in range(3):
        seen = (data["f64_radii"][view] > 0).all(-1)
        assert seen.sum() > 100
        for name, found in zip(names, project_all(*inputs(data, view))):
            error = relative(found[seen], data[f"f64_{name}"][view][seen])
            report(f"{name}, view {view}", error, VALUE)
            assert error <= VALUE, name


def test_vector_jacobian_product_agrees(data, report):
    params, camera = inputs(data, 0)
    seen = (data["f64_radii"][0] > 0).all(-1)
    cotangents = [
        np.where(seen.reshape(-1, *[1] * (c.ndim - 1)), c, 0)
        for c in (data[f"vjp_cot_{n}"][0] for n in ("means2d", "depths", "conics"))
    ]

    @jax.jit
    def pull(params, cotangents):
        _, vjp = jax.vjp(lambda p: project_all(p, camera)[:3], params)
        return vjp(tuple(cotangents))[0]

    grads = pull(params, cotangents)
    found = {
        "means": grads.means,
        "quats": grads.quats,
        "scales": grads.log_scales / np.exp(params.log_scales),
    }
    for name, value in found.items():
        wanted = data[f"vjp_{name}"]
        assert np.linalg.norm(wanted[seen]) > 0
        error = np.linalg.norm(value - wanted) / np.linalg.norm(wanted)
        rows = relative(value[seen], wanted[seen])
        report(f"vjp of {name}, L2", error, DERIVATIVE)
        report(f"vjp of {name}, worst row", rows, DERIVATIVE)
        assert max(error, rows) <= DERIVATIVE, name


def test_colours_of_many_gaussians():
    """In float32 and compiled: some reductions of XLA go wrong for long arrays."""
    count = 40_000
    points = np.random.default_rng(0).uniform(-1, 1, (count, 3)) + (0, 0, 4)
    scene = gaussians_at(points, np.full((count, 1), 0.01), 0.5, viewmat=np.eye(4))
    camera = camera_of(64, 48, viewmat=np.eye(4), focal=(60.0, 60.0))
    wanted = np.asarray(reference_colors(scene, camera))
    assert wanted.std() > 0.1

    @jax.jit
    def colours(scene, camera):
        config = gsjax.RasterConfig()
        order, seen = order_of(scene, camera, config)
        out = project(scene, camera, config, order, seen)
        return order, seen, out.channels.colors

    order, seen, found = colours(*cast((scene, camera), jnp.float32))
    assert seen > count // 2
    np.testing.assert_allclose(found.T[:seen], wanted[order[:seen]], atol=2e-5)
