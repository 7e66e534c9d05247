"""Plans: what they leave out does not show, and the reasons add up."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import LIGHT, camera_of, frustum_points, gaussians_at

import gsjax
from gsjax import RasterConfig
from gsjax.cli.options import parse_budget
from gsjax.errors import InputError
from gsjax.math.sh import sh_basis
from gsjax.planning import accuracy, bounds
from gsjax.planning import plan as planning
from gsjax.raster import render as render_module
from gsjax.raster.exact import count_demand
from gsjax.raster.render import render_at_cut
from gsjax.runs.scene_source import SceneSource
from gsjax.runs.views import prepare_render

SIZE, BUDGET, BEHIND = 32, 1 / 255, (0.2, 0.5, 0.9)
CONFIG = RasterConfig(**LIGHT, outputs=("rgb",))
EXACT = RasterConfig.accurate(**LIGHT, outputs=("rgb",), alpha_min=1e-7, transmittance_min=1e-7)


def looking(count, seed):
    """Cameras at about (0, 0, 0) that look along z, a little off each."""
    rng = np.random.default_rng(seed)
    views = []
    for _ in range(count):
        eye, target = rng.uniform(-0.4, 0.4, (2, 3))
        target = target + (0, 0, 5)
        view = gsjax.look_at(eye, target, (0, -1, 0))
        views.append(camera_of(SIZE, SIZE, view, centre=(16, 16)))
    return views


def fog(count=500, opacity=(0.002, 0.02), degree=0):
    rng = np.random.default_rng(5)
    points, opacities = frustum_points(rng, count), rng.uniform(*opacity, count)
    scales = rng.uniform(0.3, 1.5, (count, 3))
    return gaussians_at(points, scales, opacities, viewmat=np.eye(4), degree=degree)


def worst(gaussians, made, views):
    """Largest error of the plan against the exact picture of the scene itself."""
    errors = []
    for view in views:
        wanted = gsjax.render_exact(gaussians, view, EXACT, jnp.asarray(BEHIND)).rgb
        found = gsjax.render_exact(
            made.gaussians, view, made.config, jnp.asarray(BEHIND)
        )
        assert float(jnp.std(wanted)) > 0.005
        errors.append(float(jnp.abs(found.rgb - wanted).max()))
    return max(errors)


def reason(made, what):
    return next(r for r in made.reasons if r.what == what)


def planned(gaussians, views, **options):
    return gsjax.plan(gaussians, views, config=CONFIG, background=BEHIND, **options)


@pytest.fixture
def as_fitting(monkeypatch):
    """No programs are compiled to ask for capacities."""

    def fit(gaussians, _, config, __):
        return config.replace(visible_capacity=gaussians.capacity), []

    monkeypatch.setattr(planning, "with_capacities", fit)


@pytest.fixture(scope="module")
def foggy():
    scene = fog()
    return scene, planned(scene, looking(4, 0), budget=BUDGET)


def test_fog_keeps_its_budget_on_cameras_not_seen(foggy, report):
    scene, made = foggy
    error = worst(scene, made, looking(8, 1))
    report("fog", error, BUDGET)
    assert error <= BUDGET
    assert made.error <= BUDGET
    # The field's cut would not do, and what is chosen is no finer than need be.
    assert made.config.alpha_min < 1 / 255
    assert made.measured > 0.1 * BUDGET
    assert error > 0.05 * BUDGET
    assert reason(made, "alpha_min").basis == "estimate"
    assert not made.bounded


@pytest.mark.parametrize(
    ("platform", "config"), [("cpu", EXACT.replace(occlusion=True)), ("gpu", CONFIG)]
)
def test_one_program_draws_with_any_cut(platform, config, monkeypatch):
    """What it draws is what the cut's own program draws."""
    monkeypatch.setattr(jax, "default_backend", lambda: platform)
    scene = fog({"cpu": 300, "gpu": 310}[platform])  # each is traced by itself
    (view,), behind = looking(1, 2), jnp.asarray(BEHIND)
    before = render_module._at_cut_jit._cache_size()
    fine, coarse = (render_at_cut(scene, view, config, behind, c) for c in (1e-5, 0.01))
    assert render_module._at_cut_jit._cache_size() == before + 1
    wanted = gsjax.render_exact(scene, view, config.replace(alpha_min=0.01), behind)
    np.testing.assert_allclose(coarse.rgb, wanted.rgb, rtol=0, atol=1e-12)
    assert int(coarse.demand.capacity) == int(wanted.demand.capacity)
    assert float(jnp.abs(coarse.rgb - fine.rgb).max()) > 0.01


def test_a_plan_compiles_one_program_to_measure(foggy):
    """And none to ask for capacities: the pictures tell what they want."""
    scene, made = foggy
    before = render_module._at_cut_jit._cache_size(), _demands()
    again = planned(scene, looking(4, 0), budget=0.7 * BUDGET)
    assert again.config.alpha_min < made.config.alpha_min
    # Where it stops is another, and these splats want more room than most.
    assert render_module._at_cut_jit._cache_size() <= before[0] + 2
    assert _demands() == before[1]
    unlimited = again.config.replace(visible_capacity=None)
    views = looking(4, 0)
    counted = [count_demand(again.gaussians, view, unlimited) for view in views]
    pairs = max(int(demand.capacity) for demand in counted)
    assert f"views ask for {pairs:,} at most" in reason(again, "pair_capacity").why
    seen = max(int(demand.visible) for demand in counted)
    assert f"at most {seen:,} are in" in reason(again, "visible_capacity").why


def _demands() -> int:
    return render_module._demand_jit._cache_size()


def test_reasons_add_up_and_are_told(foggy):
    _, made = foggy
    assert made.error == pytest.approx(sum(r.error for r in made.reasons))
    lines = made.lines()
    assert len(lines) == len(made.reasons) + 1
    for what in ("SH degree", "stop", "alpha_min", "capacity", "pair_capacity", "lens"):
        assert any(line.startswith(f"{what}: ") for line in lines)
    assert "of 1/255 allowed (estimate)" in lines[-1]
    assert "error" not in lines[-1], "the word that failures begin with"


@pytest.mark.usefixtures("as_fitting")
def test_one_gaussian_has_a_bound_for_every_camera():
    scene = gaussians_at([[0, 0, 4]], 0.5, 0.7, viewmat=np.eye(4), degree=0)
    scene = gsjax.grow(scene, 9)
    made = planned(scene, looking(1, 0)[0], budget=0.05)
    assert made.bounded
    assert made.measured is None
    assert made.gaussians.capacity == 1
    assert worst(scene, made, looking(2, 1)) <= made.error <= 0.05


@pytest.mark.usefixtures("as_fitting")
def test_without_a_budget_nothing_changes():
    scene = fog(200, opacity=(0.05, 0.9))
    padded = gsjax.grow(gsjax.with_sh_degree(scene, 3), 300)
    view = looking(1, 2)[0]
    made = planned(padded, view)
    assert (made.gaussians.sh_degree, made.gaussians.capacity) == (0, 200)
    assert made.error == 0
    same = ("alpha_min", "alpha_max", "transmittance_min", "stop_rule", "dilation", "antialias")
    assert all(getattr(made.config, n) == getattr(CONFIG, n) for n in same)
    wanted = gsjax.render_exact(padded, view, CONFIG).rgb
    found = gsjax.render_exact(made.gaussians, view, made.config)
    np.testing.assert_allclose(found.rgb, wanted, atol=1e-12)
    assert float(found.rgb.std()) > 0.02
    assert not found.overflowed


def test_bands_go_only_where_their_bound_is_within_the_budget():
    scene = fog(50, opacity=(0.3, 0.9), degree=2)
    for size, wanted in ((1e-5, 1), (0.3, 2)):
        sh = scene.params.sh.at[:, 4:].mul(size)
        made, told = planning._without_bands(
            scene.replace(params=scene.params.replace(sh=sh)), BUDGET
        )
        assert made.sh_degree == wanted
        assert told.error <= BUDGET / 4


@pytest.mark.parametrize("left", [0, 1])
def test_bound_of_bands_holds_and_is_reached(left):
    """One opaque splat, seen from where its bands are at their largest."""
    direction = np.array([0.6, -0.48, 0.64])
    basis = np.array(sh_basis(2, *direction), float)
    scene = gaussians_at([4 * direction], 1.0, 1 - 1e-9, degree=2)
    sh = np.broadcast_to(0.2 * basis[:, None], (1, 9, 3))
    scene = scene.replace(params=scene.params.replace(sh=jnp.asarray(sh)))
    change = 0.2 * np.sum(basis[(left + 1) ** 2 :] ** 2)
    bound = bounds.degree_error(scene, left)
    assert 0.99 * bound < change <= bound * (1 + 1e-6)
    # Another direction sees less, and a faint splat shows less.
    assert np.sum(basis * sh_basis(2, 1.0, 0.0, 0.0)) < np.sum(basis**2)
    faint = scene.params.replace(logit_opacities=jnp.zeros(1))
    assert bounds.degree_error(scene.replace(params=faint), left) == pytest.approx(
        bound / 2
    )


def blend(alpha, colors, stop=0.0, rule="after"):
    """Dense: α [N, P], colours [N]; over the background 0.9."""
    after = np.cumprod(1 - alpha, axis=0)
    before = np.concatenate([np.ones_like(after[:1]), after[:-1]])
    weight = alpha * before * ((after if rule == "before" else before) > stop)
    return colors @ weight + (1 - weight.sum(axis=0)) * 0.9


def test_bounds_hold_where_they_matter():
    """Of cut, cap and stop, each alone, over splats drawn at random."""
    rng = np.random.default_rng(3)
    count, pixels = 30, 4000
    opacity = rng.beta(0.5, 1, count)
    scene = gaussians_at(np.ones((count, 3)), 1.0, opacity, degree=0)
    opacity = bounds.opacities(scene)
    alpha = opacity[:, None] * rng.random((count, pixels)) ** rng.choice([0.01, 1, 4])
    colors = rng.random(count)
    exact = blend(alpha, colors)
    cases = {
        "cut": (np.where(alpha < 0.02, 0, alpha), {}, bounds.cut_error(scene, 0.02, 1)),
        "cap": (np.minimum(alpha, 0.6), {}, bounds.cap_error(0.6, 1)),
        "after": (alpha, {"stop": 0.1}, bounds.stop_error(0.1, "after", 1, 1)),
        "before": (
            alpha,
            {"stop": 0.1, "rule": "before"},
            bounds.stop_error(0.1, "before", opacity.max(), 1),
        ),
    }
    for name, (changed, options, bound) in cases.items():
        error = np.abs(blend(changed, colors, **options) - exact).max()
        assert 0.02 * bound < error <= bound, name


def test_faint_beyond_the_accurate_cut_are_not_overlooked():
    """Each below 1e-5, together a fog: the reference must go finer."""
    scene = fog(400, opacity=(4e-6, 8e-6))
    cut = accuracy._reference_cut(scene, 1.0, 1e-3)
    assert cut < 8e-6
    total = bounds.opacities(scene)
    assert total[total < cut].sum() <= 1e-4


@pytest.mark.usefixtures("as_fitting")
def test_an_empty_scene():
    scene = gsjax.select(fog(20), jnp.zeros(20, bool))
    made = planned(scene, looking(1, 0), budget=BUDGET)
    assert made.gaussians.capacity == 1
    assert int(gsjax.num_active(made.gaussians)) == 0
    assert (made.error, made.measured) == (0, None)


@pytest.mark.usefixtures("as_fitting")
def test_a_splat_that_is_not_drawn_does_not_come_back():
    """A NaN in a band keeps a splat out; without the band it still stays out."""
    scene = gsjax.with_sh_degree(fog(20, opacity=(0.3, 0.9)), 1)
    sh = scene.params.sh.at[3, 1].set(jnp.nan)
    scene = scene.replace(params=scene.params.replace(sh=sh))
    made = planned(scene, looking(1, 0))
    assert made.gaussians.sh_degree == 0
    assert made.gaussians.capacity == 19
    assert reason(made, "capacity").why.startswith("19 slots in place of 20")


def test_colours_too_far_apart_for_a_budget():
    """Where to stop and the cap alone are beyond it: said, and by how much."""
    scene = fog(20)
    sh = scene.params.sh.at[5, 0].set(1e4)
    bright = scene.replace(params=scene.params.replace(sh=sh))
    with pytest.raises(InputError, match=r"colours span 2\.82e\+03"):
        gsjax.plan(bright, looking(1, 0), budget=1e-3, config=CONFIG)


@pytest.mark.usefixtures("as_fitting")
def test_a_colour_that_counts_as_infinite_is_left_out():
    scene = fog(20, opacity=(0.3, 0.9))
    sh = scene.params.sh.at[3, 0].set(1e33)
    scene = scene.replace(params=scene.params.replace(sh=sh))
    assert planned(scene, looking(1, 0)).gaussians.capacity == 19


@pytest.mark.usefixtures("as_fitting")
def test_lens_and_outputs_are_those_asked_for():
    made = planned(fog(20, opacity=(0.3, 0.9)), looking(1, 0), outputs=("depth",))
    assert made.config.outputs == ("depth",)
    assert reason(made, "lens").why.startswith("pinhole")


def test_refusals():
    scene, view = fog(20), looking(1, 0)[0]
    with pytest.raises(InputError, match="no camera"):
        gsjax.plan(scene, [])
    for budget in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(InputError, match="above 0"):
            gsjax.plan(scene, view, budget=budget)
    single = jax.tree.map(lambda a: a.astype(jnp.float32), scene.params)
    with pytest.raises(InputError, match="float32"):
        gsjax.plan(scene.replace(params=single), view, budget=1e-5)


def test_batches_and_many_cameras_are_sampled_evenly():
    views = looking(30, 0)
    batch = gsjax.stack_cameras(views)
    chosen = planning._sampled(batch)
    assert len(chosen) == 12
    for found, place in zip((chosen[0], chosen[-1]), (0, 29)):
        np.testing.assert_array_equal(found.viewmat, views[place].viewmat)


# --- gsjax render --budget ---


@pytest.mark.parametrize(
    ("text", "value"), [("1/255", 1 / 255), ("0.004", 0.004), ("2e-3", 2e-3)]
)
def test_budgets_are_read(text, value):
    assert parse_budget(text) == pytest.approx(value)


@pytest.mark.parametrize("text", ["", "0", "-1", "1/0", "1/", "a", "nan", "1e999/1"])
def test_budgets_are_refused(text):
    with pytest.raises(ValueError, match="an error above 0"):
        parse_budget(text)


@pytest.mark.usefixtures("as_fitting")
def test_render_takes_the_plan_and_says_why(capsys):
    scene = gsjax.grow(gaussians_at([[0, 0, 4]], 0.5, 0.7, degree=0), 9)
    subject = SceneSource(lambda: scene, CONFIG, BEHIND, budget=0.05)
    found, config = prepare_render(subject, looking(1, 0), ("rgb", "alpha"))
    made = planned(scene, looking(1, 0), budget=0.05, outputs=("rgb", "alpha"))
    assert (found.capacity, config) == (1, made.config)
    told = capsys.readouterr().err.splitlines()
    assert told == [f"gsjax: {line}" for line in made.lines()]


def test_render_leaves_out_what_shows_in_no_picture():
    """Without a budget: bands that are 0, and what is below the cut everywhere."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-1, 1, (6, 2)), rng.uniform(3, 5, 6)])
    scene = gaussians_at(points, 0.5, [0.7, 0.6, 0.5, 1e-3, 0.4, 1e-4], degree=3)
    sh = scene.params.sh.at[:, 4:].set(0)
    scene = gsjax.grow(scene.replace(params=scene.params.replace(sh=sh)), 9)
    subject = SceneSource(lambda: scene, CONFIG, BEHIND)
    found, config = prepare_render(subject, looking(1, 0), ("rgb",))
    assert config == CONFIG.replace(outputs=("rgb",))
    assert (found.capacity, found.sh_degree) == (4, 1)
    (camera,) = looking(1, 0)
    whole = gsjax.render(scene, camera, config)
    some = gsjax.render(found, camera, config)
    assert float(whole.rgb.max()) > 0.1
    np.testing.assert_allclose(some.rgb, whole.rgb, atol=1e-14)
    # One band that is not 0, in one Gaussian, and there is nothing to leave out.
    full = gaussians_at(points[:3], 0.5, [0.7, 0.6, 0.5], degree=3)
    sh = full.params.sh.at[:, 1:].set(0).at[2, 15, 1].set(1e-9)
    full = full.replace(params=full.params.replace(sh=sh))
    subject = SceneSource(lambda: full, CONFIG, BEHIND)
    found, _ = prepare_render(subject, looking(1, 0), ("rgb",))
    assert (found.capacity, found.sh_degree) == (3, 3)
