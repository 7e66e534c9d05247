"""Tiled against dense: the same knobs, every kind of scene, every setting.

Bars: 1e-10 in float64, 1e-5 in float32 (1e-3 for needles, whose float32 error is that
of their own parameters), outside the threshold bands, where a rounding may decide
whether a whole Gaussian is blended. `reference_render` gives the distance to the
nearest threshold ("margin"); how many pixels lie in the band is bounded too.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import (
    ALL,
    BACKGROUND,
    COUNT,
    HEIGHT,
    PRESETS,
    SCENES,
    WHOLE,
    WIDTH,
    assert_not_empty,
    camera_of,
    cast,
    frustum_points,
    gaussians_at,
    pose,
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
NEEDLES = ("needles_1000", "needles_10000")


def compare(gaussians, camera, config, dtype, background=BACKGROUND, **kwargs):
    """Errors of `render` in ``dtype`` against the float64 oracle."""
    wanted = reference(gaussians, camera, config, background, **kwargs)
    given = cast((gaussians, camera, background, kwargs), dtype)
    out = render(given[0], given[1], config, given[2], **given[3])
    assert not out.overflowed
    assert out.rgb.shape[:2] == (camera.height, camera.width)
    assert out.rgb.dtype == out.alpha.dtype == out.depth.dtype == dtype
    assert_not_empty(out.alpha)
    return errors_of(out, wanted, BAND[dtype])


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("kind", SCENES)
def test_float64(kind, preset, report):
    errors, _ = compare(*scene_of(kind), PRESETS[preset], jnp.float64)
    # The oracle inverts a matrix whose determinant cancels; see the next test.
    bar = 1e-6 if kind in NEEDLES else BAR[jnp.float64]
    for name, error in errors.items():
        report(f"{kind}, {preset}, {name}, float64", error, bar)
        assert error <= bar, name


@pytest.mark.parametrize("kind", ["random", "around", *NEEDLES])
def test_float64_against_factors(kind, report):
    """Needles against an oracle in numpy that never forms the covariance."""
    gaussians, camera = scene_of(kind)
    out = render(gaussians, camera, WHOLE, BACKGROUND)
    wanted = well_conditioned_render(gaussians, camera, WHOLE, BACKGROUND)
    errors, _ = errors_of(out, wanted, BAND[jnp.float64])
    for name, error in errors.items():
        report(f"{kind}, {name}, float64, factors", error, BAR[jnp.float64])
        assert error <= BAR[jnp.float64], name


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("kind", SCENES)
def test_float32(kind, preset, report):
    _, errors = compare(*scene_of(kind), PRESETS[preset], jnp.float32)
    bar = 1e-3 if kind in NEEDLES else BAR[jnp.float32]
    for name, error in errors.items():
        if name == "median_depth":  # T = 1/2 is one more threshold
            assert np.mean(error > bar) <= 0.005
            error = error[error <= bar]
        report(f"{kind}, {preset}, {name}, float32", error.max(), bar)
        assert error.max() <= bar, name


@pytest.mark.parametrize(
    "changes",
    [
        {"tile_size": 4, "chunk_size": 8, "tiles_per_step": 7},
        {"tile_size": 16, "chunk_size": 1, "tiles_per_step": 1, "num_size_buckets": 4},
        {"tile_size": 32, "chunk_size": 128},
        {"tile_size": 7, "occlusion": False},
        {"antialias": True},
        {"dilation": 0.0},
        {"dilation": 0.1, "antialias": True, "stop": 0.0, "alpha_max": 1.0},
        {"devices": 2},
    ],
    ids=str,
)
def test_settings(changes, report):
    if changes.get("devices", 1) > jax.local_device_count():
        pytest.skip("needs two local devices")
    for kind in ("random", "wall", "around", "saturated"):
        errors, _ = compare(*scene_of(kind), WHOLE.replace(**changes), jnp.float64)
        for name, error in errors.items():
            report(f"{kind}, {changes}, {name}", error, BAR[jnp.float64])
            assert error <= BAR[jnp.float64], (kind, name)


@pytest.mark.parametrize(
    ("size", "dtype"),
    [
        ((1, 1), jnp.float64),
        ((1, 1), jnp.float32),
        ((17, 1), jnp.float64),
        ((1, 17), jnp.float64),
        ((33, 50), jnp.float64),
    ],
    ids=str,
)
def test_sizes(size, dtype, report):
    gaussians, _ = scene_of("random")
    errors, _ = compare(gaussians, camera_of(*size), WHOLE, dtype)
    for name, error in errors.items():
        report(f"size {size}, {name}, {dtype.__name__}", error, BAR[dtype])
        assert error <= BAR[dtype], name


@pytest.mark.parametrize("at", ["the camera", "nowhere"])
def test_a_gaussian_that_is_not_drawn_changes_nothing(at):
    """Neither a pixel nor a gradient, of a degree that turns with the view."""
    gaussians, camera = scene_of("random")
    place = camera_centre(camera.viewmat) if at == "the camera" else np.full(3, np.nan)

    def picture(means):
        params = gaussians.params.replace(means=means)
        found = reference(gaussians.replace(params=params), camera, WHOLE)
        return jnp.sum(found["rgb"]), found

    means = gaussians.params.means.at[3].set(jnp.asarray(place))
    keep = np.delete(np.arange(COUNT), 3)
    active = gaussians.active.at[3].set(False)
    wanted = gsjax.reference_render(gaussians.replace(active=active), camera, WHOLE)
    (_, found), slopes = jax.value_and_grad(picture, has_aux=True)(means)
    for name in ("rgb", "alpha", "depth"):
        np.testing.assert_allclose(found[name], wanted[name], atol=1e-14)
    assert np.isfinite(slopes[keep]).all()
    if at == "the camera":
        np.testing.assert_array_equal(slopes[3], 0)


def test_no_gaussian_is_the_background():
    gaussians, camera = scene_of("random")
    none = gaussians.replace(active=jnp.zeros(COUNT, bool))
    for config in (None, WHOLE, WHOLE.replace(transmittance_min=0.0)):
        found = gsjax.reference_render(none, camera, config, BACKGROUND)
        assert (found["rgb"] == BACKGROUND).all()
        assert np.isinf(found["margin"]).all()


def test_orthographic(report):
    gaussians, _ = scene_of("random")
    camera = camera_of(lens="orthographic", focal=(8.0, 7.0))
    errors, _ = compare(gaussians, camera, WHOLE, jnp.float64)
    for name, error in errors.items():
        report(f"orthographic, {name}", error, BAR[jnp.float64])
        assert error <= BAR[jnp.float64], name


@pytest.mark.parametrize("degree", [0, 4])
def test_degrees(degree, report):
    """Degree 3 is that of all other scenes."""
    gaussians, camera = scene_of("random")
    gaussians = gsjax.with_sh_degree(gaussians, degree)
    errors, _ = compare(gaussians, camera, WHOLE, jnp.float64)
    report(f"degree {degree}", max(errors.values()), BAR[jnp.float64])
    assert max(errors.values()) <= BAR[jnp.float64]


@pytest.mark.parametrize("channels", [1, 5])
def test_features(channels, report):
    gaussians, camera = scene_of("random")
    rng = np.random.default_rng(0)
    features = jnp.asarray(rng.normal(size=(COUNT, channels)))
    background = rng.normal(size=channels)
    errors, _ = compare(
        gaussians, camera, WHOLE, jnp.float64, background, features=features
    )
    report(f"{channels} features", max(errors.values()), BAR[jnp.float64])
    assert max(errors.values()) <= BAR[jnp.float64]


def test_batch_with_a_background_each(report):
    gaussians, first = scene_of("random")
    cameras = [first, camera_of(viewmat=pose(0) + 0.0, centre=(30, 8))]
    backgrounds = np.random.default_rng(0).uniform(0, 1, (2, 3))
    out = render(gaussians, gsjax.stack_cameras(cameras), WHOLE, backgrounds)
    assert out.rgb.shape == (2, HEIGHT, WIDTH, 3)
    assert out.radii.shape == (2, COUNT)
    for i, camera in enumerate(cameras):
        wanted = reference(gaussians, camera, WHOLE, backgrounds[i])
        one = out._replace(**{name: getattr(out, name)[i] for name in ALL})
        errors, _ = errors_of(one, wanted, BAND[jnp.float64])
        report("batch with backgrounds", max(errors.values()), BAR[jnp.float64])
        assert max(errors.values()) <= BAR[jnp.float64]
        assert_not_empty(one.alpha)


def thousands(kind):
    """4000 Gaussians, mixed as after training, or all faint."""
    rng = np.random.default_rng(9)
    if kind == "4000 faint":
        points = frustum_points(rng, 4000)
        return gaussians_at(points, rng.uniform(0.3, 2, (4000, 3)), 0.003)
    points = frustum_points(rng, 4000, spread=1.0)
    scales = np.exp(rng.normal(-3, 1, (4000, 3)))
    return gaussians_at(points, scales, rng.beta(0.5, 0.7, 4000))


@pytest.mark.parametrize("kind", ["4000 as trained", "4000 faint", *SCENES])
def test_accurate_against_the_exact_image(kind, report):
    """No cut-off, no cap, no stop: 0.5/255 everywhere and 65 dB."""
    if kind in SCENES:
        gaussians, camera = scene_of(kind)
    else:
        gaussians, camera = thousands(kind), camera_of()
    config = PRESETS["accurate"]
    if kind == "4000 faint":
        config = config.replace(pair_capacity=2**17)
    exact = reference(gaussians, camera, None, BACKGROUND)
    out = render(gaussians, camera, config, BACKGROUND)
    assert not out.overflowed
    assert_not_empty(out.alpha)
    for name in ("rgb", "alpha"):
        error = np.max(np.abs(getattr(out, name) - exact[name]))
        report(f"exact {kind}, {name}", error, 0.5 / 255)
        assert error <= 0.5 / 255
    quality = psnr(out.rgb, exact["rgb"])
    report(f"exact {kind}, 65 dB over PSNR", 65 / quality, 1.0)
    assert quality >= 65


def well_conditioned_render(gaussians, camera, config, background):
    """As `reference_render`, by QR of the factor [J W R S, √e I] instead of inverses.

    Q = dᵀ (A Aᵀ)⁻¹ d = ‖R⁻ᵀ d‖² with Aᵀ = Q R: the condition is not squared.
    """
    p, viewmat = gaussians.params, np.asarray(camera.viewmat)
    points = p.means @ viewmat[:3, :3].T + viewmat[:3, 3]

    def jacobian(point):
        at = camera.linearise(tuple(point))
        return jax.jacfwd(lambda q: jnp.stack(camera.project(tuple(q))))(jnp.stack(at))

    half = jax.vmap(jacobian)(points) @ viewmat[:3, :3]
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
