"""Estimates of errors and bits, compared with sums written out and with derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import camera_of, gaussians_at
from scipy.spatial.transform import Rotation

import gsjax
from gsjax import RasterConfig
from gsjax.compression.curvature import shape_curvature
from gsjax.compression.harmonics import ViewedHarmonics
from gsjax.compression.lattices import lattice_of, round_to
from gsjax.math.clustering import nearest_by_cost
from gsjax.math.sh import eval_sh
from gsjax.raster.contribution import contribution

CONFIG = RasterConfig(tile_size=8, alpha_min=1e-6, pair_capacity=64, outputs=("rgb",))


def test_curvature_of_one_gaussian_seen_from_all_sides():
    """The estimate is the mean over views of the squares of all derivatives."""
    scene = gaussians_at(np.zeros((1, 3)), np.asarray([[0.5, 0.3, 0.2]]), [0.6])
    quat = np.asarray([[0.8, 0.1, -0.5, 0.3]])
    params = scene.params.replace(quats=quat / np.linalg.norm(quat))
    scene, camera = scene.replace(params=params), camera_of(24, 24, focal=(30, 30))
    names = "means", "quats", "log_scales", "logit_opacities"
    removal, step = np.zeros(1), 1e-4
    draw = jax.jit(lambda *view: gsjax.render(*view, CONFIG).rgb)
    sums = {name: 0 * np.asarray(getattr(scene.params, name)) for name in names}
    for turn in Rotation.random(16, rng=0).as_matrix():
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[2, 3] = turn, 4.0
        seen = camera.replace(viewmat=jnp.asarray(viewmat))

        def picture(params, seen=seen):
            moved = scene.replace(params=params)
            return np.asarray(draw(moved, seen))

        for name in names:
            value = np.asarray(getattr(scene.params, name))
            for place in np.ndindex(value.shape):
                ends = []
                for change in (step, -step):
                    moved = value.copy()
                    moved[place] += change
                    ends.append(picture(scene.params.replace(**{name: moved})))
                slope = (ends[0] - ends[1]) / (2 * step)
                sums[name][place] += np.sum(slope**2)
        removal += np.asarray(contribution(scene, seen, CONFIG).removal)
    rows = {name: np.asarray(value) for name, value in vars(scene.params).items()}
    found = shape_curvature(rows, removal, np.full(1, 0.3 * (4 / 30) ** 2))
    # Exact for the opacity, an estimate for the rest.
    np.testing.assert_allclose(found["logit_opacities"], sums["logit_opacities"], 0.01)
    for name in ("means", "log_scales", "quats"):
        assert 0.5 < found[name].sum() / sums[name].sum() < 2


@pytest.fixture
def viewed():
    """(coefficients, directions [V, N, 3], weights [V, N], the object)."""
    rng = np.random.default_rng(0)
    sh, means = rng.normal(size=(30, 16, 3)), rng.normal(size=(30, 3))
    centres, weights = 5 * rng.normal(size=(6, 3)), rng.exponential(size=(6, 30))
    weights[:, 7] = 0
    ways = means - centres[:, None]
    ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
    return sh, ways, weights, ViewedHarmonics(sh, means, centres, weights)


def colors(sh, ways) -> np.ndarray:
    wide = np.broadcast_to(sh, (len(ways), *sh.shape))
    return np.asarray(eval_sh(jnp.asarray(wide), jnp.asarray(ways)))


def plain_colors(sh, ways) -> np.ndarray:
    """[V, N, 3] without the clipping at 0."""
    return colors(sh + 1e3 * np.eye(1, sh.shape[1])[..., None], ways)


def test_degree_0_is_the_best_for_other_harmonics(viewed):
    sh, ways, weights, seen = viewed
    base, error = seen.refitted(np.zeros((30, 15, 3)))

    def loss(base):
        flat = np.zeros_like(sh)
        flat[:, 0] = base
        change = plain_colors(flat, ways) - plain_colors(sh, ways)
        return np.einsum("vn,vnc->n", weights, change**2)

    np.testing.assert_allclose(error, loss(base), rtol=1e-3, atol=1e-3)
    for step in (0.05, -0.05):
        moved = loss(base + step)
        assert (moved >= error - 1e-3).all()
        assert (moved > error)[weights.sum(0) > 0].all()


def test_simplified_harmonics_look_alike_and_are_smaller(viewed):
    sh, ways, weights, seen = viewed
    found = seen.simplified()
    change = plain_colors(found, ways) - plain_colors(sh, ways)
    spread = np.einsum("vn,vnc->", weights, plain_colors(sh, ways) ** 2 * 0 + 1)
    assert np.einsum("vn,vnc->", weights, change**2) / spread < 0.02
    assert np.square(found[:, 1:]).sum() < 0.7 * np.square(sh[:, 1:]).sum()
    np.testing.assert_allclose(found[7, 1:], 0, atol=1e-5)  # in no view


@pytest.mark.parametrize(("suffix", "least"), [(".sog", 1e-6), (".spz", 1e-9)])
def test_rounding_is_as_coarse_as_the_error_allows(suffix, least):
    rng = np.random.default_rng(1)
    rows = {"means": rng.normal(0, 3, (4000, 3))}
    lattice, curvature = lattice_of(suffix, rows), np.exp(rng.normal(0, 1, (4000, 3)))
    steps = []
    for allowed in (least, 100 * least):
        found = round_to(lattice.means, rows["means"], curvature, allowed)
        change = found.values - rows["means"]
        assert found.error == pytest.approx(np.sum(curvature * change**2))
        # Half a power of two at most from the best step, so within a factor of two.
        assert found.error / change.size == pytest.approx(allowed, rel=0.5)
        again = round_to(lattice.means, found.values, curvature, 0.0).values
        np.testing.assert_allclose(again, found.values, atol=1e-9)
        steps.append(len(np.unique(found.values)))
    assert steps[1] < 0.8 * steps[0]
    capped = round_to(lattice.means, rows["means"], 0 * curvature, 1.0, 0.01).values
    assert 0.002 < np.abs(capped - rows["means"]).max() <= 0.0051


def test_tables_of_sog_hold_all_distinct_values():
    values = np.random.default_rng(2).normal(0, 5, (2000, 3))
    axis = lattice_of(".sog", {"means": values}).log_scales
    found = round_to(axis, values, np.full(values.shape, 1e9), 1e-12).values
    assert 128 <= len(np.unique(found)) <= 256
    # Max 1960: σ² 2.72 / 256²; even steps would lose five times as much.
    assert np.mean(np.square(found - values)) < 1.2 * 25 * 2.72 / 256**2


def test_labels_of_least_cost():
    rng = np.random.default_rng(3)
    points, centroids = rng.normal(size=(300, 5)), rng.normal(size=(20, 5))
    weights, costs = rng.exponential(size=300), 3 * rng.exponential(size=20)
    found = nearest_by_cost(points, centroids, weights, costs)
    squares = np.sum((points[:, None] - centroids) ** 2, -1)
    total = weights[:, None] * squares + costs
    np.testing.assert_allclose(
        total[np.arange(300), found], total.min(1), rtol=1e-4, atol=1e-4
    )
    assert (found != squares.argmin(1)).any()
