"""Tiled against dense: the same settings, every kind of scene.

Bars: 1e-10 in float64, 1e-5 in float32 (1e-3 for needles, whose float32 error is that
of their own parameters), outside the bands around thresholds, where rounding may decide
whether a Gaussian is blended. `reference_render` gives the distance to the nearest
threshold ("margin"); the number of pixels in the band is bounded too.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import (
    BACKGROUND,
    COMPAT,
    COUNT,
    PRESETS,
    SCENES,
    WHOLE,
    assert_not_empty,
    camera_of,
    cast,
    frustum_points,
    gaussians_at,
    psnr,
    reference,
    render,
    scene_of,
)
from pictures import errors_of

import gsjax
from gsjax.cameras.camera import camera_centre
from gsjax.math.rotations import quaternion_to_matrix
from gsjax.raster.reference import reference_colors

BAR = {jnp.float64: 1e-10, jnp.float32: 1e-5}
BAND = {jnp.float64: 1e-9, jnp.float32: 1e-4}
DEVICES = min(2, jax.local_device_count())
NEEDLES = ("needles_1000", "needles_10000")


def compare(gaussians, camera, config, dtype, background=BACKGROUND, **kwargs):
    """Return errors of `render` in ``dtype`` against the float64 oracle."""
    wanted = reference(gaussians, camera, config, background, **kwargs)
    given = cast((gaussians, camera, background, kwargs), dtype)
    out = render(given[0], given[1], config, given[2], **given[3])
    assert not out.overflowed
    assert out.rgb.shape[:2] == (camera.height, camera.width)
    assert out.rgb.dtype == out.alpha.dtype == out.depth.dtype == dtype
    assert_not_empty(out.alpha)
    return errors_of(out, wanted, BAND[dtype])


def check(errors, bar, report, name):
    for output, error in errors.items():
        report(f"{name}, {output}", error, bar)
        assert error <= bar, (name, output)


@pytest.mark.parametrize("preset", ["compat", "accurate"])
@pytest.mark.parametrize("kind", SCENES)
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_every_kind_of_scene(dtype, kind, preset, report):
    errors, pixels = compare(*scene_of(kind), PRESETS[preset], dtype)
    bar = BAR[dtype]
    if kind in NEEDLES:  # the oracle inverts a matrix whose determinant cancels
        bar = 1e-6 if dtype == jnp.float64 else 1e-3
    if dtype == jnp.float32:  # T = 1/2 is one more threshold
        errors["median_depth"] = np.quantile(pixels["median_depth"], 0.995)
    check(errors, bar, report, f"{kind}, {preset}, {dtype.__name__}")


@pytest.mark.parametrize("kind", NEEDLES)
def test_needles_against_factors(kind, report):
    """Compare with a NumPy oracle that never forms the covariance."""
    gaussians, camera = scene_of(kind)
    out = render(gaussians, camera, WHOLE, BACKGROUND)
    wanted = well_conditioned_render(gaussians, camera, WHOLE, BACKGROUND)
    errors, _ = errors_of(out, wanted, BAND[jnp.float64])
    check(errors, BAR[jnp.float64], report, f"{kind}, factors")


@pytest.mark.parametrize(
    ("changes", "dtype"),
    [
        ({"tile_size": 4, "chunk_size": 8, "antialias": True}, jnp.float64),
        ({"tile_size": 7, "transmittance_min": 0.0, "alpha_max": 1.0}, jnp.float64),
        ({"tile_size": 16, "num_size_buckets": 4, "dilation": 0.0}, jnp.float64),
        ({"tile_size": 32, "chunk_size": 1, "devices": DEVICES}, jnp.float32),
    ],
    ids=str,
)
def test_settings(changes, dtype, report):
    for kind in ("random", "wall", "around", "saturated"):
        errors, pixels = compare(*scene_of(kind), WHOLE.replace(**changes), dtype)
        if dtype == jnp.float32:
            errors["median_depth"] = np.quantile(pixels["median_depth"], 0.995)
        check(errors, BAR[dtype], report, f"{kind}, {changes}")


@pytest.mark.parametrize(
    ("size", "degree", "lens", "channels"),
    [
        ((1, 1), 4, "pinhole", None),
        ((33, 50), 0, "orthographic", None),
        ((45, 29), 1, "pinhole", 5),
    ],
)
def test_sizes_degrees_lenses_and_features(size, degree, lens, channels, report):
    gaussians, rng = scene_of("random")[0], np.random.default_rng(0)
    focal = (8.0, 7.0) if lens == "orthographic" else (40.0, 43.0)
    camera, more = camera_of(*size, lens=lens, focal=focal), {}
    if channels:
        more["features"] = rng.normal(size=(COUNT, channels))
        more["background"] = rng.uniform(size=channels)
    gaussians = gsjax.with_sh_degree(gaussians, degree)
    errors, _ = compare(gaussians, camera, COMPAT, jnp.float64, **more)
    name = f"size {size}, degree {degree}, {lens}, {channels} features"
    check(errors, BAR[jnp.float64], report, name)


def test_the_reference_ignores_gaussians_that_are_not_drawn():
    """Their neighbours keep images and gradients, whatever the position is."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(6, 3)) * 0.3 + [0, 0, 3]
    gaussians, camera = gaussians_at(points, np.full((6, 1), 0.3), 0.5), camera_of(8, 7)

    @jax.jit
    @partial(jax.value_and_grad, has_aux=True)
    def picture(means):
        scene = gaussians.replace(params=gaussians.params.replace(means=means))
        found = reference(scene, camera, WHOLE, BACKGROUND)
        return jnp.sum(found["rgb"]), found

    means, keep = gaussians.params.means, np.arange(6) != 3
    others = jax.tree.map(lambda a: a[keep], gaussians)
    wanted = reference(others, camera, WHOLE, BACKGROUND)
    assert_not_empty(wanted["alpha"])
    for place in (camera_centre(camera.viewmat), np.full(3, np.nan)):
        (_, found), slopes = picture(means.at[3].set(jnp.asarray(place)))
        for name in ("rgb", "alpha", "depth"):
            np.testing.assert_allclose(found[name], wanted[name], atol=1e-14)
        assert np.isfinite(slopes[keep]).all()
        if np.isfinite(place).all():
            np.testing.assert_array_equal(slopes[3], 0)
    none = gaussians.replace(active=np.zeros(6, bool))
    empty = jax.jit(lambda: gsjax.reference_render(none, camera, WHOLE, BACKGROUND))()
    assert (empty["rgb"] == BACKGROUND).all()
    assert np.isinf(empty["margin"]).all()


def as_trained():
    rng = np.random.default_rng(9)
    points, opacities = frustum_points(rng, 4000, spread=1.0), rng.beta(0.5, 0.7, 4000)
    scales = np.exp(rng.normal(-3, 1, (4000, 3)))
    return gaussians_at(points, scales, opacities), camera_of()


def faint():
    rng = np.random.default_rng(9)
    points, scales = frustum_points(rng, 4000), rng.uniform(0.3, 2, (4000, 3))
    return gaussians_at(points, scales, 0.003), camera_of()


THOUSANDS = {"4000 as trained": as_trained, "4000 faint": faint}


@pytest.mark.parametrize("kind", [*THOUSANDS, *SCENES])
def test_accurate_against_the_exact_image(kind, report):
    """The preset errs by at most 0.5/255 from the image without limits; 65 dB."""
    config = PRESETS["accurate"]
    gaussians, camera = scene_of(kind) if kind in SCENES else THOUSANDS[kind]()
    if kind in THOUSANDS:
        config = config.replace(pair_capacity=2**17)
    exact = reference(gaussians, camera, None, BACKGROUND)
    out = render(gaussians, camera, config, BACKGROUND)
    assert not out.overflowed
    assert_not_empty(out.alpha)
    errors = {n: np.max(np.abs(getattr(out, n) - exact[n])) for n in ("rgb", "alpha")}
    check(errors, 0.5 / 255, report, f"exact {kind}")
    assert psnr(out.rgb, exact["rgb"]) >= 65


def well_conditioned_render(gaussians, camera, config, background):
    """Render like `reference_render`, by QR of [J W R S, √e I] instead of inverses.

    Q = dᵀ (A Aᵀ)⁻¹ d = ‖R⁻ᵀ d‖² with Aᵀ = Q R: the condition is not squared.
    """
    p, viewmat = gaussians.params, np.asarray(camera.viewmat)
    points = p.means @ viewmat[:3, :3].T + viewmat[:3, 3]

    def jacobian(point):
        at = camera.linearise(tuple(point))
        return jax.jacfwd(lambda q: jnp.stack(camera.project(tuple(q))))(jnp.stack(at))

    half = jax.jit(jax.vmap(jacobian))(points) @ viewmat[:3, :3]
    half = half @ quaternion_to_matrix(p.quats) * jnp.exp(p.log_scales)[:, None]
    dilate = np.broadcast_to(np.sqrt(config.dilation) * np.eye(2), (COUNT, 2, 2))
    factor = np.linalg.qr(np.concatenate([half, dilate], -1).swapaxes(1, 2))[1]
    centres = np.stack(camera.project(tuple(points.T)), -1)
    colors = np.asarray(reference_colors(gaussians, camera))
    opacities = np.asarray(jax.nn.sigmoid(p.logit_opacities))
    depth = np.asarray(points[:, 2])

    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    shape = (camera.height, camera.width)
    passed, total, expected, median = (np.zeros(shape) for _ in range(4))
    passed += 1
    margin, rgb = np.full(shape, np.inf), np.zeros((*shape, 3))
    for i in np.argsort(depth, kind="stable"):
        if not camera.near < depth[i] < camera.far:
            continue
        offset = np.stack([x, y]).reshape(2, -1) - centres[i][:, None]
        q = np.square(np.linalg.solve(factor[i].T, offset)).sum(0).reshape(shape)
        raw = opacities[i] * np.exp(-q / 2)
        alpha = np.where(raw < config.alpha_min, 0, np.minimum(raw, config.alpha_max))
        after = passed * (1 - alpha)
        weight = np.where(after > config.transmittance_min, alpha * passed, 0)
        margin = np.minimum(margin, np.abs(raw / config.alpha_min - 1))
        margin = np.minimum(margin, np.abs(after / config.transmittance_min - 1))
        median += np.where((passed > 0.5) & (after <= 0.5), depth[i], 0)
        rgb += weight[..., None] * colors[i]
        total, expected = total + weight, expected + weight * depth[i]
        passed = after
    return {
        "rgb": rgb + (1 - total)[..., None] * background,
        "alpha": total,
        "depth": expected / np.where(total > 1e-10, total, 1),
        "median_depth": median,
        "margin": margin,
    }
