"""Parts of a render, and the whole, against independent float64 references.

One file holds float32 inputs and float64 outputs for 2000 real points and 3 views. The
other has 3000 real points by a brute-force compositor with the rules of "compat": one
view of 162 × 105, and the gradients of all inputs for given cotangents.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import COMPAT, camera_of, cast, gaussians_at, oracle_data
from pictures import assert_close

import gsjax
from gsjax.math.rotations import covariance
from gsjax.math.sh import eval_sh
from gsjax.raster.primitives.ellipsoid import ELLIPSOID
from gsjax.raster.reference import reference_colors
from gsjax.raster.render_camera import visible_order
from gsjax.raster.types import Inputs

VALUE, DERIVATIVE, DERIVATIVE_OF_IMAGES = 1e-9, 1e-8, 1e-7
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
    inputs = Inputs(gaussians, camera)
    out = ELLIPSOID.project(inputs, CONFIG, jnp.arange(count), jnp.int32(count))
    means2d = jnp.stack([out.splat.u, out.splat.v], -1)
    compensation = out.splat.shape[3] / jax.nn.sigmoid(params.logit_opacities)
    seen = out.footprint
    var_x = 1 / (seen.inv_sx * seen.inv_sx)
    conics = jnp.stack([seen.var_y, -seen.slope * var_x, var_x], -1)
    return means2d, out.channels.depth, conics / seen.det[:, None], compensation


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
        inputs, config = Inputs(scene, camera), gsjax.RasterConfig()
        order, seen = visible_order(ELLIPSOID, inputs, config)
        out = ELLIPSOID.project(inputs, config, order, seen)
        return order, seen, out.channels.colors

    order, seen, found = colours(*cast((scene, camera), jnp.float32))
    assert seen > count // 2
    np.testing.assert_allclose(found.T[:seen], wanted[order[:seen]], atol=2e-5)


def test_covariances_agree(data, report):
    quats, scales = (data[f"in_{n}"].astype(np.float64) for n in ("quats", "scales"))
    error = relative(covariance(quats, scales), data["f64_covars"])
    report("covariances", error, VALUE)
    assert error <= VALUE


@pytest.mark.parametrize("degree", range(5))
def test_spherical_harmonics_agree(data, degree, report):
    wanted = data[f"sh_deg{degree}_f64"]
    coefficients = data["in_sh_coeffs"][:, : (degree + 1) ** 2]
    directions = data["in_sh_dirs"]  # of any length
    directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    error = relative(eval_sh(coefficients, directions), wanted)
    report(f"SH degree {degree}", error, VALUE)
    assert error <= VALUE


@jax.jit
def render_and_pull(params, colors, camera, background, cotangents):
    active = jnp.ones(params.means.shape[0], bool)
    config = COMPAT.replace(outputs=("rgb", "alpha"), pair_capacity=65536)

    def images(params, colors):
        scene = gsjax.Gaussians(params=params, active=active)
        out = gsjax.render(scene, camera, config, background, features=colors)
        return (out.rgb, out.alpha), out.overflowed

    outputs, vjp, overflowed = jax.vjp(images, params, colors, has_aux=True)
    return outputs, vjp(cotangents), overflowed


def test_renders_agree(report):
    """No pixel is left out: none lies within rounding of a threshold."""
    data = oracle_data("render_oracle")
    wide = {k: v.astype(np.float64) for k, v in data.items()}
    scales, opacities = wide["scales"], wide["opacities"]
    params = gsjax.make_gaussians(
        means=wide["means"],
        quats=wide["quats"],
        log_scales=np.log(scales),
        logit_opacities=np.log(opacities) - np.log1p(-opacities),
        sh=np.zeros((len(opacities), 1, 3)),
    ).params
    size = {name: int(data[name]) for name in ("width", "height")}
    camera = gsjax.make_camera(viewmat=wide["viewmat"], K=wide["K"], **size)
    # The oracle blended 0.1, 0.2, 0.3 as float32; the file holds them as float64.
    background = wide["bg"].astype(np.float32).astype(np.float64)
    cotangents = (jnp.asarray(wide["cot_image"]), jnp.asarray(wide["cot_alpha"]))
    images, (by_params, by_colors), overflowed = render_and_pull(
        params, jnp.asarray(wide["colors"]), camera, background, cotangents
    )
    assert not overflowed
    for name, image in zip(("image", "alpha"), images):
        assert np.std(wide[name]) > 0.05
        error = np.max(np.abs(image - wide[name]))
        report(f"{name}, all pixels", error, VALUE)
        assert error <= VALUE, name
    grads = {
        "means": by_params.means,
        "quats": by_params.quats,
        "scales": by_params.log_scales / scales,
        "opacities": by_params.logit_opacities / (opacities * (1 - opacities)),
        "colors": by_colors,
    }
    for name, found in grads.items():
        wanted = wide[f"grad_{name}"]
        assert np.mean(wanted != 0) > 0.1
        assert_close(report, f"gradient of {name}", found, wanted, DERIVATIVE_OF_IMAGES)
