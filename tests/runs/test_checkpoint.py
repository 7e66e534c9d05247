"""Checkpoints restore the same bits, or raise an `InputError`."""

import io
import os
import zipfile
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from captures import dataset_of_views

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


def bits(state):
    leaves = jax.tree.leaves(replace(state, key=jax.random.key_data(state.key)))
    return [(leaf.dtype, leaf.shape, np.asarray(leaf).tobytes()) for leaf in leaves]


def template(config=CONFIG, views=VIEWS, capacity=CAPACITY):
    return empty_state(config, EXTENT, views, capacity)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("x64", [True, False])
@pytest.mark.parametrize(
    "config", [CONFIG, TrainConfig(sh_degree=0, strategy="mcmc")], ids=["all", "mcmc"]
)
def test_round_trip_is_bit_equal(tmp_path, config, x64):
    with jax.enable_x64(x64):
        state = state_at(70, config)
        # Inactive slots may hold NaN.
        params = jax.tree.map(lambda a: a.at[-1].set(jnp.nan), state.gaussians.params)
        state = replace(state, gaussians=state.gaussians.replace(params=params))
        meta = {**META, "devices": 3} if x64 else META
        path = save_checkpoint(tmp_path / "new" / "folder", state, meta)
        found = load_latest(path.parent)
        assert bits(restore(found, template(config))) == bits(state)
    assert (found.step, found.meta["capacity"]) == (70, CAPACITY)
    assert {**found.meta, **meta} == found.meta
    assert state.gaussians.params.means.dtype == (np.float64 if x64 else np.float32)


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


def test_a_failed_write_keeps_the_previous_file(tmp_path, monkeypatch):
    with pytest.raises(TypeError, match="array of objects"):
        save_checkpoint(tmp_path, replace(state_at(), stats=np.array([{}])), META)
    save_checkpoint(tmp_path, state_at(1), META)
    before, calls = names(tmp_path), []

    def full(*_):
        calls.append("rename")
        raise OSError(28, "No space left on device")

    sync = os.fsync
    monkeypatch.setattr(os, "fsync", lambda file: calls.append("sync") or sync(file))
    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(InputError, match="No space left on device"):
        save_checkpoint(tmp_path, state_at(2), META)
    assert calls == ["sync", "rename"], "on disk before it has its name"
    assert names(tmp_path) == before
    assert load_latest(tmp_path).step == 1


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """Return the file of a checkpoint, which tests damage, its bytes and content."""
    path = save_checkpoint(tmp_path_factory.mktemp("checkpoint"), state_at(7), META)
    return path, path.read_bytes(), load_checkpoint(path)


def test_truncated_files_are_rejected(saved):
    path, written, _ = saved
    for length in [*range(0, len(written), 197), len(written) - 1]:
        path.write_bytes(written[:length])
        with pytest.raises(InputError, match="step_000000007"):
            load_checkpoint(path)


def test_flipped_bytes_are_rejected_or_change_nothing(saved):
    """Some bytes do not matter, such as dates."""
    path, written, original = saved
    rng = np.random.default_rng(0)
    places = [*range(0, len(written), 197), *(len(written) - np.arange(1, 700, 7))]
    rejected = 0
    for place in places:
        damaged = bytearray(written)
        damaged[place] ^= rng.choice([1, 0x20, 0x80, 0xFF])
        path.write_bytes(damaged)
        try:
            read = load_checkpoint(path)
        except InputError:
            rejected += 1
            continue
        assert read.meta == original.meta
        assert set(read.arrays) == set(original.arrays)
        for name, array in read.arrays.items():
            np.testing.assert_array_equal(array, original.arrays[name])
    assert rejected > 0.5 * len(places)


def archive(**entries):
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=True, **entries)
    return buffer.getvalue()


def bomb():
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as made:
        made.writestr("a.npy", bytes(10**8))
    return buffer.getvalue()


def meta(text):
    return archive(**{"meta.json": np.frombuffer(text, np.uint8)})


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: b"", "damaged"),
        (lambda: b"PK\x03\x04", "damaged"),
        (lambda: b"no archive" * 50, "damaged"),
        (lambda: archive(a=np.ones(3)), "meta.json is missing"),
        (lambda: archive(a=np.asarray([{}], object)), "an array of numbers"),
        (lambda: meta(b'{"format": 99, "step": 1}'), r"format 99 \(expected 1\)"),
        (lambda: meta(b"[1, 2"), "meta.json"),
        (bomb, "compressed, of 100000000 bytes"),
    ],
    ids=range(8),
)
def test_files_that_are_no_checkpoints_are_rejected(make, message, saved):
    saved[0].write_bytes(make())
    with pytest.raises(InputError, match=message):
        load_checkpoint(saved[0])


def set_value(state, field, index, value):
    """Return the state with an element of the first array of a field replaced."""
    leaves, structure = jax.tree.flatten(getattr(state, field))
    place = next(n for n, leaf in enumerate(leaves) if leaf.ndim == 2)
    leaves[place] = leaves[place].at[index].set(value)
    return replace(state, **{field: jax.tree.unflatten(structure, leaves)})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (None, "step_000000009.npz"),
        (lambda s: set_value(s, "moments", (0, 0), jnp.inf), "moments.* not finite"),
        (lambda s: set_value(s, "gaussians", (0, 0), jnp.nan), "gaussians.*finite"),
        (lambda s: set_value(s, "refinement", (1, 2), jnp.nan), r"\[1, 2\] first"),
    ],
    ids=["bit", "moments", "gaussians", "refinement"],
)
def test_damaged_files_fall_back_to_the_previous_one(tmp_path, change, message):
    save_checkpoint(tmp_path, state_at(7), META)
    state = state_at(9)
    path = save_checkpoint(tmp_path, change(state) if change else state, META)
    if change is None:
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 1
        path.write_bytes(data)
    with pytest.warns(UserWarning, match=f"{message}.*from step_000000007"):
        found = load_latest(tmp_path)
    assert bits(restore(found, template())) == bits(state_at(7))
    (tmp_path / "step_000000007.npz").write_bytes(b"")
    with pytest.raises(InputError, match=r"no checkpoint to resume from .*000009"):
        load_latest(tmp_path)


@pytest.mark.parametrize(
    ("changes", "sizes", "named"),
    [
        ({"exposure": False}, {}, "exposures"),
        ({"refine_intrinsics": True}, {}, "intrinsics"),
        ({"strategy": "mcmc"}, {}, "stats"),
        ({"sh_degree": 2}, {}, "sh"),
        ({}, {"capacity": 16}, "gaussians"),
        ({}, {"views": 4}, "refinement"),
    ],
    ids=str,
)
def test_other_settings_are_named(saved, changes, sizes, named):
    with pytest.raises(InputError, match=rf"000007.npz: .*step 7.*{named}"):
        restore(saved[2], template(CONFIG.replace(**changes), **sizes))


def test_other_dtypes_are_named(saved):
    with jax.enable_x64(False):
        like = template()
        with pytest.raises(InputError, match=r"000007.npz: .*float32 .*float64"):
            restore(saved[2], like)
