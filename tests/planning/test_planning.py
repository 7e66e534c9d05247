"""Plans: the error stays within the budget, and bounds hold."""

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import LIGHT, camera_of, cast, frustum_points, gaussians_at

import gsjax
from gsjax import RasterConfig
from gsjax.bench.pixelwise import composite_dense
from gsjax.cli.options import parse_budget
from gsjax.errors import InputError
from gsjax.math.sh import sh_basis
from gsjax.planning import bounds
from gsjax.planning.plan import trim_scene
from gsjax.raster.exact import count_demand
from gsjax.runs.scene_source import SceneSource
from gsjax.runs.views import prepare_render

SIZE, BUDGET, BEHIND = 32, 1 / 255, (0.2, 0.5, 0.9)
CONFIG = RasterConfig(**LIGHT, outputs=("rgb",))
PIXELS = np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE)), -1).reshape(-1, 2)


def cameras(count, seed):
    """Cameras near (0, 0, 0) that look along z."""
    rng = np.random.default_rng(seed)
    views = []
    for _ in range(count):
        eye, target = rng.uniform(-0.4, 0.4, (2, 3))
        view = gsjax.look_at(eye, target + (0, 0, 5), (0, -1, 0))
        views.append(camera_of(SIZE, SIZE, view, centre=(16, 16)))
    return views


def fog(count=500, opacity=(0.002, 0.02), degree=0):
    rng = np.random.default_rng(5)
    points, opacities = frustum_points(rng, count), rng.uniform(*opacity, count)
    scales = rng.uniform(0.3, 1.5, (count, 3))
    return gaussians_at(points, scales, opacities, viewmat=np.eye(4), degree=degree)


def with_sh(gaussians, sh):
    return gaussians.replace(params=gaussians.params.replace(sh=sh))


def largest_error(gaussians, made, views):
    """Return the largest error of the plan against the image without cutoffs."""
    errors, behind = [], jnp.asarray(BEHIND)
    for view in views:
        wanted = composite_dense(gaussians, view, BEHIND, PIXELS).rgb
        found = gsjax.render_exact(made.gaussians, view, made.config, behind)
        assert wanted.std() > 0.005
        errors.append(float(jnp.abs(found.rgb.reshape(-1, 3) - wanted).max()))
    return max(errors)


def reason(made, what):
    return next(r for r in made.reasons if r.what == what)


def planned(gaussians, views, **options):
    return gsjax.plan(gaussians, views, config=CONFIG, background=BEHIND, **options)


def test_the_budget_holds_on_other_cameras_and_capacities_fit(report):
    """Of a batch of many cameras, 12 are measured."""
    scene, views = fog(), cameras(30, 0)
    made = planned(scene, gsjax.stack_cameras(views), budget=BUDGET)
    error = largest_error(scene, made, cameras(4, 1))
    report("fog", error, BUDGET)
    assert 0.05 * BUDGET < error <= BUDGET
    assert made.error <= BUDGET
    assert made.error == pytest.approx(sum(r.error for r in made.reasons))
    # The default cutoff would not do, and the chosen one is no finer than necessary.
    assert made.config.alpha_min < 1 / 255
    assert made.measured > 0.1 * BUDGET
    assert reason(made, "alpha_min").basis == "estimate"
    assert not made.bounded
    assert len(made.lines()) == len(made.reasons) + 1
    unlimited = made.config.replace(visible_capacity=None)
    measured = [views[i] for i in np.linspace(0, 29, 12).astype(int)]
    found = [count_demand(made.gaussians, view, unlimited) for view in measured]
    pairs = max(int(demand.capacity) for demand in found)
    assert pairs <= made.config.pair_capacity <= 1.3 * pairs + 256
    visible = max(int(demand.visible) for demand in found)
    assert visible <= made.config.visible_capacity <= 1.3 * visible + 256


def test_a_traced_cutoff_gives_the_image_of_a_static_one():
    scene, (view,), behind = fog(), cameras(1, 2), jnp.asarray(BEHIND)
    fine, coarse = (
        gsjax.render_exact(scene, view, CONFIG, behind, alpha_min=jnp.asarray(cutoff))
        for cutoff in (1e-5, 0.01)
    )
    static = gsjax.render_exact(scene, view, CONFIG.replace(alpha_min=0.01), behind)
    np.testing.assert_allclose(coarse.rgb, static.rgb, rtol=0, atol=1e-12)
    assert int(coarse.demand.capacity) == int(static.demand.capacity)
    assert float(jnp.abs(coarse.rgb - fine.rgb).max()) > 0.01


def test_one_gaussian_has_a_bound_for_every_camera(capsys):
    """`gsjax render --budget` uses the plan, and prints it."""
    scene = gaussians_at([[0, 0, 4]], 0.5, 0.7, viewmat=np.eye(4), degree=0)
    scene = gsjax.grow(scene, 9)
    made = planned(scene, cameras(1, 0)[0], budget=0.05)
    assert made.bounded
    assert made.measured is None
    assert made.gaussians.capacity == 1
    assert largest_error(scene, made, cameras(2, 1)) <= made.error <= 0.05
    source = SceneSource(lambda: scene, CONFIG, BEHIND, budget=0.05)
    found, config = prepare_render(source, cameras(1, 0), ("rgb",))
    assert (found.capacity, config) == (1, made.config)
    printed = capsys.readouterr().err.splitlines()
    assert printed == [f"gsjax: {line}" for line in made.lines()]


def test_without_a_budget_only_what_is_invisible_goes():
    """Bands that are 0, Gaussians below the cutoff, slots; so does `gsjax render`."""
    rng, behind = np.random.default_rng(0), jnp.asarray(BEHIND)
    points = np.column_stack([rng.uniform(-1, 1, (6, 2)), rng.uniform(3, 5, 6)])
    scene = gaussians_at(points, 0.5, [0.7, 0.6, 0.5, 1e-3, 0.4, 1e-4], degree=3)
    scene = gsjax.grow(with_sh(scene, scene.params.sh.at[:, 4:].set(0)), 9)
    (view,) = cameras(1, 0)
    made = planned(scene, view)
    assert made.error == 0
    free = dict.fromkeys(("pair_capacity", "visible_capacity"))
    assert made.config.replace(**free) == CONFIG.replace(**free)
    source = SceneSource(lambda: scene, CONFIG, BEHIND)
    trimmed, config = prepare_render(source, [view], ("rgb",))
    assert config == CONFIG
    whole = gsjax.render_exact(scene, view, CONFIG, behind).rgb
    assert float(whole.std()) > 0.02
    for found, config in ((trimmed, CONFIG), (made.gaussians, made.config)):
        assert (found.capacity, found.sh_degree) == (4, 1)
        some = gsjax.render_exact(found, view, config, behind).rgb
        np.testing.assert_allclose(some, whole, atol=1e-14)
    # One non-zero coefficient of one Gaussian keeps all bands.
    full = gaussians_at(points[:3], 0.5, [0.7, 0.6, 0.5], degree=3)
    full = with_sh(full, full.params.sh.at[:, 1:].set(0).at[2, 15, 1].set(1e-9))
    found = trim_scene(full, CONFIG)
    assert (found.capacity, found.sh_degree) == (3, 3)


@pytest.mark.parametrize(("size", "degree"), [(1e-5, 1), (0.3, 2)])
def test_bands_are_left_out_if_their_bound_is_within_the_budget(size, degree):
    scene = gaussians_at([[0, 0, 4]], 0.5, 0.7, degree=2)
    scene = with_sh(scene, scene.params.sh.at[:, 4:].mul(size))
    made = planned(scene, cameras(1, 0), budget=0.05)
    assert made.gaussians.sh_degree == degree
    assert reason(made, "SH degree").error <= 0.05 / 4


@pytest.mark.parametrize("left", [0, 1])
def test_the_bound_of_bands_holds_and_is_attained(left):
    """One opaque splat, seen from where its bands are largest."""
    direction = np.array([0.6, -0.48, 0.64])
    basis = np.array(sh_basis(2, *direction), float)
    scene = gaussians_at([4 * direction], 1.0, 1 - 1e-9, degree=2)
    sh = np.broadcast_to(0.2 * basis[:, None], (1, 9, 3))
    scene = with_sh(scene, jnp.asarray(sh))
    change = 0.2 * np.sum(basis[(left + 1) ** 2 :] ** 2)
    bound = bounds.degree_error(scene, left)
    assert 0.99 * bound < change <= bound * (1 + 1e-6)
    # Another direction shows less, and so does a fainter splat.
    assert np.sum(basis * sh_basis(2, 1.0, 0.0, 0.0)) < np.sum(basis**2)
    faint = scene.params.replace(logit_opacities=jnp.zeros(1))
    assert bounds.degree_error(scene.replace(params=faint), left) == pytest.approx(
        bound / 2
    )


def blend(alpha, colors, stop=0.0, rule="after"):
    """Blend α [N, P] and colours [N] over the background 0.9."""
    after = np.cumprod(1 - alpha, axis=0)
    before = np.concatenate([np.ones_like(after[:1]), after[:-1]])
    weight = alpha * before * ((after if rule == "before" else before) > stop)
    return colors @ weight + (1 - weight.sum(axis=0)) * 0.9


def test_bounds_of_the_cutoffs_hold_and_are_not_loose():
    rng = np.random.default_rng(3)
    count, pixels = 30, 4000
    opacity = rng.beta(0.5, 1, count)
    scene = gaussians_at(np.ones((count, 3)), 1.0, opacity, degree=0)
    opacity = bounds.opacities(scene)
    alpha = opacity[:, None] * rng.random((count, pixels)) ** rng.choice([0.01, 1, 4])
    colors = rng.random(count)
    exact = blend(alpha, colors)
    cut, capped = np.where(alpha < 0.02, 0, alpha), np.minimum(alpha, 0.6)
    after, before = {"stop": 0.1}, {"stop": 0.1, "rule": "before"}
    for changed, options, bound in (
        (cut, {}, bounds.alpha_min_error(scene, 0.02, 1)),
        (capped, {}, bounds.alpha_max_error(0.6, 1)),
        (alpha, after, bounds.stop_error(0.1, "after", 1, 1)),
        (alpha, before, bounds.stop_error(0.1, "before", opacity.max(), 1)),
    ):
        error = np.abs(blend(changed, colors, **options) - exact).max()
        assert 0.02 * bound < error <= bound


def test_many_splats_below_the_accurate_cutoff_count():
    """Each is below 1e-5, but together they are a fog."""
    scene = fog(400, opacity=(4e-6, 8e-6))
    made = planned(scene, cameras(1, 0), budget=1e-3)
    assert made.config.alpha_min < 8e-6
    assert made.error <= 1e-3


def test_an_empty_scene():
    scene = gsjax.select(fog(20), jnp.zeros(20, bool))
    made = planned(scene, cameras(1, 0), budget=BUDGET)
    assert made.gaussians.capacity == 1
    assert int(gsjax.num_active(made.gaussians)) == 0
    assert (made.error, made.measured) == (0, None)


@pytest.mark.parametrize(("band", "value"), [(1, jnp.nan), (0, 1e33)])
def test_invalid_gaussians_stay_out(band, value):
    """A NaN in a band that is left out does not bring the Gaussian back."""
    scene = gsjax.with_sh_degree(fog(20, opacity=(0.3, 0.9)), 1)
    scene = with_sh(scene, scene.params.sh.at[3, band].set(value))
    made = planned(scene, cameras(1, 0), outputs=("depth",))
    assert made.gaussians.sh_degree == 0
    assert made.gaussians.capacity == 19
    assert made.config.outputs == ("depth",)


def too_bright():
    scene = fog(20)
    return with_sh(scene, scene.params.sh.at[5, 0].set(1e4))


@pytest.mark.parametrize(
    ("scene", "views", "budget", "message"),
    [
        (fog, 0, None, "at least one camera"),
        *((fog, 1, budget, "above 0") for budget in (0.0, -1.0, np.nan, np.inf)),
        (lambda: cast(fog(20), jnp.float32), 1, 1e-5, "float32"),
        (too_bright, 1, 1e-3, r"colour range of 2\.82e\+03"),
    ],
)
def test_errors(scene, views, budget, message):
    with pytest.raises(InputError, match=message):
        planned(scene(), cameras(views, 0), budget=budget)


def test_budgets_are_parsed():
    for text, value in (("1/255", 1 / 255), ("0.004", 0.004), ("2e-3", 2e-3)):
        assert parse_budget(text) == pytest.approx(value)
    for bad in ("", "0", "-1", "1/0", "1/", "a", "nan", "1e999/1"):
        with pytest.raises(ValueError, match="above 0"):
            parse_budget(bad)


def test_a_window_is_widened_or_sorted_exactly():
    """Large Gaussians that cut each other: a budget decides."""
    rng, views = np.random.default_rng(3), cameras(1, 0)
    gaussians = gaussians_at(
        frustum_points(rng, 40), rng.uniform(0.3, 1.5, (40, 3)), 0.6,
        viewmat=np.eye(4), degree=0,
    )  # fmt: skip
    config = CONFIG.replace(order="window", order_window=1)
    loose = gsjax.plan(gaussians, views, budget=0.9, config=config)
    assert loose.config.order_window == 1
    assert 0 < reason(loose, "order").error < 0.45
    exact = gsjax.plan(gaussians, views, budget=BUDGET, config=config)
    assert exact.config.order == "pixel"
    assert "errs by" in reason(exact, "order").why
    plain = gsjax.plan(gaussians, views, config=config)
    assert plain.config.order_window == 1
