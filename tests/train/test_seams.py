"""Seams of training: strategy, loss terms, scene model, and saved states."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from training import EXTENT, RASTER, VIEWS, changed, copy, dataset, photos, rough_start

import gsjax
from gsjax.densify.mcmc import McmcSettings
from gsjax.densify.types import SlotEdit, Strategy
from gsjax.errors import InputError
from gsjax.raster.types import RasterConfig
from gsjax.train.config import TrainConfig, preset
from gsjax.train.frames import draw, make_frames
from gsjax.train.loop import Hooks, fit
from gsjax.train.losses import LossTerm
from gsjax.train.models import Model, ModelParams
from gsjax.train.state import init_state, load_state, save_state
from gsjax.train.step import make_train_step

SLOTS = 96
CONFIG = TrainConfig(
    steps=40,
    sh_degree=0,
    strategy="mcmc",
    mcmc=McmcSettings(start=1000, opacity_penalty=0.0, scale_penalty=0.0),
    raster=RASTER,
)


def _move(params, view):
    """Shift the scene in proportion to the time, and each Gaussian by its offset."""
    shift, gaussians = params.model.shared["shift"], params.gaussians
    means = gaussians.params.means + view.time * shift + params.model.slots["offset"]
    return gaussians.replace(params=gaussians.params.replace(means=means))


MOVING = Model(
    init=lambda gaussians: ModelParams(
        slots={"offset": jnp.zeros((gaussians.capacity, 3))},
        shared={"shift": jnp.zeros(3)},
    ),
    apply=_move,
    rates={"shift": 2e-3, "offset": lambda fraction: 1e-4 * (1 - fraction)},
)


def clone_all(slots):
    """Return a strategy that clones all Gaussians after the second step."""
    rows = np.arange(slots)

    def plan(key, step, gaussians, stats):
        del key, step
        count = jnp.sum(gaussians.active)
        born = (rows >= count) & (rows < 2 * count)
        parent = jnp.where(born, rows - count, rows)
        edit = SlotEdit(
            params=jax.tree.map(lambda a: a[parent], gaussians.params),
            active=gaussians.active | born,
            cleared=born,
            opacities_reset=jnp.asarray(False),
            wanted=2 * count,
            source=jnp.where(born, parent, slots),
        )
        return edit, stats

    return Strategy(
        init=lambda gaussians: jnp.zeros(gaussians.capacity),
        observe=lambda stats, seen: stats + jnp.sum(seen.radii > 0, 0),
        due=lambda step: step == 2,
        plan=plan,
    )


SEAMS = {"strategy": clone_all(SLOTS), "model": MOVING}
# The other arguments of `fit`; runs share their programs.
GIVEN = {**SEAMS, "loss_terms": (LossTerm("zero", lambda *_: jnp.asarray(0.0)),)}


def state_of(slots=SLOTS, **seams):
    return init_state(rough_start(0, slots), CONFIG, EXTENT, VIEWS, **seams)


def captured(turn=1):
    """Return dataset and photographs of time 1; a turn of -1 looks away."""
    views = [
        replace(view, time=1.0, viewmat=np.diag([turn, 1, turn, 1]) @ view.viewmat)
        for view in dataset().views
    ]
    return replace(dataset(), views=tuple(views)), photos()


@pytest.mark.usefixtures("shared_programs")
def test_fit_takes_all_of_them(tmp_path):
    """Rows of a model follow the edit, and their moments are cleared."""
    state, states, records = state_of(**SEAMS), [], []
    hooks = Hooks(
        step=records.append,
        state=lambda state, _: states.append(copy(state)),
        stop=lambda: len(states) == 2,
    )
    result = fit(*captured(), CONFIG, state=state, hooks=hooks, **GIVEN)
    before, after = states
    assert changed(result.state, after) == []
    count, metrics = int(gsjax.num_active(before.gaussians)), records[-1].metrics
    assert (int(metrics.wanted), int(metrics.gaussians)) == (2 * count, SLOTS)
    offset = np.asarray(after.model.slots["offset"])
    np.testing.assert_array_equal(offset[count:], offset[: SLOTS - count])
    assert (offset[:count] != 0).any()
    moments = after.moments[0].mu
    for rows in (moments.model["offset"], moments.gaussians.means):
        assert (np.asarray(rows)[count:] == 0).all()
        assert (np.asarray(rows)[:count] != 0).any()
    assert (np.asarray(after.shared_moments[0].mu.model["shift"]) != 0).all()
    assert (after.stats > 0).any()
    # The state can be saved and loaded.
    path = tmp_path / "state.npz"
    save_state(path, after)
    assert changed(load_state(path, state), after) == []
    with pytest.raises(InputError, match=r"expected .* \(64,"):
        load_state(path, state_of(64, **SEAMS))
    path.write_bytes(path.read_bytes()[:1000])
    for bad in (path, tmp_path / "none.npz"):
        with pytest.raises(InputError, match=bad.name):
            load_state(bad, state)
    with pytest.raises(InputError, match="none"):
        save_state(tmp_path / "none" / "state.npz", state)


@pytest.mark.usefixtures("shared_programs")
def test_nothing_in_view_warns_once():
    """Cameras that look away."""
    stops = iter([False, False, True])
    options = {"state": state_of(**SEAMS), "hooks": Hooks(stop=lambda: next(stops))}
    with pytest.warns(UserWarning, match="poses may be inverted") as told:
        fit(*captured(turn=-1), CONFIG, **options, **GIVEN)
    assert len(told) == 1


def test_loss_terms_are_weighted_and_scheduled():
    """A term adds its weighted value from its first step on, with its outputs."""

    def depth(render, batch, params):
        del batch, params
        return jnp.mean(render.depth)

    term = LossTerm("depth", depth, weight=lambda step: 0.1 * step, start=2,
                    outputs=("depth",))  # fmt: skip
    state = state_of()
    batch = draw(make_frames(dataset().views, photos()), jnp.zeros(1, jnp.int32))
    step = jax.jit(make_train_step(CONFIG, EXTENT, loss_terms=(term,)))
    told = [step(state.replace(step=jnp.int32(s)), batch)[1] for s in range(3)]
    camera = jax.tree.map(lambda a: a[0], batch.camera)
    added = jnp.mean(gsjax.render(state.gaussians, camera, RASTER).depth)
    assert added > 0.1
    for metrics, weight in zip(told, (0.0, 0.2, 0.3)):
        np.testing.assert_allclose(metrics.loss, told[0].loss + weight * added, 1e-6)
        np.testing.assert_allclose(metrics.psnr, told[0].psnr, 1e-12)


def test_models_are_checked():
    with pytest.raises(InputError, match=r"model\.offset"):
        state_of(model=MOVING._replace(rates={}))
    few = MOVING._replace(init=lambda _: ModelParams(slots={"offset": jnp.zeros(3)}))
    with pytest.raises(InputError, match="expected slots"):
        state_of(model=few)


def test_settings_of_a_preset():
    """max_gaussians applies to both strategies; refined poses render accurately."""
    config = preset("fast", max_gaussians=7000)
    assert config.max_gaussians == 7000
    assert config.replace(strategy="adaptive").max_gaussians == 7000
    assert config.replace(max_gaussians=8).mcmc.max_gaussians == 8
    refined = preset("fast", refine_poses=True).raster
    accurate = RasterConfig.accurate()
    assert refined.alpha_min == accurate.alpha_min
    assert refined.stop_rule == accurate.stop_rule
    assert refined.num_size_buckets == config.raster.num_size_buckets
    own = RasterConfig.compat()
    assert TrainConfig(refine_poses=True, raster=own).raster is own
    plain = TrainConfig(refine_poses=True).replace(refine_poses=False)
    assert plain == TrainConfig()
    for name in ("strategy", "background", "initial"):
        with pytest.raises(InputError, match=f"{name}: expected one of .*, got 'x'"):
            TrainConfig(**{name: "x"})
    with pytest.raises(InputError, match="expected one of fast, default, quality"):
        preset("best")
