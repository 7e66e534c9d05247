"""Seams of training: strategy, loss terms, scene model, and saved states."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from training import (
    EXTENT,
    RASTER,
    VIEWS,
    changed,
    copy,
    dataset,
    photos,
    rough_start,
)

import gsjax
from gsjax.densify.mcmc import McmcSettings
from gsjax.densify.types import SlotEdit, Strategy
from gsjax.errors import InputError
from gsjax.math.rotations import quaternion_to_matrix
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
FRAMES = make_frames(dataset().views, photos())


def _move(params, view):
    """Rotate and shift the scene, in proportion to the time."""
    motion, gaussians = params.model.shared["motion"], params.gaussians
    turn, shift = view.time * motion[:3], view.time * motion[3:]
    rotation = quaternion_to_matrix(jnp.concatenate([jnp.ones(1), turn]))
    means = gaussians.params.means @ rotation.T + shift + params.model.slots["offset"]
    return gaussians.replace(params=gaussians.params.replace(means=means))


RIGID = Model(
    init=lambda gaussians: ModelParams(
        slots={"offset": jnp.zeros((gaussians.capacity, 3))},
        shared={"motion": jnp.zeros(6)},
    ),
    apply=_move,
    rates={"motion": 2e-3, "offset": lambda fraction: 1e-4 * (1 - fraction)},
)


def clone_all(gaussians):
    """Return a strategy that clones all Gaussians after the second step."""
    slots = gaussians.capacity

    def plan(key, step, gaussians, stats):
        del key, step
        count = jnp.sum(gaussians.active)
        rows = jnp.arange(slots)
        born = (rows >= count) & (rows < 2 * count)
        source = jnp.where(born, rows - count, slots)
        params = jax.tree.map(
            lambda a: a[jnp.where(born, rows - count, rows)], gaussians.params
        )
        active = gaussians.active | born
        edit = SlotEdit(
            params, active, born, jnp.asarray(False), 2 * count, source=source
        )
        return edit, stats

    return Strategy(
        init=lambda gaussians: jnp.zeros(gaussians.capacity),
        observe=lambda stats, seen: stats + jnp.sum(seen.radii > 0, 0),
        due=lambda step: step == 2,
        plan=plan,
    )


@pytest.fixture(scope="module")
def given():
    """The other arguments of `fit`; runs share their programs."""
    gaussians = rough_start(0, SLOTS)
    term = LossTerm("zero", lambda *_: jnp.asarray(0.0))
    return {"strategy": clone_all(gaussians), "model": RIGID, "loss_terms": (term,)}


def captured(turn=1):
    """Return the photographs of the dataset, taken at time 1, from arrays."""
    cameras = [
        gsjax.make_camera(
            viewmat=np.diag([turn, 1, turn, 1]) @ view.viewmat, K=view.K,
            width=view.width, height=view.height,
        )
        for view in dataset().views
    ]  # fmt: skip
    made, taken = gsjax.make_dataset([p.pixels for p in photos()], cameras)
    views = tuple(replace(view, time=1.0) for view in made.views)
    return replace(made, views=views), taken


def test_fit_takes_all_of_them(tmp_path, given, shared_programs):
    """Rows of a model follow the edit, and their moments are cleared."""
    del shared_programs
    seams = {name: given[name] for name in ("strategy", "model")}
    state = init_state(rough_start(0, SLOTS), CONFIG, EXTENT, VIEWS, **seams)
    states, records = [], []
    hooks = Hooks(
        step=records.append,
        state=lambda state, _: states.append(copy(state)),
        stop=lambda: len(states) == 2,
    )
    result = fit(*captured(), CONFIG, state=state, hooks=hooks, **given)
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
    assert (np.asarray(after.shared_moments[0].mu.model["motion"]) != 0).all()
    assert (after.stats > 0).any()
    # The state can be saved and loaded.
    path = tmp_path / "state.npz"
    save_state(path, after)
    assert changed(load_state(path, state), after) == []
    other = init_state(rough_start(0, 64), CONFIG, EXTENT, VIEWS, **seams)
    with pytest.raises(InputError, match=r"expected .* \(64,"):
        load_state(path, other)
    path.write_bytes(path.read_bytes()[:1000])
    for bad in (path, tmp_path / "none.npz"):
        with pytest.raises(InputError, match=bad.name):
            load_state(bad, state)
    with pytest.raises(InputError, match="none"):
        save_state(tmp_path / "none" / "state.npz", state)


def test_nothing_in_view_warns_once(given, shared_programs):
    """Cameras that look away."""
    del shared_programs
    seams = {name: given[name] for name in ("strategy", "model")}
    state = init_state(rough_start(0, SLOTS), CONFIG, EXTENT, VIEWS, **seams)
    stops = iter([False, False, True])
    hooks = Hooks(stop=lambda: next(stops))
    with pytest.warns(UserWarning, match="poses may be inverted") as told:
        fit(*captured(turn=-1), CONFIG, state=state, hooks=hooks, **given)
    assert len(told) == 1


def test_loss_terms_are_weighted_and_scheduled():
    """A term adds its weighted value from its first step on, with its outputs."""

    def depth(render, batch, params):
        del batch, params
        return jnp.mean(render.depth)

    term = LossTerm("depth", depth, weight=lambda step: 0.1 * step, start=2,
                    outputs=("depth",))  # fmt: skip
    state = init_state(rough_start(0, SLOTS), CONFIG, EXTENT, VIEWS)
    batch = draw(FRAMES, jnp.zeros(1, jnp.int32))
    step = jax.jit(make_train_step(CONFIG, EXTENT, loss_terms=(term,)))
    told = [step(state.replace(step=jnp.int32(s)), batch)[1] for s in range(3)]
    camera = jax.tree.map(lambda a: a[0], batch.camera)
    added = jnp.mean(gsjax.render(state.gaussians, camera, RASTER).depth)
    assert added > 0.1
    for metrics, weight in zip(told, (0.0, 0.2, 0.3)):
        np.testing.assert_allclose(metrics.loss, told[0].loss + weight * added, 1e-6)
        np.testing.assert_allclose(metrics.psnr, told[0].psnr, 1e-12)


def test_models_are_checked():
    gaussians = rough_start(0, SLOTS)
    with pytest.raises(InputError, match=r"model\.offset"):
        init_state(gaussians, CONFIG, EXTENT, VIEWS, model=RIGID._replace(rates={}))
    few = RIGID._replace(init=lambda _: ModelParams(slots={"offset": jnp.zeros(3)}))
    with pytest.raises(InputError, match="expected slots"):
        init_state(gaussians, CONFIG, EXTENT, VIEWS, model=few)


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
