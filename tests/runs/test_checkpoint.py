"""Checkpoints: the same bits come back, or a typed error, never something else."""

import io
import os
import warnings
import zipfile
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from captures import scene_of_views

from gsjax.errors import InputError
from gsjax.init.gaussians import init_gaussians
from gsjax.runs.checkpoint import (
    load_checkpoint,
    load_latest,
    restore,
    save_checkpoint,
)
from gsjax.train.config import TrainConfig
from gsjax.train.initialisation import empty_state
from gsjax.train.state import init_state

CONFIG = TrainConfig(sh_degree=1, refine_poses=True, exposure=True, seed=5)
VIEWS, CAPACITY, EXTENT = 3, 12, 2.0
META = {"pair_capacity": 4096, "seconds": 1.5}


def state_at(step=0, config=CONFIG, capacity=CAPACITY):
    """A state with every number drawn at random, above 0 as squares are."""
    scene = scene_of_views(count=VIEWS, points=9)
    gaussians = init_gaussians(scene, sh_degree=config.sh_degree, capacity=capacity)
    state = init_state(gaussians, config, EXTENT, VIEWS)
    rng = np.random.default_rng(step)

    def fill(leaf):
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            return leaf
        return jnp.asarray(rng.exponential(size=leaf.shape), leaf.dtype)

    return replace(jax.tree.map(fill, state), step=jnp.int32(step))


def bits(state):
    leaves = jax.tree.leaves(replace(state, key=jax.random.key_data(state.key)))
    return [(leaf.dtype, leaf.shape, np.asarray(leaf).tobytes()) for leaf in leaves]


@pytest.mark.parametrize("strategy", ["adaptive", "mcmc"])
@pytest.mark.parametrize("tuned", [True, False])
@pytest.mark.parametrize("x64", [True, False])
def test_the_same_bits_come_back(tmp_path, strategy, tuned, x64):
    config = CONFIG if tuned else TrainConfig(sh_degree=0)
    config = config.replace(strategy=strategy)
    with jax.enable_x64(x64):
        state = state_at(70, config)
        # Values that text would not carry, in slots where they do not matter.
        mu = jax.tree.map(lambda a: a.at[-1].set(jnp.nan), state.moments.mu)
        state = state.replace(moments=state.moments._replace(mu=mu))
        path = save_checkpoint(tmp_path / "new" / "folder", state, META)
        found = load_latest(path.parent)
        template = empty_state(config, EXTENT, VIEWS, found.meta["capacity"])
        assert bits(restore(found, template)) == bits(state)
    assert found.step == 70
    assert found.meta["capacity"] == CAPACITY
    assert {name: found.meta[name] for name in META} == META
    assert state.gaussians.params.means.dtype == (np.float64 if x64 else np.float32)


def test_of_how_many_devices_need_not_be_said(tmp_path):
    found = load_checkpoint(save_checkpoint(tmp_path, state_at(), META))
    assert "devices" not in found.meta
    told = {**META, "devices": 3}
    found = load_checkpoint(save_checkpoint(tmp_path, state_at(), told))
    assert found.meta["devices"] == 3
    told["devices"] = 0
    with pytest.raises(InputError, match="devices 0"):
        load_checkpoint(save_checkpoint(tmp_path, state_at(), told))


def test_objects_are_not_saved(tmp_path):
    state = state_at()
    wrong = replace(state, stats=np.asarray([{}], object))
    with pytest.raises(TypeError, match="numbers alone"):
        save_checkpoint(tmp_path, wrong, META)
    assert names(tmp_path) == []


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_two_are_kept(tmp_path):
    for step in (5, 900, 1000, 12_000):
        save_checkpoint(tmp_path, state_at(step), META)
    assert names(tmp_path) == ["step_000001000.npz", "step_000012000.npz"]
    assert load_latest(tmp_path).step == 12_000
    save_checkpoint(tmp_path, state_at(12_000), META)
    assert len(names(tmp_path)) == 2


def test_damaged_later_ones_do_not_push_out_the_good(tmp_path):
    """A run that went on from before two damaged files writes between them."""
    save_checkpoint(tmp_path, state_at(100), META)
    for step in (300, 400):
        (tmp_path / f"step_{step:09d}.npz").write_bytes(b"PK")
    save_checkpoint(tmp_path, state_at(200), META)
    with pytest.warns(UserWarning, match="going on from step_000000200"):
        assert load_latest(tmp_path).step == 200
    save_checkpoint(tmp_path, state_at(250), META)
    assert names(tmp_path)[:2] == ["step_000000200.npz", "step_000000250.npz"]


def test_other_files_are_left_alone(tmp_path):
    for name in ("step_1.npz", "notes.txt", "step_000000001.npz.bak"):
        (tmp_path / name).write_text("mine")
    for step in (1, 2, 3):
        save_checkpoint(tmp_path, state_at(step), META)
    assert len(names(tmp_path)) == 5


def test_failing_to_write_keeps_what_was_there(tmp_path, monkeypatch):
    save_checkpoint(tmp_path, state_at(1), META)
    before = names(tmp_path)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(InputError, match="No space left on device"):
        save_checkpoint(tmp_path, state_at(2), META)
    assert names(tmp_path) == before
    assert load_latest(tmp_path).step == 1


def test_it_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    calls = []
    sync, rename = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda f: calls.append("sync") or sync(f))
    monkeypatch.setattr(os, "replace", lambda *a: calls.append("name") or rename(*a))
    save_checkpoint(tmp_path, state_at(1), META)
    assert calls == ["sync", "name"]


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("checkpoint")
    return save_checkpoint(folder, state_at(7), META).read_bytes()


@pytest.fixture(scope="module")
def load_bytes(tmp_path_factory):
    """Loads a file of these bytes."""
    path = tmp_path_factory.mktemp("damaged") / "step_000000007.npz"

    def load(data):
        path.write_bytes(data)
        return load_checkpoint(path)

    return load


@pytest.fixture(scope="module")
def original(written, load_bytes):
    return load_bytes(written)


def test_every_truncation_is_an_error(written, load_bytes):
    for length in [*range(0, len(written), 97), len(written) - 1]:
        with pytest.raises(InputError, match="step_000000007"):
            load_bytes(written[:length])


def test_flipped_bytes_are_an_error_or_change_nothing(written, original, load_bytes):
    """Not each byte counts (dates, attributes); none may change what is read."""
    rng = np.random.default_rng(0)
    places = np.concatenate(
        [np.arange(0, len(written), 97), len(written) - np.arange(1, 700, 3)]
    )
    found = 0
    for place in places:
        damaged = bytearray(written)
        damaged[place] ^= rng.choice([1, 0x20, 0x80, 0xFF])
        try:
            read = load_bytes(bytes(damaged))
        except InputError:
            found += 1
            continue
        assert read.meta == original.meta
        assert set(read.arrays) == set(original.arrays)
        for name, array in read.arrays.items():
            np.testing.assert_array_equal(array, original.arrays[name])
    assert found > 0.5 * len(places)


@pytest.mark.parametrize(
    "data", [b"", b"PK\x03\x04", b"no archive" * 50, b"\x93NUMPY\x01\x00"], ids=str
)
def test_what_is_no_archive(data, load_bytes):
    with pytest.raises(InputError):
        load_bytes(data)


def archive(**entries):
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=True, **entries)
    return buffer.getvalue()


def test_archives_of_others(load_bytes):
    with pytest.raises(InputError, match="meta"):
        load_bytes(archive(a=np.ones(3)))
    other = np.frombuffer(b'{"format": 99, "step": 1}', np.uint8)
    with pytest.raises(InputError, match="format 99; 1 is wanted"):
        load_bytes(archive(**{"meta.json": other}))
    with pytest.raises(InputError, match=r"not that of an array of numbers \(descr\)"):
        load_bytes(archive(a=np.asarray([{}], object)))
    text = np.frombuffer(b"[1, 2", np.uint8)
    with pytest.raises(InputError):
        load_bytes(archive(**{"meta.json": text}))


def test_a_bomb_is_not_unpacked(load_bytes):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as made:
        made.writestr("a.npy", bytes(10**8))
    with pytest.raises(InputError, match="compressed, in 100000000 bytes"):
        load_bytes(buffer.getvalue())


def test_damaged_ones_fall_back_to_the_older(tmp_path):
    for step in (7, 9):
        path = save_checkpoint(tmp_path, state_at(step), META)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.warns(UserWarning, match=r"step_000000009.npz.*from step_000000007"):
        found = load_latest(tmp_path)
    template = empty_state(CONFIG, EXTENT, VIEWS, CAPACITY)
    assert bits(restore(found, template)) == bits(state_at(7))
    (tmp_path / "step_000000007.npz").write_bytes(b"")
    with pytest.raises(InputError, match=r"no checkpoint to go on from .*000009"):
        load_latest(tmp_path)


def test_senseless_ones_fall_back_to_the_older(tmp_path):
    """As damaged ones do; what stands in an inactive slot is no matter."""
    good = state_at(7)
    nan = jax.tree.map(lambda a: a.at[-1].set(jnp.nan), good.gaussians.params)
    good = good.replace(gaussians=good.gaussians.replace(params=nan))
    save_checkpoint(tmp_path, good, META)
    bad = state_at(9)
    nu = jax.tree.map(lambda a: a.at[0].set(jnp.inf), bad.moments.nu)
    bad = bad.replace(moments=bad.moments._replace(nu=nu))
    save_checkpoint(tmp_path, bad, META)
    with pytest.warns(UserWarning, match=r"9.npz: .*moments.nu.*from step_000000007"):
        found = load_latest(tmp_path)
    template = empty_state(CONFIG, EXTENT, VIEWS, CAPACITY)
    assert bits(restore(found, template)) == bits(good)


def test_corrections_of_cameras_are_finite(tmp_path):
    state = state_at(9)
    refinement = replace(
        state.refinement, turns=state.refinement.turns.at[1, 2].set(jnp.nan)
    )
    path = save_checkpoint(tmp_path, replace(state, refinement=refinement), META)
    with pytest.raises(
        InputError, match=r"refinement.turns: 1 of 9 .* \[1, 2\] the first"
    ):
        load_checkpoint(path)


def test_no_run_is_beyond_its_end(tmp_path):
    for step in (7, 9):
        save_checkpoint(tmp_path, state_at(step), META)
    assert load_latest(tmp_path, 9).step == 9
    with pytest.warns(UserWarning, match="step 9 of a run of 8 .*going on from"):
        assert load_latest(tmp_path, 8).step == 7


def test_no_folder(tmp_path):
    with pytest.raises(InputError, match="no checkpoint to go on from"):
        load_latest(tmp_path / "none")


@pytest.mark.parametrize(
    ("changes", "capacity", "views", "named"),
    [
        ({"exposure": False}, CAPACITY, VIEWS, "exposures"),
        ({"refine_intrinsics": True}, CAPACITY, VIEWS, "intrinsics"),
        ({"strategy": "mcmc"}, CAPACITY, VIEWS, "stats"),
        ({"sh_degree": 2}, CAPACITY, VIEWS, "sh"),
        ({}, 16, VIEWS, "gaussians"),
        ({}, CAPACITY, 4, "refinement"),
    ],
    ids=str,
)
def test_other_settings_are_named(original, changes, capacity, views, named):
    template = empty_state(CONFIG.replace(**changes), EXTENT, views, capacity)
    with pytest.raises(InputError, match=rf"000007.npz: .*step 7 .*{named}"):
        restore(original, template)


def test_other_types_are_named(original):
    with jax.enable_x64(False):
        template = empty_state(CONFIG, EXTENT, VIEWS, CAPACITY)
        with pytest.raises(InputError, match=r"000007.npz: .*float64 .*; float32"):
            restore(original, template)


def test_reading_says_nothing(written, load_bytes):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_bytes(written)
