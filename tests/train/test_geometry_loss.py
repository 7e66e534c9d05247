"""Losses of geometry: normals of analytic depth, values by hand, a run of surfels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import camera_of
from training import RASTER, dataset, photos

import gsjax
from gsjax.errors import InputError
from gsjax.init.surfels import flattened, laid_on_points
from gsjax.math.rotations import covariance, quaternion_to_matrix
from gsjax.train.frames import Batch
from gsjax.train.geometry_loss import (
    geometry_terms,
    normal_consistency,
    normals_of_depth,
    opacity_entropy,
    relative_distortion,
)
from gsjax.train.geometry_priors import (
    given_normals_loss,
    given_normals_term,
    monocular_depth_loss,
    monocular_depth_term,
)

WIDTH, HEIGHT = 41, 30
CAMERA = camera_of(WIDTH, HEIGHT, viewmat=np.eye(4))
PLANE = np.array([0.3, -0.2, -0.9]) / np.linalg.norm([0.3, -0.2, -0.9])
INSIDE = slice(1, -1), slice(1, -1)


def rays(camera):
    ys, xs = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    K = np.asarray(camera.K)
    x, y = (xs - K[0, 2]) / K[0, 0], (ys - K[1, 2]) / K[1, 1]
    return np.stack([x, y, np.ones_like(x)], -1)


def test_normals_of_a_plane():
    depth = 3 * PLANE[2] / (rays(CAMERA) @ PLANE)
    normals = np.asarray(normals_of_depth(jnp.asarray(depth), CAMERA))
    np.testing.assert_allclose(normals[INSIDE], np.broadcast_to(PLANE, (28, 39, 3)))
    assert not normals[0].any()
    assert not normals[:, -1].any()


def test_normals_of_a_sphere_by_range():
    """A fisheye measures the distance; neighbours of holes have no normal."""
    coefficients = [0.0, 0.0, 0.0, 0.0]
    camera = camera_of(
        WIDTH, HEIGHT, viewmat=np.eye(4), lens="fisheye", coefficients=coefficients
    )
    xs, ys = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    ray = camera.lens.unproject(camera.K, camera.coefficients, (xs, ys))
    ray = np.stack([np.asarray(r) for r in ray], -1)
    ray = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    centre, radius = np.array([0.1, 0.0, 4.0]), 2.0
    along = ray @ centre
    missing = centre @ centre - along**2
    hit = missing < radius**2
    depth = np.where(hit, along - np.sqrt(np.maximum(radius**2 - missing, 0)), 0)
    found = np.asarray(normals_of_depth(jnp.asarray(depth), camera))
    wanted = (depth[..., None] * ray - centre) / radius
    steep = np.sum(wanted * ray, -1) < -0.5
    clear = hit & steep & found.any(-1)
    assert 50 < clear.sum() < hit.sum()
    assert np.sum(found * wanted, -1)[clear].min() > 0.999
    assert not found[~hit].any()


def test_consistency_by_hand():
    depth = jnp.asarray(3 * PLANE[2] / (rays(CAMERA) @ PLANE))
    alpha = jnp.full(depth.shape, 0.75)
    normals = 0.75 * jnp.broadcast_to(PLANE, (*depth.shape, 3))
    same = normal_consistency(normals, alpha, depth, CAMERA)
    np.testing.assert_allclose(same, 0, atol=1e-12)
    opposite = normal_consistency(-normals, alpha, depth, CAMERA)
    share = 28 * 39 / (HEIGHT * WIDTH)
    np.testing.assert_allclose(opposite, 1.5 * share, rtol=1e-12)


@pytest.mark.parametrize("value", [0.0, 1.0, 1e-20, 1e20])
def test_gradients_are_finite(value):
    depth = jnp.full((HEIGHT, WIDTH), value)
    normals = jnp.zeros((HEIGHT, WIDTH, 3))
    gradient = jax.grad(normal_consistency, (0, 1, 2))
    for leaf in gradient(normals, jnp.zeros_like(depth), depth, CAMERA):
        assert np.isfinite(leaf).all()


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_distortion_by_hand(unit):
    """Of two surfaces; in any unit of length."""
    near, far, weights = 2.0 * unit, 2.1 * unit, (0.5, 0.25)
    distortion = jnp.asarray(weights[0] * weights[1] * (1 / near - 1 / far) ** 2)
    depth = jnp.asarray((0.5 * near + 0.25 * far) / 0.75)
    value, slope = jax.value_and_grad(relative_distortion, 1)(distortion, depth)
    assert value == pytest.approx(0.125 * (1 - near / far) ** 2, rel=0.05)
    assert slope == 0


def test_entropy_by_hand():
    opacity = jnp.array([0.5, 0.0, 1.0, 0.5])
    active = jnp.array([True, True, True, False])
    value = jax.value_and_grad(opacity_entropy)
    found, slopes = value(opacity, active)
    np.testing.assert_allclose(found, np.log(2) / 3)
    assert np.isfinite(slopes).all()
    assert opacity_entropy(opacity, active & False) == 0


def test_flattened_keeps_covariances():
    rng = np.random.default_rng(0)
    scales, quats = rng.normal(size=(30, 3)), rng.normal(size=(30, 4))
    given = gsjax.make_gaussians(
        means=np.zeros((30, 3)),
        quats=quats,
        log_scales=scales,
        logit_opacities=np.zeros(30),
        sh=np.zeros((30, 1, 3)),
    )
    params = flattened(given).params
    assert (np.argmin(params.log_scales, -1) == 2).all()
    before = covariance(given.params.quats, jnp.exp(given.params.log_scales))
    after = covariance(params.quats, jnp.exp(params.log_scales))
    np.testing.assert_allclose(after, before, atol=1e-12)


def test_surfels_lie_in_the_plane_of_their_neighbours():
    rng = np.random.default_rng(0)
    across = np.linalg.svd(PLANE[None])[2][1:]
    points = rng.uniform(-1, 1, (200, 2)) @ across
    made = gsjax.make_gaussians(
        means=points,
        quats=np.tile([1.0, 0, 0, 0], (200, 1)),
        log_scales=np.full((200, 3), -2.0),
        logit_opacities=np.zeros(200),
        sh=np.zeros((200, 1, 3)),
        capacity=256,
    )
    params = laid_on_points(made).params
    normals = quaternion_to_matrix(params.quats[:200])[:, :, 2]
    np.testing.assert_allclose(np.abs(normals @ PLANE), 1, atol=1e-9)
    np.testing.assert_allclose(params.log_scales[:200, 2], -9)


def test_a_run_of_surfels_with_all_losses():
    config = gsjax.TrainConfig(
        steps=40,
        sh_degree=0,
        raster=RASTER.replace(pair_capacity=None),
        primitive="surfel",
        normal_weight=0.05,
        distortion_weight=10.0,
        entropy_weight=0.01,
        prune_invisible=False,
    )
    assert config.raster.draws_surfels
    terms = geometry_terms(config)
    assert [term.name for term in terms] == ["normals", "distortion", "entropy"]
    assert [term.start for term in terms] == [10, 4, 20]
    result = gsjax.fit(dataset(), photos(), config)
    thin = np.asarray(result.gaussians.params.log_scales)
    active = np.asarray(result.gaussians.active)
    assert (thin[active, 2] < thin[active, :2].min(-1) - 4).all()
    view = gsjax.evaluate(
        result.gaussians, dataset().views, photos(), config=config.raster
    )
    assert np.mean([one.psnr for one in view]) > 15


def test_settings_of_geometry():
    default = gsjax.TrainConfig()
    assert not default.raster.draws_surfels
    assert geometry_terms(default) == ()
    surfels = default.replace(primitive="surfel")
    assert surfels.raster == default.raster.replace(primitive="surfel")
    precise = surfels.replace(refine_poses=True)
    assert precise.raster.alpha_min == 1e-5
    assert precise.raster.draws_surfels
    with pytest.raises(InputError, match="primitive"):
        default.replace(primitive="disc")


def test_given_normals():
    """Zero on the target, 2 against it; pixels without a target do not count."""
    target = np.broadcast_to(PLANE, (HEIGHT, WIDTH, 3)).copy()
    alpha = jnp.full((HEIGHT, WIDTH), 0.5)
    normals = jnp.asarray(0.5 * target)
    target *= 3  # any length
    target[:10] = 0
    target[10] = np.nan
    loss, slope = jax.value_and_grad(given_normals_loss)(normals, alpha, target)
    assert loss == pytest.approx(0, abs=1e-12)
    assert np.isfinite(slope).all()
    assert not slope[:11].any()
    assert given_normals_loss(-normals, alpha, target) == pytest.approx(1.0)
    valid = jnp.zeros((HEIGHT, WIDTH))
    assert given_normals_loss(-normals, alpha, target, valid) == 0


def test_monocular_depth():
    """Scale and shift do not matter, noise does; holes have no derivative."""
    depth = jnp.asarray(3 * PLANE[2] / (rays(CAMERA) @ PLANE))
    alpha = jnp.ones_like(depth).at[:5].set(0.2)
    target = np.array(7 / depth - 0.4)
    target[:, :4] = np.nan
    assert monocular_depth_loss(depth, alpha, target) < 1e-12
    noise = 0.1 * np.random.default_rng(0).normal(size=depth.shape)
    noisy = target * (1 + noise)
    loss, slope = jax.value_and_grad(monocular_depth_loss)(depth, alpha, noisy)
    assert 0.01 < loss < 0.2
    assert np.isfinite(slope).all()
    assert not slope[:5].any()
    assert not slope[:, :4].any()
    assert monocular_depth_loss(depth, 0 * alpha, target) == 0


def test_priors_in_a_step():
    """Terms take the view's image; images of another shape are refused."""
    with pytest.raises(InputError, match=r"targets\[0\].*\[H, W, 3\]"):
        given_normals_term([np.zeros((4, 4))])
    facing = np.broadcast_to(PLANE, (HEIGHT, WIDTH, 3))
    normals = given_normals_term([0 * facing, -facing])
    assert normals.outputs == ("normals", "alpha")
    depth = 3 * PLANE[2] / (rays(CAMERA) @ PLANE)
    noise = 1 + 0.1 * np.random.default_rng(0).normal(size=depth.shape)
    monocular = monocular_depth_term([1 / depth, noise / depth])
    assert monocular.outputs == ("depth", "alpha")
    none = gsjax.Render(**dict.fromkeys(gsjax.Render._fields))
    view = none._replace(
        alpha=jnp.ones((1, HEIGHT, WIDTH)),
        normals=jnp.asarray(facing)[None],
        depth=jnp.asarray(depth)[None],
    )
    for index, least in enumerate([0.0, 0.01]):
        batch = Batch(None, None, CAMERA, jnp.array([index]))
        assert normals.function(view, batch, None) == pytest.approx(2.0 * index)
        assert (
            least <= monocular.function(view, batch, None) < least + 0.2 * index + 1e-6
        )
