"""The C++ compositor of the benchmarks against a float64 brute-force compositor."""

import shutil
import sys
from pathlib import Path

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


def composite(means2d, conics, opacities, colors, depths):
    """Composite all splats of finite depth, in order of depth, in float64.

    Returns:
      image [H, W, 3], transmittance [H, W], unclamped α [n, H, W].
    """
    order = np.argsort(depths, kind="stable")
    order = order[np.isfinite(depths[order])]
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    image, trans = np.zeros((HEIGHT, WIDTH, 3)), np.ones((HEIGHT, WIDTH))
    raws = []
    for i in order:
        dx, dy = means2d[i, 0] - x, means2d[i, 1] - y
        a, b, c = conics[i]
        sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
        raw = opacities[i] * np.exp(-sigma)
        raws.append(raw)
        alpha = np.where((sigma < 0) | (raw < 1 / 255), 0.0, np.minimum(0.99, raw))
        image += (alpha * trans)[..., None] * colors[i]
        trans = trans * (1 - alpha)
    return image + trans[..., None] * BACKGROUND, trans, np.array(raws)


def regions(raw):
    """Return the side of the two thresholds that each α lies on."""
    return np.digitize(raw, [1 / 255, 0.99])


def in_float64(scene):
    return {name: value.astype(np.float64) for name, value in scene.items()}


def compositor_inputs(scene, tile_size=16):
    """Return the arguments of the compositor up to the background."""
    ranges, ids = yardstick.exact_lists(
        *(scene[name] for name in (*NAMES[:3], "depths")), WIDTH, HEIGHT, tile_size
    )
    arrays = [scene[name] for name in NAMES]
    return (*arrays, ranges, ids, WIDTH, HEIGHT, BACKGROUND)


@needs_compiler
@pytest.mark.parametrize(("tile_size", "threads"), [(8, 1), (16, 2)])
def test_forward(tile_size, threads):
    scene = make_scene()
    expected, trans, raw = composite(**in_float64(scene))
    # No α crosses the threshold by rounding to float32.
    assert np.abs(raw * 255 - 1).min() > 1e-5
    got = yardstick.forward(
        *compositor_inputs(scene, tile_size), tile_size=tile_size, threads=threads
    )
    np.testing.assert_allclose(got[0], expected, rtol=0, atol=2e-5)
    np.testing.assert_allclose(got[1], trans, rtol=0, atol=2e-5)


@needs_compiler
@pytest.mark.parametrize(("tile_size", "by_pixel"), [(8, True), (16, False)])
def test_backward(tile_size, by_pixel):
    scene = make_scene()
    rng = np.random.default_rng(0)
    v_image = rng.normal(size=(HEIGHT, WIDTH, 3)).astype(np.float32)
    v_alpha = rng.normal(size=(HEIGHT, WIDTH)).astype(np.float32)
    inputs = compositor_inputs(scene, tile_size)
    image, trans, grads = yardstick.forward_backward(
        *inputs, v_image, v_alpha, tile_size=tile_size, by_pixel=by_pixel
    )
    alone = yardstick.forward(*inputs, tile_size=tile_size)
    np.testing.assert_array_equal(image, alone[0])
    np.testing.assert_array_equal(trans, alone[1])

    def loss(point):
        image, trans, raw = composite(**point)
        return (v_image * image).sum() + (v_alpha * (1 - trans)).sum(), regions(raw)

    point, eps = in_float64(scene), 1e-7
    assert regions(composite(**point)[2]).max() == 2, "some α are clamped"
    step = {"means2d": 1.0, "conics": 0.1, "opacities": 1.0, "colors": 1.0}
    for name in NAMES:
        assert grads[name].shape == scene[name].shape
        for _ in range(2):
            direction = step[name] * rng.normal(size=scene[name].shape)
            # Partly aligned with the gradient, so that the derivative is not near 0.
            direction *= np.where(rng.random(direction.shape) < 0.7, 1, -1) * np.sign(
                direction * grads[name]
            )
            high, in_high = loss(point | {name: point[name] + eps * direction})
            low, in_low = loss(point | {name: point[name] - eps * direction})
            assert (in_high == in_low).all(), "no threshold is crossed"
            numeric = (high - low) / (2 * eps)
            np.testing.assert_allclose(
                (grads[name] * direction).sum(), numeric, rtol=2e-3
            )


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
