"""What the cut-offs leave out, against what they may: the share of the bound taken.

At a pixel, leaving out a set S changes the colour by at most D (1 − Π_S (1 − α)),
D being the colour range including the background.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.math.numerics import in_float64
from gsjax.raster.reference import reference_render
from gsjax.raster.render import render
from gsjax.raster.types import RasterConfig
from gsjax.stress.scenes import (
    BACKGROUND,
    SLOTS,
    camera_of,
    each_alpha_oracle,
    fields_at,
    frustum,
    scene_of,
    unequal,
    usual,
)
from gsjax.stress.types import Case, Measured

_EXACT = RasterConfig(
    alpha_min=1e-7,
    alpha_max=1 - 1e-6,
    transmittance_min=0.0,
    outputs=("rgb",),
    num_size_buckets=1,
    devices=1,
    pair_capacity=4096,
)
_ROUNDING = 1e-6
_render = jax.jit(render, static_argnames="config")


def _dense():
    """Fog and things in it, deep enough for every cut-off to bite."""
    rng = np.random.default_rng(5)
    scales = np.exp(rng.normal(-1.2, 0.7, (SLOTS, 3)))
    opacities = rng.choice([0.01, 0.05, 0.4, 0.995], SLOTS)
    return scene_of(fields_at(frustum(rng), scales, opacities))


@cache
def _exact():
    """Without cut-offs, in float64: image, α [N, H, W], and the range of colours."""
    camera = camera_of()
    with jax.enable_x64(True):
        given = in_float64((_dense().params, camera, BACKGROUND))

        def slow(params, camera, background):
            active = np.ones(SLOTS, bool)
            scene = _dense().replace(params=params, active=active)  # pyright: ignore
            return reference_render(scene, camera, None, background)["rgb"]

        image = np.asarray(jax.jit(slow)(*given))
    alpha = each_alpha_oracle(_dense(), camera)
    # Colours of `fields_at` are drawn from this range; see there.
    sh = np.asarray(_dense().params.sh, np.float64)
    spread = 0.283 * np.abs(sh[:, 0]).max() + 1.1 * np.abs(sh[:, 1:]).sum(1).max() + 0.5
    return image, alpha, float(max(spread, 1.0))


def _share(config: RasterConfig, bound: np.ndarray) -> float:
    image, _, _ = _exact()
    found = np.asarray(
        _render(_dense(), camera_of(), config, jnp.asarray(BACKGROUND)).rgb
    )
    error = np.abs(found - image).max(-1)
    if error.max() < 1e-5:
        return float("nan")  # the cut-off did not bite: nothing was measured
    return float(np.max(error / (bound + _ROUNDING)))


def cut(alpha_min: float):
    """α below the cut are left out."""

    def measure(full: bool) -> Measured:
        del full
        _, alpha, spread = _exact()
        left_out = np.where(alpha < alpha_min, alpha, 0)
        bound = spread * (1 - np.prod(1 - left_out, axis=0))
        share = _share(_EXACT.replace(alpha_min=alpha_min), bound)
        return Measured(share, f"bound {bound.max():.1e} at most")

    return measure


def stop(rule: str, epsilon: float):
    """Pixels stop at a transmittance of ``epsilon``."""

    def measure(full: bool) -> Measured:
        del full
        _, alpha, spread = _exact()
        bound = spread * epsilon * np.ones(alpha.shape[1:])
        if rule == "before":
            bound = bound / (1 - alpha.max(0))
        share = _share(_EXACT.replace(transmittance_min=epsilon, stop_rule=rule), bound)
        return Measured(share, f"bound {bound.max():.1e} at most")

    return measure


def cap(full: bool) -> Measured:
    """α above the cap are lowered to it."""
    del full
    _, alpha, spread = _exact()
    excess = np.maximum(alpha - 0.99, 0).sum(0)
    return Measured(
        _share(_EXACT.replace(alpha_max=0.99), spread * excess),
        f"{int((alpha > 0.99).any(0).sum())} pixels",
    )


def sizes_of_work(full: bool) -> Measured:
    """Numbers that change with what must not matter: capacities, num_size_buckets, slots."""
    del full
    wanted = _render(usual(), camera_of(), _EXACT, jnp.asarray(BACKGROUND)).rgb
    count = 0
    for changes in (
        {"pair_capacity": 8191},
        {"num_size_buckets": 4, "pair_capacity": 2**18},
        {"visible_capacity": SLOTS},
    ):
        config = _EXACT.replace(**changes)
        out = _render(usual(), camera_of(), config, jnp.asarray(BACKGROUND))
        count += unequal(out.rgb, wanted)
    order = np.random.default_rng(0).permutation(SLOTS)
    shuffled = jax.tree.map(lambda a: a[order], usual())
    out = _render(shuffled, camera_of(), _EXACT, jnp.asarray(BACKGROUND))
    count += unequal(out.rgb, wanted)
    return Measured(count, "3 capacities, order of slots")


_SHARE = "error, as a share of its bound"
CASES = (
    Case("cut/1 of 255", _SHARE, 1, cut(1 / 255), full_only=True),
    Case("cut/1 of 1024", _SHARE, 1, cut(1 / 1024), full_only=True),
    Case("cut/1e-4", _SHARE, 1, cut(1e-4), full_only=True),
    Case("stop/after 1e-3", _SHARE, 1, stop("after", 1e-3), full_only=True),
    Case("stop/before 1e-3", _SHARE, 1, stop("before", 1e-3), full_only=True),
    Case("cap/0.99", _SHARE, 1, cap, full_only=True),
    Case("settings/of size", "numbers changed", 0, sizes_of_work, full_only=True),
)
