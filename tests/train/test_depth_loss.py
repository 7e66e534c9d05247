"""The depth loss: values by hand, finite gradients, and the views of a batch."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from training import RASTER, VIEWS, dataset, photos, rough_start

import gsjax
from gsjax.errors import InputError
from gsjax.train.depth_loss import depth_loss, depth_term
from gsjax.train.frames import draw, make_frames
from gsjax.train.models import SceneParams

DEPTH = jnp.array([[2.0, 3.0, 0.0, 5.0]])
ALPHA = jnp.array([[0.5, 1.0, 0.0, 0.25]])
TARGET = jnp.array([[4.0, 2.0, 3.0, 0.0]])
NOTHING = (0.0, -1.0, np.nan, np.inf)


def test_value_by_hand():
    error = (0.5 * 2 / 4 + 1.0 * 1 / 2 + 0.0) / 3
    np.testing.assert_allclose(depth_loss(DEPTH, ALPHA, TARGET), error, 1e-12)
    missed = (0.5 + 0.0 + 1.0 + 0.25) / 4
    both = depth_loss(DEPTH, ALPHA, TARGET, hit_weight=0.3)
    np.testing.assert_allclose(both, error + 0.3 * missed, 1e-12)
    weight = jnp.array([[True, False, False, True]])
    found = depth_loss(DEPTH, ALPHA, TARGET, weight, hit_weight=0.3)
    np.testing.assert_allclose(found, 0.25 + 0.3 * 0.375, 1e-12)


@pytest.mark.parametrize("nothing", NOTHING)
def test_pixels_without_return_do_not_count(nothing):
    """They change neither depth nor value; with a weight of hits, α falls."""
    target = TARGET.at[0, 3].set(nothing)

    def loss(depth, alpha, hit_weight):
        return depth_loss(depth, alpha, target, hit_weight=hit_weight)

    gradient = jax.grad(loss, (0, 1))
    by_depth, by_alpha = gradient(DEPTH, ALPHA, 0.0)
    assert by_depth[0, 3] == 0
    assert (by_alpha == 0).all()
    changed = loss(DEPTH.at[0, 3].set(9.0), ALPHA, 0.0)
    assert changed == loss(DEPTH, ALPHA, 0.0)
    _, by_alpha = gradient(DEPTH, ALPHA, 1.0)
    np.testing.assert_allclose(by_alpha, [[-0.25, -0.25, -0.25, 0.25]])


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_gradients_are_finite(dtype):
    """Empty renders, missing returns, equal depths, and no pixels at all."""
    target = jnp.array([0.0, np.nan, np.inf, 1e-38, 2.0, 1e9], dtype)
    for value in (0.0, 2.0, 1e9):
        for weight in (None, jnp.zeros(6), jnp.ones(6)):
            value_of = jax.value_and_grad(depth_loss, (0, 1))
            filled = jnp.full(6, value, dtype)
            for alpha in (0.0, 1.0):
                given = filled, jnp.full(6, alpha, dtype), target, weight
                found = value_of(*given, hit_weight=1.0)
                assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))


def test_term_takes_the_images_of_the_views():
    """Also its gradient by the means, against finite differences."""
    raster = RASTER.replace(outputs=("alpha", "depth"))
    gaussians = rough_start(0, 64)
    frames = make_frames(dataset().views, photos())
    batch = draw(frames, jnp.array([2, 0]))
    images = np.random.default_rng(0).uniform(2, 4, (VIEWS, *frames.pixels.shape[1:3]))
    images[:, :5] = 0
    targets, hit = images[[2, 0]], images[[2, 0]] > 0
    term = depth_term(images, hit_weight=0.1)

    @jax.jit
    @partial(jax.value_and_grad, has_aux=True)
    def loss(means):
        moved = gaussians.replace(params=gaussians.params.replace(means=means))
        view = gsjax.render(moved, batch.camera, raster)
        value = term.function(view, batch, no_params())
        return value, (view.depth, view.alpha)

    means, size = gaussians.params.means, 1e-6
    (value, (depth, held)), gradient = loss(means)
    expected = depth_loss(depth, held, targets, hit_weight=0.1)
    np.testing.assert_allclose(value, expected, 1e-6)

    def differentiated(means):
        """Return the loss with the factor α of the error held."""
        (_, (depth, alpha)), _ = loss(means)
        error = held * np.abs(depth - targets) / np.where(hit, targets, 1)
        missed = np.where(hit, 1 - alpha, alpha)
        return error[hit].mean() + 0.1 * missed.mean()

    step = jax.random.normal(jax.random.key(0), means.shape)
    after, before = (differentiated(means + s * size * step) for s in (1, -1))
    slope = (after - before) / (2 * size)
    np.testing.assert_allclose(jnp.vdot(gradient, step), slope, 2e-2)


def test_other_resolutions_take_the_nearest_pixel():
    half = make_frames(dataset().views, photos(), divisor=2)
    batch = draw(half, jnp.array([1]))
    height, width = half.pixels.shape[1:3]
    large = np.arange(VIEWS * 4 * height * width).reshape(VIEWS, 2 * height, -1) + 1.0
    render = depths(jnp.asarray(large[1:2, 1::2, 1::2]))
    assert depth_term(large).function(render, batch, no_params()) == 0
    with pytest.raises(InputError, match="aspect ratio"):
        depth_term(large[:, :, :7]).function(render, batch, no_params())


def depths(depth):
    """Return a render of this depth."""
    empty = gsjax.Render(*(None,) * 7)
    return empty._replace(depth=depth, alpha=jnp.ones_like(depth))


def no_params() -> SceneParams:
    return SceneParams(rough_start(0, 64), None, None)


@pytest.mark.parametrize(
    ("targets", "options", "match"),
    [
        ([], {}, "each view"),
        ([np.ones(3)], {}, r"targets\[0\]: expected real numbers of shape \[H, W\]"),
        ([np.ones((2, 2)), np.ones((2, 2), complex)], {}, r"targets\[1\]"),
        ([np.ones((2, 2))], {"hit_weight": -1.0}, "hit_weight"),
        ([np.ones((2, 2))], {"hit_weight": np.nan}, "hit_weight"),
    ],
)
def test_wrong_images_are_rejected(targets, options, match):
    with pytest.raises(InputError, match=match):
        depth_term(targets, **options)
