"""`gsjax bench`: error bounds at pixels, the Pareto front, the plot, the scenes."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import camera_of, frustum_points, gaussians_at

import gsjax
from gsjax import RasterConfig
from gsjax.bench.pareto import Point, front, make_points, measure_points
from gsjax.bench.pixelwise import (
    Dense,
    composite_dense,
    error_bound,
    in_ray_order,
    order_bound,
    ray_depths,
)
from gsjax.bench.report import front_figure, front_picture, table
from gsjax.bench.scales import (
    FILTERS,
    ScaleRow,
    scaled_camera,
    scales_figure,
    scales_table,
    true_image,
)
from gsjax.bench.scenes import facing_camera, open_bench_scene
from gsjax.errors import InputError
from gsjax.synthetic.stress_scenes import STRESS_SCENES, StressScene

BEHIND = np.array([0.2, 0.5, 0.9])
COUNT, SIZE = 60, 16
PIXELS = np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE)), -1).reshape(-1, 2)
EXACT = RasterConfig(
    alpha_min=1e-12, alpha_max=1.0, transmittance_min=0.0, stop_rule="after"
)
# Each changed so far that the image changes visibly.
CHANGED = {
    "alpha_min": EXACT.replace(alpha_min=0.05),
    "alpha_max": EXACT.replace(alpha_max=0.7),
    "after": EXACT.replace(transmittance_min=0.05),
    "before": EXACT.replace(transmittance_min=0.02, stop_rule="before", alpha_max=0.9),
    "all": EXACT.replace(alpha_min=0.02, alpha_max=0.9, transmittance_min=0.05),
}


@pytest.fixture(scope="module")
def view():
    rng = np.random.default_rng(4)
    points = frustum_points(rng, COUNT)
    scene = gaussians_at(
        points, rng.uniform(0.1, 1, (COUNT, 3)), rng.beta(1, 1, COUNT),
        viewmat=np.eye(4), degree=1,
    )  # fmt: skip
    camera = camera_of(SIZE, SIZE, np.eye(4), centre=(8, 8))
    return scene, camera, composite_dense(scene, camera, BEHIND, PIXELS)


def blend(found: Dense, config: RasterConfig) -> np.ndarray:
    """Blend by the rules of the config, [P, 3]."""
    alpha = np.minimum(found.alpha, config.alpha_max)
    alpha = np.where(alpha < config.alpha_min, 0, alpha)
    behind = np.cumprod(1 - alpha, axis=0)
    before = np.concatenate([np.ones_like(behind[:1]), behind[:-1]])
    tested = behind if config.stop_rule == "before" else before
    weights = np.where(tested > config.transmittance_min, alpha * before, 0)
    return weights.T @ found.colors + np.outer(1 - weights.sum(0), BEHIND)


def bound_of(view, config, degree=1):
    scene, camera, found = view
    return error_bound(found, scene, camera, config, degree)


def test_the_dense_image_is_the_reference(view):
    scene, camera, found = view
    wanted = np.asarray(gsjax.reference_render(scene, camera, None, BEHIND)["rgb"])
    np.testing.assert_allclose(found.rgb, wanted.reshape(-1, 3), atol=1e-12)
    assert found.rgb.std() > 0.05


@pytest.mark.parametrize("name", CHANGED)
def test_the_bound_of_a_setting_holds_at_every_pixel(view, name):
    error = np.abs(blend(view[2], CHANGED[name]) - view[2].rgb).max(axis=1)
    bound = bound_of(view, CHANGED[name])
    assert (error <= bound).all()
    assert error.max() > 0.01
    assert (error / bound).max() > 0.1, "the bound is not loose"
    assert bound_of(view, EXACT).max() < 1e-7


def test_the_bound_of_bands_holds(view):
    scene, camera, found = view
    fewer = gsjax.with_sh_degree(scene, 0)
    without = composite_dense(fewer, camera, BEHIND, PIXELS).rgb
    error = np.abs(without - found.rgb).max(axis=1)
    assert (error <= bound_of(view, EXACT, degree=0)).all()
    assert error.max() > 0.005


def test_the_bound_of_orders_holds(view):
    scene, camera, found = view
    keys = ray_depths(found, scene, camera, PIXELS)
    exact = in_ray_order(found, keys, BEHIND)
    assert order_bound(found, keys, EXACT.replace(order="pixel")).max() == 0
    for order in ("center", "window"):
        config = EXACT.replace(order=order)
        rgb = gsjax.render(scene, camera, config, jnp.asarray(BEHIND)).rgb
        error = np.abs(np.asarray(rgb).reshape(-1, 3) - exact).max(axis=1)
        bound = order_bound(found, keys, config) + 1e-12
        assert (error <= bound).all()
        assert error.max() > 0.005
        assert (error / bound).max() > 0.1, "the bound is not loose"


@pytest.mark.parametrize("behind", [BEHIND, np.zeros(3)])
def test_the_background_may_be_rounded(view, behind):
    scene, camera, _ = view
    found = composite_dense(scene, camera, behind, np.array([[10**4, 10**4]]))
    np.testing.assert_array_equal(found.rgb, [behind])
    error = np.abs(np.float32(behind) - behind).max()
    bound = error_bound(found, scene, camera, EXACT, double=False)
    assert error <= bound <= 1e-3
    assert (error > 0) == behind.any()


def row(ms: float, error: float, knob: str = "cut") -> dict:
    return {
        "scene": "x", "knob": knob, "value": "1", "forward ms": ms, "gradient ms": 3.0,
        "max": error, "psnr": 50.0, "gradient": error, "at worst": error,
        "bound": 2 * error, "inside": True,
    }  # fmt: skip


def test_no_row_beats_the_front():
    rows = [row(3, 1e-3), row(1, 1e-1), row(2, 1e-2), row(2.5, 2e-2), row(9, 1e-3)]
    assert front(rows) == [1, 2, 0]
    hardly = {**rows[0], "forward ms": 9.0, "max": 0.999 * rows[0]["max"]}
    assert front([*rows, hardly]) == [1, 2, 0], "0.1 % is not worth the time"


def test_rows_and_fronts_of_all_devices_reach_the_figure():
    mine = [row(30, 1e-1), row(20, 1e-2), row(40, 0.0)]
    other = [row(1, 1e-1), row(3, 1e-1, "slower"), row(2, 1e-2)]
    axes = front_figure(mine, "x", [("chip", other)]).axes[0]
    fronts = {line.get_label(): line.get_xdata().tolist() for line in axes.lines}
    assert fronts == {"front": [20, 40], "chip": [1, 2]}
    (dots,) = axes.collections
    np.testing.assert_allclose(dots.get_offsets(), [[30, 0.1], [20, 0.01], [40, 1e-8]])
    # Any rows give a picture and a table, which marks those beyond their bound.
    outside = row(1, np.nan) | {"inside": False}
    for rows in ([], [outside, *[row(1, 1e-3, "w" * 90)] * 9]):
        picture = front_picture(rows, "$x")
        assert picture.dtype == np.uint8
        assert picture.shape == (1120, 860, 3)
        assert table(rows, front(rows)).count("OUTSIDE") == bool(rows)


@pytest.mark.parametrize("name", STRESS_SCENES)
def test_built_in_scenes(name):
    scene = open_bench_scene(name)
    assert scene.name == name
    assert scene.gaussians.capacity > 1000
    leaves = jax.tree.leaves(scene.gaussians)
    assert all(np.isfinite(leaf).all() for leaf in leaves)
    sized = open_bench_scene(name, size=(40, 30)).camera
    assert (sized.width, sized.height) == (40, 30)
    knobs = {point.knob for point in make_points(scene.gaussians)}
    assert knobs >= {"cut", "tile", "dtype"}


def test_scaled_cameras_show_the_same_scene(view):
    """Below 1 the whole view in a corner, above 1 its middle; the size is the same."""
    _, camera, _ = view
    x, y, z = 0.02, -0.03, 1.0
    u, v = (float(a) for a in camera.project((x, y, z)))
    for scale, shift in ((0.5, 0), (1.0, 0), (4.0, 24)):
        found = scaled_camera(camera, scale, samples=3)
        assert (found.width, found.height) == (3 * SIZE, 3 * SIZE)
        assert [*found.visible_size] == [3 * SIZE * min(scale, 1)] * 2
        at = np.asarray(found.project((x, y, z)))
        np.testing.assert_allclose(at, 3 * (scale * np.asarray([u, v]) - shift), 1e-9)


def test_the_truth_of_a_scale_is_the_mean_over_each_pixel(view):
    """Against 20 × 20 samples of the dense reference, without any filter."""
    gaussians, camera, _ = view
    scene = StressScene("some", gaussians, camera, tuple(BEHIND))
    K = np.diag([10, 10, 1]) @ camera.K
    fine = camera.replace(K=K, width=10 * SIZE, height=10 * SIZE)
    image = gsjax.reference_render(gaussians, fine, None, BEHIND, dilation=1e-6)
    blocks = np.asarray(image["rgb"]).reshape(SIZE // 2, 20, SIZE // 2, 20, 3)
    found = true_image(scene, 0.5)
    np.testing.assert_allclose(found, blocks.mean((1, 3)), atol=3e-3)


def test_rows_of_scales_reach_table_and_figure():
    rows = [
        ScaleRow(scale, name, 30 + scale, 0.1, 1.0, 60.0)
        for scale in (0.25, 4.0)
        for name in FILTERS
    ]
    assert "1/4" in scales_table(rows)
    above, _ = scales_figure(rows, "a $ name").axes
    assert [line.get_label() for line in above.lines] == [*FILTERS]
    np.testing.assert_array_equal(above.lines[0].get_ydata(), [30.25, 34])


def test_a_facing_camera_looks_at_the_scene(view):
    scene = view[0]
    camera = facing_camera(scene, 40, 30)
    middle = np.median(np.asarray(scene.params.means), axis=0)
    seen = np.asarray(camera.viewmat) @ np.append(middle, 1)
    np.testing.assert_allclose(seen[:2], 0, atol=1e-5)
    assert seen[2] > 0
    with pytest.raises(InputError, match="expected an active Gaussian"):
        facing_camera(gsjax.select(scene, jnp.zeros(COUNT, bool)), 40, 30)


@pytest.mark.long
def test_a_point_is_measured(view):
    """Times, errors, bounds and gradient of one point against the exact image."""
    scene, camera, _ = view
    small = StressScene("small", scene, camera, tuple(BEHIND))
    sizes = {"num_size_buckets": 1, "devices": 1, "pair_capacity": 2048}
    config = RasterConfig.compat(outputs=("rgb",), **sizes)
    sorts = config.replace(order="window")
    points = [Point("compat", "", config, double=True)]
    points.append(Point("order", "window 2", sorts, double=True, sorted=True))
    found, by_window = measure_points(small, points, repeats=1)
    assert found["inside"]
    assert by_window["inside"]
    assert by_window["max"] > 1e-3
    assert 1e-5 < found["max"] < 0.05
    assert found["at worst"] <= found["bound"]
    assert 1e-6 < found["gradient"] < 0.1
    assert 0 < found["forward ms"] < found["gradient ms"] * 10
    json.dumps(found)
