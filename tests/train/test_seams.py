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
    bits,
    changed,
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
from gsjax.train.optimiser import Rates
from gsjax.train.state import init_state, load_state, save_state
from gsjax.train.step import make_train_step

SLOTS = 96
STILL = Rates((0.0, 0.0), 0.0, 0.0, 0.0, 0.0, 0.0)
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


def test_a_rigid_motion_is_recovered():
    """Photographs of a moving scene, with known Gaussians and 6 unknown numbers."""
    truth = rough_start(0, SLOTS)
    views = [replace(v, time=float(t)) for t, v in enumerate(dataset().views)]
    frames = make_frames(views, photos())
    config = CONFIG.replace(rates=STILL, batch=VIEWS)
    rigid = RIGID._replace(rates={"motion": 2e-3, "offset": 0.0})
    start = init_state(truth, config, EXTENT, VIEWS, model=rigid)
    wanted = jnp.asarray([0.02, -0.01, 0.03, 0.03, 0.02, -0.02])
    moved = start.replace(model=start.model._replace(shared={"motion": wanted}))
    batch = draw(frames, jnp.arange(VIEWS))
    images = [
        gsjax.render(
            rigid.apply(moved.params, jax.tree.map(lambda a, i=i: a[i], info)),
            jax.tree.map(lambda a, i=i: a[i], frames.camera),
            RASTER.replace(outputs=("rgb",)),
        ).rgb
        for i in range(VIEWS)
        for info in [_info(batch)]
    ]
    pixels = np.rint(np.clip(np.stack(images), 0, 1) * 255).astype(np.uint8)
    batch = batch._replace(pixels=jnp.asarray(pixels))
    step = jax.jit(make_train_step(config, EXTENT, model=rigid))
    state, losses = start, []
    for _ in range(40):
        state, metrics = step(state, batch)
        assert metrics.finite
        assert not metrics.overflowed
        losses.append(float(metrics.loss))
    error = np.abs(state.model.shared["motion"] - wanted).max()
    assert losses[-1] < 0.3 * losses[0]
    assert error < 0.01
    assert changed(start.gaussians, state.gaussians) == []


def _info(batch):
    from gsjax.train.models import ViewInfo

    return ViewInfo(batch.view, batch.time)


def test_rows_of_a_model_follow_the_edit():
    """And their moments are cleared; shared parameters are not touched."""
    gaussians = rough_start(0, SLOTS)
    given = {"strategy": clone_all(gaussians), "model": RIGID}
    state = init_state(gaussians, CONFIG, EXTENT, VIEWS, **given)
    step = jax.jit(make_train_step(CONFIG, EXTENT, **given))
    batch = draw(FRAMES, jnp.zeros(1, jnp.int32))._replace(time=jnp.ones(1))
    for _ in range(2):
        before = state
        state, metrics = step(state, batch)
    count = int(jnp.sum(before.gaussians.active))
    assert (int(metrics.wanted), int(metrics.gaussians)) == (2 * count, SLOTS)
    offset = np.asarray(state.model.slots["offset"])
    born = SLOTS - count
    np.testing.assert_array_equal(offset[count:], offset[:born])
    assert (offset[:count] != 0).any()
    moments = state.moments[0].mu
    assert (np.asarray(moments.model["offset"])[count:] == 0).all()
    assert (np.asarray(moments.gaussians.means)[count:] == 0).all()
    assert (np.asarray(moments.model["offset"])[:count] != 0).any()
    assert (np.asarray(state.shared_moments[0].mu.model["motion"]) != 0).all()
    assert (state.stats > 0).any()


def test_loss_terms_are_weighted_and_scheduled():
    """A term adds its weighted value from its first step on, with its outputs."""

    def depth(render, batch, params):
        del batch, params
        return jnp.mean(render.depth)

    term = LossTerm("depth", depth, weight=lambda step: 0.1 * step, start=2,
                    outputs=("depth",))  # fmt: skip
    state = init_state(rough_start(0, SLOTS), CONFIG, EXTENT, VIEWS)
    batch = draw(FRAMES, jnp.zeros(1, jnp.int32))
    plain = jax.jit(make_train_step(CONFIG, EXTENT))
    more = jax.jit(make_train_step(CONFIG, EXTENT, loss_terms=(term,)))
    first, second = plain(state, batch), more(state, batch)
    assert bits(first[1]) == bits(second[1])
    state = first[0]
    (_, without), (_, with_it) = plain(state, batch), more(state, batch)
    camera = jax.tree.map(lambda a: a[0], batch.camera)
    image = gsjax.render(state.gaussians, camera, RASTER)
    wanted = without.loss + 0.2 * jnp.mean(image.depth)
    np.testing.assert_allclose(with_it.loss, wanted, rtol=1e-6)
    assert with_it.psnr == without.psnr


def test_fit_takes_all_of_them(tmp_path):
    """And its state can be saved and loaded."""
    term = LossTerm("zero", lambda *_: jnp.asarray(0.0))
    gaussians = rough_start(0, 128)
    given = {"strategy": clone_all(gaussians), "model": RIGID}
    state = init_state(gaussians, CONFIG, EXTENT, VIEWS, **given)
    stops = iter([False, False, True])
    result = fit(
        dataset(), photos(), CONFIG, state=state, loss_terms=(term,),
        hooks=Hooks(stop=lambda: next(stops)), **given,
    )  # fmt: skip
    assert int(gsjax.num_active(result.gaussians)) == 120
    path = tmp_path / "state.npz"
    save_state(path, result.state)
    template = init_state(result.gaussians, CONFIG, EXTENT, VIEWS, **given)
    assert changed(load_state(path, template), result.state) == []
    other = init_state(rough_start(0, SLOTS), CONFIG, EXTENT, VIEWS, **given)
    with pytest.raises(InputError, match=r"expected .* \(96,"):
        load_state(path, other)
    path.write_bytes(path.read_bytes()[:1000])
    for bad, like in ((path, template), (tmp_path / "none.npz", template)):
        with pytest.raises(InputError, match=bad.name):
            load_state(bad, like)
    with pytest.raises(InputError, match="none"):
        save_state(tmp_path / "none" / "state.npz", state)


def test_models_are_checked():
    gaussians = rough_start(0, SLOTS)
    with pytest.raises(InputError, match=r"model\.offset"):
        init_state(gaussians, CONFIG, EXTENT, VIEWS, model=RIGID._replace(rates={}))
    few = RIGID._replace(init=lambda _: ModelParams(slots={"offset": jnp.zeros(3)}))
    with pytest.raises(InputError, match="expected slots"):
        init_state(gaussians, CONFIG, EXTENT, VIEWS, model=few)


def test_nothing_in_view_warns_once():
    """Poses camera → world instead of world → camera."""
    views = [replace(v, viewmat=np.linalg.inv(v.viewmat)) for v in dataset().views]
    inverted = replace(dataset(), views=tuple(views))
    state = init_state(rough_start(0, SLOTS), CONFIG, EXTENT, VIEWS)
    stops = iter([False, False, True])
    hooks = Hooks(stop=lambda: next(stops))
    with pytest.warns(UserWarning, match="poses may be inverted") as told:
        fit(inverted, photos(), CONFIG, state=state, hooks=hooks)
    assert len(told) == 1


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
