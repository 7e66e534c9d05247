"""The C++ compositor of the benchmarks against a float64 brute-force compositor."""

import shutil
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

# Behind the tests, of which some share a name with a benchmark.
sys.path.append(str(Path(__file__).resolve().parents[2] / "benchmarks"))

import yardstick

needs_compiler = pytest.mark.skipif(
    shutil.which("g++") is None, reason="the C++ yardstick needs g++, not found"
)

WIDTH, HEIGHT = 50, 37
BACKGROUND = np.array([0.1, 0.4, 0.7], np.float32)
NAMES = ("means2d", "conics", "opacities", "colors")


def make_scene(count=200):
    """Return splats with ties in depth, clamped α, and some that must be left out."""
    scene = yardstick.random_splats(count, WIDTH, HEIGHT, seed=3, scale=4.0)
    scene["depths"][10:30] = 5.0
    scene["opacities"][30:40] = 1.0
    scene["opacities"][40:45] = 1 / 300
    scene["depths"][45:50] = np.inf
    return scene


@jax.jit
def composite(splats):
    """Composite splats in the order given, in float64.

    Returns:
      image [H, W, 3], transmittance [H, W], unclamped α [n, H, W].
    """
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5

    def add(behind, splat):
        image, trans = behind
        mean, (a, b, c), opacity, color = splat
        dx, dy = mean[0] - x, mean[1] - y
        sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
        raw = opacity * jnp.exp(-sigma)
        alpha = jnp.where((sigma < 0) | (raw < 1 / 255), 0, jnp.minimum(0.99, raw))
        image += (alpha * trans)[..., None] * color
        return (image, trans * (1 - alpha)), raw

    nothing = jnp.zeros((HEIGHT, WIDTH, 3)), jnp.ones((HEIGHT, WIDTH))
    (image, trans), raw = jax.lax.scan(add, nothing, splats)
    return image + trans[..., None] * BACKGROUND, trans, raw


def compositor_inputs(scene, tile_size=16):
    """Return the arguments of the compositor up to the background."""
    ranges, ids = yardstick.exact_lists(
        *(scene[name] for name in (*NAMES[:3], "depths")), WIDTH, HEIGHT, tile_size
    )
    arrays = [scene[name] for name in NAMES]
    return (*arrays, ranges, ids, WIDTH, HEIGHT, BACKGROUND)


@needs_compiler
@pytest.mark.parametrize(
    ("tile_size", "threads", "by_pixel"), [(8, 1, True), (16, 2, False)]
)
def test_images_and_gradients(tile_size, threads, by_pixel):
    scene = make_scene()
    weights = np.random.default_rng(0).normal(size=(HEIGHT, WIDTH, 4))
    weights = weights.astype(np.float32)
    order = np.argsort(scene["depths"], kind="stable")
    order = order[np.isfinite(scene["depths"][order])]

    def loss(splats):
        image, trans, raw = composite(splats)
        whole = jnp.concatenate([image, 1 - trans[..., None]], -1)
        return jnp.sum(weights * whole), (image, trans, raw)

    splats = [jnp.asarray(scene[name][order], jnp.float64) for name in NAMES]
    slopes, (*images, raw) = jax.grad(loss, has_aux=True)(splats)
    assert raw.max() > 0.99, "some α are clamped"
    for threshold in (1 / 255, 0.99):  # none is crossed by rounding to float32
        assert np.abs(raw / threshold - 1).min() > 1e-6
    inputs = compositor_inputs(scene, tile_size)
    *found, grads = yardstick.forward_backward(
        *inputs, weights[..., :3], weights[..., 3],
        tile_size=tile_size, threads=threads, by_pixel=by_pixel,
    )  # fmt: skip
    alone = yardstick.forward(*inputs, tile_size=tile_size, threads=threads)
    for one, same, wanted in zip(found, alone, images, strict=True):
        np.testing.assert_array_equal(one, same)
        np.testing.assert_allclose(one, wanted, rtol=0, atol=2e-5)
    for name, slope in zip(NAMES, slopes):
        wanted = np.zeros(scene[name].shape)
        wanted[order] = slope
        error = np.linalg.norm(grads[name] - wanted)
        assert error < 1e-4 * np.linalg.norm(wanted)


@needs_compiler
def test_gradients_behind_vanishing_transmittance():
    """Behind 40 opaque splats T underflows; gradients of the first stay right."""
    count = 40
    scene = {
        "means2d": np.full((count, 2), 8.0, np.float32),
        "conics": np.tile(np.float32([1e-9, 0, 1e-9]), (count, 1)),
        "opacities": np.full(count, 0.98, np.float32),
        "colors": np.ones((count, 3), np.float32),
        "depths": np.arange(count, dtype=np.float32),
    }
    images = np.ones((HEIGHT, WIDTH, 3)), np.zeros((HEIGHT, WIDTH))
    grads = yardstick.forward_backward(*compositor_inputs(scene), *images)[2]
    expected = WIDTH * HEIGHT * 0.98 * 0.02 ** np.arange(8.0)
    np.testing.assert_allclose(grads["colors"][:8, 0], expected, rtol=1e-3)
    assert all(np.isfinite(g).all() for g in grads.values())


@needs_compiler
def test_an_empty_scene_and_errors():
    scene = {name: value[:0] for name, value in make_scene().items()}
    inputs = compositor_inputs(scene)
    image, trans = yardstick.forward(*inputs)
    assert (trans == 1).all()
    assert (image == BACKGROUND).all()
    for tile_size, message in ((12, "tile_size"), (8, "shape")):
        with pytest.raises(ValueError, match=message):
            yardstick.forward(*inputs, tile_size=tile_size)
