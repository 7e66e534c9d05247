"""Laws of MCMC density control: sharing, relocation, growth and noise."""

import math
from dataclasses import replace
from decimal import Decimal, getcontext
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import assert_not_empty, camera_of, cast, reference
from slot_scenes import scene_in

from gsjax.densify.adaptive import AdaptiveSettings, adaptive
from gsjax.densify.mcmc import McmcSettings, mcmc, shared_opacity, shared_scale, spawn
from gsjax.densify.types import copy_rows
from gsjax.math.rotations import covariance
from gsjax.train.metrics import psnr

SLOTS = 96
SETTINGS = McmcSettings(start=0, stop=1000, every=10, max_gaussians=1000)
STILL = replace(SETTINGS, growth=1.0)


def area_of_equation_9(shared: Fraction, count: int) -> Decimal:
    """Return Σᵢ Σₖ C(i−1, k) (−1)ᵏ o'^(k+1) / √(k+1), i = 1 … n, to 60 digits."""
    getcontext().prec = 60
    total = Decimal(0)
    for k in range(count):
        terms = sum(math.comb(i - 1, k) for i in range(1, count + 1))
        term = Fraction((-1) ** k * terms) * shared ** (k + 1)
        root = Decimal(k + 1).sqrt()
        total += Decimal(term.numerator) / Decimal(term.denominator) / root
    return total


@pytest.mark.parametrize("opacity", [1e-3, 0.05, 0.5, 0.9, 0.99, 1 - 2**-12])
def test_scale_is_equation_9(opacity, report):
    counts = np.arange(2, 52)
    single = np.full(50, opacity, np.float32)
    shared = shared_opacity(single, jnp.asarray(counts, jnp.int32))
    found = shared_scale(single, shared, jnp.asarray(counts, jnp.int32))
    assert shared.dtype == found.dtype == jnp.float32
    worst = 0.0
    for count, one, value in zip(counts, np.asarray(shared), np.asarray(found)):
        # The rounded share, so that the formula alone is compared.
        area = area_of_equation_9(Fraction(float(one)), int(count))
        wanted = Decimal(float(single[0])) / area
        worst = max(worst, abs(float(Decimal(float(value)) / wanted - 1)))
    report(f"equation 9 at opacity {opacity:.4f}", worst, 1e-5)
    assert worst <= 1e-5


def test_shared_opacities_compose_to_the_original():
    opacity = np.float64([1e-6, 0.005, 0.3, 0.9, 0.999999])[:, None]
    count = jnp.arange(1, 200)
    shared = np.asarray(shared_opacity(opacity, count))
    covered = -np.expm1(count * np.log1p(-shared))
    np.testing.assert_allclose(covered, opacity + 0 * covered, rtol=1e-9)
    assert (np.diff(shared, axis=1) < 0).all()
    wide = shared_scale(opacity + 0 * shared, shared, count)
    np.testing.assert_allclose(shared[:, 0], opacity[:, 0], rtol=1e-12)
    np.testing.assert_allclose(wide[:, 0], 1, rtol=1e-6)
    assert (wide <= 1 + 1e-6).all()
    assert (wide > 0).all()
    extremes = jnp.asarray([0.0, 1.0], jnp.float32)
    for count in (1, 2, 10_000):
        shared = shared_opacity(extremes, jnp.int32(count))
        factor = shared_scale(extremes, shared, jnp.int32(count))
        assert (np.isfinite(shared) & np.isfinite(factor) & (factor > 0)).all()


def planned(config, key, gaussians):
    return mcmc(config).plan(key, jnp.int32(10), gaussians, ())[0]


def first(count):
    return np.arange(SLOTS) < count


def children_of(edit, gaussians, slots):
    """Return the slot that each of ``slots`` was copied from, by its colour."""
    table, found = (np.asarray(p.sh)[:, 0, 0] for p in (gaussians.params, edit.params))
    return [int(np.flatnonzero(table == found[slot])[0]) for slot in slots]


def mixed():
    opacities = np.linspace(0.05, 0.95, SLOTS)
    opacities[:24] = 0.004
    return scene_in(first(80), opacities)


def test_dead_gaussians_move_onto_live_ones():
    gaussians = mixed()
    before = gaussians.params
    edit = planned(STILL, jax.random.key(0), gaussians)
    np.testing.assert_array_equal(edit.active, gaussians.active)
    assert edit.wanted == 80
    parents = children_of(edit, gaussians, range(24))
    assert min(parents) >= 24
    assert max(parents) < 80
    copies = np.bincount(parents, minlength=SLOTS)
    opacity = np.asarray(jax.nn.sigmoid(before.logit_opacities))
    after = np.asarray(jax.nn.sigmoid(edit.params.logit_opacities))
    for parent in set(parents):
        count = copies[parent] + 1
        group = [parent, *(i for i in range(24) if parents[i] == parent)]
        together = 1 - (1 - after[group]) ** count
        np.testing.assert_allclose(together, opacity[parent], rtol=1e-9)
        factor = shared_scale(opacity[parent], after[parent], count)
        wanted = before.log_scales[parent] + np.log(factor)
        for slot in group:
            np.testing.assert_array_equal(edit.params.means[slot], before.means[parent])
            np.testing.assert_allclose(edit.params.log_scales[slot], wanted, rtol=1e-9)
    apart = 24 + np.flatnonzero(copies[24:80] == 0)
    assert 20 < len(apart) < 56
    for name, leaf in vars(edit.params).items():
        np.testing.assert_array_equal(leaf[apart], getattr(before, name)[apart])
    changed = np.union1d(np.arange(24), parents)
    np.testing.assert_array_equal(np.flatnonzero(edit.cleared), changed)
    dead = scene_in(first(40), 0.004)
    edit = planned(STILL, jax.random.key(1), dead)  # nothing to move onto
    np.testing.assert_array_equal(edit.active, dead.active)
    jax.tree.map(np.testing.assert_array_equal, edit.params, dead.params)


def test_parents_are_drawn_by_opacity():
    """χ² of 4800 draws: 71 degrees of freedom, 0.9999 below 120."""
    opacities = np.linspace(0.05, 0.95, SLOTS)
    alive, counts = first(72), np.zeros(SLOTS)
    gaussians = scene_in(first(SLOTS), opacities)
    drawn = jax.jit(lambda key, alive: spawn(key, gaussians, ~alive, alive, SETTINGS))
    for seed in range(200):
        edit = drawn(jax.random.key(seed), alive)
        np.add.at(counts, children_of(edit, gaussians, range(72, SLOTS)), 1)
    assert counts[72:].sum() == 0
    assert counts.sum() == 4800
    expected = 4800 * opacities[:72] / opacities[:72].sum()
    assert np.sum((counts[:72] - expected) ** 2 / expected) < 120


@pytest.mark.parametrize(
    ("count", "growth", "cap", "wanted", "got"),
    [
        (40, 1.05, 1000, 42, 42),
        (40, 1.5, 1000, 60, 60),
        (40, 1.5, 45, 45, 45),
        (40, 1.5, 30, 30, 40),  # already more than the maximum
        (80, 1.5, 1000, 120, 96),  # too few slots
        (0, 1.5, 1000, 0, 0),
        # At least one more, where the factor alone rounds down to none.
        (1, 1.05, 1000, 2, 2),
        (19, 1.05, 19, 19, 19),
        (19, 1.0, 1000, 19, 19),
    ],
)
def test_growth(count, growth, cap, wanted, got):
    config = McmcSettings(start=0, stop=9, every=1, growth=growth, max_gaussians=cap)
    gaussians = scene_in(first(count))
    edit = planned(config, jax.random.key(1), gaussians)
    assert edit.wanted == wanted
    assert config.schedule.expected(count, 3, 4) == max(count, wanted)
    assert edit.active.sum() == got
    assert edit.active[:count].all()
    born = np.flatnonzero(np.asarray(edit.active) & ~first(count))
    assert np.asarray(edit.cleared)[born].all()
    parents = children_of(edit, gaussians, born)
    assert all(p < count for p in parents)
    # Other arrays follow the copies.
    rows = np.arange(SLOTS)
    wanted = np.where(np.isin(rows, born), 0, rows)
    wanted[born] = parents
    np.testing.assert_array_equal(copy_rows(edit, rows), wanted)


def test_penalty_is_the_weighted_mean():
    gaussians = mixed()
    config = McmcSettings(opacity_penalty=0.3, scale_penalty=0.7)
    live = np.asarray(gaussians.active)
    opacity = jax.nn.sigmoid(gaussians.params.logit_opacities)[live]
    scales = jnp.exp(gaussians.params.log_scales)[live]
    wanted = 0.3 * opacity.mean() + 0.7 * scales.mean()
    np.testing.assert_allclose(mcmc(config).penalty(gaussians), wanted, rtol=1e-12)
    none = gaussians.replace(active=gaussians.active & False)
    assert mcmc(config).penalty(none) == 0
    same = AdaptiveSettings(opacity_penalty=0.3, scale_penalty=0.7)
    assert adaptive(same, 5.0).penalty(gaussians) == mcmc(config).penalty(gaussians)
    assert adaptive(AdaptiveSettings(), 5.0).penalty is None


def test_noise_has_the_covariance_of_the_paper():
    """(gate · noise · rate)² Σ² if transparent; none if opaque. The dtype is kept."""
    two = scene_in([True, True], [1e-4, 0.5])
    gaussians = jax.tree.map(lambda a: jnp.tile(a.T, 48).T, two)
    gaussians = gaussians.replace(active=first(80))
    perturb, rate = jax.jit(mcmc(SETTINGS).perturb), jnp.asarray(1e-6)
    params, keys = gaussians.params, map(jax.random.key, range(60))
    moved = np.stack([perturb(key, gaussians, rate).means for key in keys])
    shifts = moved - np.asarray(params.means)
    cov = np.asarray(covariance(params.quats, jnp.exp(params.log_scales)))[0]
    gate = 1 / (1 + np.exp(100 * (1e-4 - 0.005)))
    transparent = shifts[:, 0:80:2].reshape(-1, 3) / (gate * 5e5 * 1e-6)
    whitened = transparent @ np.linalg.inv(cov)
    samples = len(whitened)
    assert samples == 2400
    assert np.abs(whitened.mean(0)).max() < 4 / np.sqrt(samples)
    assert np.abs(np.cov(whitened.T) - np.eye(3)).max() < 4 * np.sqrt(2 / samples)
    assert np.abs(shifts[:, 1:80:2]).max() < 1e-15
    assert (shifts[:, 80:] == 0).all()
    narrow = cast(gaussians, jnp.float32)
    assert perturb(jax.random.key(0), narrow, rate).means.dtype == jnp.float32


def test_noise_and_penalty_scale_with_the_extent():
    gaussians, rate, key = mixed(), jnp.asarray(1e-4), jax.random.key(1)
    params = gaussians.params
    for unit in (1e-3, 1e3):
        log_scales = params.log_scales + np.log(unit)
        scaled = params.replace(means=params.means * unit, log_scales=log_scales)
        larger = gaussians.replace(params=scaled)
        here, there = mcmc(SETTINGS, 3.0), mcmc(SETTINGS, 3.0 * unit)
        moved = here.perturb(key, gaussians, rate).means - params.means
        found = there.perturb(key, larger, rate * unit).means - larger.params.means
        assert np.abs(moved).max() > 1e-6
        np.testing.assert_allclose(found, moved * unit, rtol=1e-6, atol=1e-12 * unit)
        wanted = here.penalty(gaussians)
        np.testing.assert_allclose(there.penalty(larger), wanted, rtol=1e-9)


def test_relocation_keeps_the_image(report):
    """Eq. 9 preserves the integral of each Gaussian, not its shape."""
    rng = np.random.default_rng(3)
    opacities = rng.uniform(0.2, 0.9, SLOTS)
    opacities[24:] = 0.004
    gaussians = scene_in(first(SLOTS), opacities, 0.25)
    points = np.column_stack([rng.uniform(-1, 1, (SLOTS, 2)), np.full(SLOTS, 3.0)])
    colors = jnp.asarray(rng.uniform(0.5, 1.7, (SLOTS, 4, 3))).at[:, 1:].set(0)
    params = gaussians.params.replace(means=jnp.asarray(points), sh=colors)
    gaussians = gaussians.replace(params=params)
    edit = planned(STILL, jax.random.key(4), gaussians)
    parents = np.asarray(children_of(edit, gaussians, range(SLOTS)))
    assert np.bincount(parents)[:24].max() > 4
    camera = camera_of(45, 29, np.eye(4))

    def image(params, logits):
        params = params.replace(logit_opacities=logits)
        return reference(gaussians.replace(params=params), camera, None)

    logits = params.logit_opacities
    alone = image(params, jnp.where(jnp.asarray(first(24)), logits, -20.0))
    moved = image(edit.params, edit.params.logit_opacities)
    unshared = image(edit.params, logits[parents])
    assert_not_empty(alone["alpha"])
    light = float(jnp.sum(moved["alpha"]) / jnp.sum(alone["alpha"]))
    quality, without = (psnr(i["rgb"], alone["rgb"]) for i in (moved, unshared))
    report("light after relocation", abs(light - 1), 0.05)
    report("relocation, −dB", -quality, -28)
    assert light == pytest.approx(1, rel=0.05)
    assert quality > 28
    assert without < quality - 6
