"""Checkpoints restore the same bits, or raise an `InputError`.

More damaged files are in `stress/bad_files.py`, each with its error.
"""

import os
from contextlib import suppress
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from captures import dataset_of_views
from training import changed

from gsjax.errors import InputError
from gsjax.init.gaussians import init_gaussians
from gsjax.runs.checkpoint import load_checkpoint, load_latest, restore, save_checkpoint
from gsjax.train.config import TrainConfig
from gsjax.train.initialisation import empty_state
from gsjax.train.state import init_state

CONFIG = TrainConfig(sh_degree=1, refine_poses=True, exposure=True, seed=5)
VIEWS, CAPACITY, EXTENT = 3, 12, 2.0
META = {"pair_capacity": 4096, "seconds": 1.5}


def state_at(step=0, config=CONFIG):
    """Return a state of random positive numbers."""
    dataset = dataset_of_views(count=VIEWS, points=9)
    gaussians = init_gaussians(dataset, sh_degree=config.sh_degree, capacity=CAPACITY)
    state = init_state(gaussians, config, EXTENT, VIEWS)
    rng = np.random.default_rng(step)

    def fill(leaf):
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            return leaf
        return jnp.asarray(rng.exponential(size=leaf.shape), leaf.dtype)

    return replace(jax.tree.map(fill, state), step=jnp.int32(step))


def template(config=CONFIG, views=VIEWS, capacity=CAPACITY):
    return empty_state(config, EXTENT, views, capacity)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("x64", [True, False])
@pytest.mark.parametrize(
    "config", [CONFIG, TrainConfig(sh_degree=0, strategy="mcmc")], ids=["all", "mcmc"]
)
def test_round_trip_is_bit_equal(tmp_path, config, x64):
    """In float32 and float64, of which neither is read as the other."""
    with jax.enable_x64(x64):
        state = state_at(70, config)
        # Inactive slots may hold NaN.
        params = jax.tree.map(lambda a: a.at[-1].set(jnp.nan), state.gaussians.params)
        state = replace(state, gaussians=state.gaussians.replace(params=params))
        meta = {**META, "devices": 3} if x64 else META
        path = save_checkpoint(tmp_path / "new" / "folder", state, meta)
        found = load_latest(path.parent)
        assert changed(restore(found, template(config)), state) == []
    assert (found.step, found.meta["capacity"]) == (70, CAPACITY)
    assert {**found.meta, **meta} == found.meta
    assert state.gaussians.params.means.dtype == (np.float64 if x64 else np.float32)
    with jax.enable_x64(not x64):
        like = template(config)
        with pytest.raises(InputError, match=r"000070.npz: .*float\d\d .*float\d\d"):
            restore(found, like)


def test_the_latest_two_are_kept_and_other_files_stay(tmp_path):
    others = ["notes.txt", "step_000000001.npz.bak", "step_1.npz"]
    for name in others:
        (tmp_path / name).write_text("mine")
    for step in (5, 900, 1000, 12_000, 12_000):
        save_checkpoint(tmp_path, state_at(step), META)
    kept = ["step_000001000.npz", "step_000012000.npz"]
    assert names(tmp_path) == sorted([*others, *kept])
    assert load_latest(tmp_path, 12_000).step == 12_000
    with pytest.warns(UserWarning, match="step 12000 of a run of 2000 .*resuming from"):
        assert load_latest(tmp_path, 2000).step == 1000
    save_checkpoint(tmp_path, state_at(13), {**META, "devices": 0})
    with pytest.raises(InputError, match="devices 0"):
        load_checkpoint(tmp_path / "step_000000013.npz")
    with pytest.raises(InputError, match="no checkpoint to resume from"):
        load_latest(tmp_path / "none")


def test_later_damaged_files_do_not_displace_good_ones(tmp_path):
    """A run that resumed before two damaged files writes between them."""
    save_checkpoint(tmp_path, state_at(100), META)
    for step in (300, 400):
        (tmp_path / f"step_{step:09d}.npz").write_bytes(b"PK")
    for step in (200, 250):
        save_checkpoint(tmp_path, state_at(step), META)
        with pytest.warns(UserWarning, match=f"resuming from step_000000{step}"):
            assert load_latest(tmp_path).step == step
    assert names(tmp_path)[:2] == ["step_000000200.npz", "step_000000250.npz"]


def test_a_file_is_on_disk_before_it_has_its_name(tmp_path, monkeypatch):
    with pytest.raises(TypeError, match="array of objects"):
        save_checkpoint(tmp_path, replace(state_at(), stats=np.array([{}])), META)
    calls, sync, rename = [], os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda file: calls.append(sync) or sync(file))
    monkeypatch.setattr(os, "replace", lambda *a: calls.append(rename) or rename(*a))
    save_checkpoint(tmp_path, state_at(1), META)
    assert calls[:2] == [sync, rename]
    assert names(tmp_path) == ["step_000000001.npz"]


def flip_a_bit(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def break_the_text(path):
    np.savez(path, **{"meta.json": np.frombuffer(b"[1, 2", np.uint8)})


def spoil_a_correction(path):
    state = state_at(9)
    shifts = state.refinement.shifts.at[1, 2].set(jnp.nan)
    state = replace(state, refinement=replace(state.refinement, shifts=shifts))
    save_checkpoint(path.parent, state, META)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (flip_a_bit, "damaged checkpoint"),
        (break_the_text, "meta.json"),
        (spoil_a_correction, r"not finite numbers, \[1, 2\] first"),
    ],
)
def test_damaged_files_fall_back_to_the_previous_one(tmp_path, damage, message):
    good, bad = (save_checkpoint(tmp_path, state_at(step), META) for step in (7, 9))
    damage(bad)
    with pytest.warns(UserWarning, match=f"000009.*{message}.*from step_000000007"):
        found = load_latest(tmp_path)
    assert changed(restore(found, template()), state_at(7)) == []
    good.write_bytes(b"")
    with pytest.raises(InputError, match=r"no checkpoint to resume from .*000009"):
        load_latest(tmp_path)


def test_flipped_bytes_are_rejected_or_change_nothing(tmp_path):
    """Some bytes do not matter, such as dates."""
    path = save_checkpoint(tmp_path, state_at(7), META)
    original, written = load_checkpoint(path), path.read_bytes()
    rng = np.random.default_rng(0)
    places = [*range(0, len(written), 197), *(len(written) - np.arange(1, 700, 7))]
    harmless = 0
    for place in places:
        damaged = bytearray(written)
        damaged[place] ^= rng.choice([1, 0x20, 0x80, 0xFF])
        path.write_bytes(damaged)
        with suppress(InputError):
            read = load_checkpoint(path)
            assert read.meta == original.meta
            assert changed(read.arrays, original.arrays) == []
            harmless += 1
    assert harmless < 0.5 * len(places)


def test_other_settings_are_named(tmp_path):
    saved = load_checkpoint(save_checkpoint(tmp_path, state_at(7), META))
    for changes, sizes, named in (
        ({"exposure": False}, {}, "exposures"),
        ({"refine_intrinsics": True}, {}, "intrinsics"),
        ({"strategy": "mcmc"}, {}, "stats"),
        ({"sh_degree": 2}, {}, "sh"),
        ({}, {"capacity": 16}, "gaussians"),
        ({}, {"views": 4}, "refinement"),
    ):
        with pytest.raises(InputError, match=rf"000007.npz: .*step 7.*{named}"):
            restore(saved, template(CONFIG.replace(**changes), **sizes))
