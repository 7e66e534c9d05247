"""Error of the cut-offs of a render, as a share of its theoretical bound.

Omitting a set S of Gaussians at a pixel changes the colour by at most
D (1 − Π_S (1 − α)), where D is the colour range including the background.
"""

from functools import cache, partial

import jax
import numpy as np

from gsjax.math.numerics import in_float64
from gsjax.raster.reference import reference_render
from gsjax.raster.render import render
from gsjax.raster.types import RasterConfig
from gsjax.stress import scenes
from gsjax.stress.scenes import BACKGROUND, COMPAT, SLOTS, camera_of
from gsjax.stress.types import Measurement, StressCase

_EXACT = COMPAT.replace(
    alpha_min=1e-7,
    alpha_max=1 - 1e-6,
    transmittance_min=0.0,
    outputs=("rgb",),
    pair_capacity=4096,
)
_ROUNDING = 1e-6
_render = scenes.with_numpy(jax.jit(render, static_argnames="config"))


def _dense():
    """Return fog with objects in it, deep enough for every cut-off to matter."""
    rng = np.random.default_rng(5)
    scales = np.exp(rng.normal(-1.2, 0.7, (SLOTS, 3)))
    opacities = rng.choice([0.01, 0.05, 0.4, 0.995], SLOTS)
    points = scenes.frustum_points(rng)
    return scenes.scene_of(scenes.gaussian_fields(points, scales, opacities))


def _rgb(gaussians, config: RasterConfig) -> np.ndarray:
    return _render(gaussians, camera_of(), background=BACKGROUND, config=config).rgb


@cache
def _exact():
    """Return the image without cut-offs and α [N, H, W], both in float64, and D."""
    with jax.enable_x64(True):
        given = in_float64((_dense().params, camera_of(), BACKGROUND))

        def slow(params, camera, background):
            active = np.ones(SLOTS, bool)
            scene = _dense().replace(params=params, active=active)  # pyright: ignore
            return reference_render(scene, camera, None, background)["rgb"]

        image = np.asarray(jax.jit(slow)(*given))
    alpha = scenes.reference_alpha(_dense(), camera_of())
    # `gaussian_fields` draws colours from this range.
    sh = np.asarray(_dense().params.sh, np.float64)
    spread = 0.283 * np.abs(sh[:, 0]).max() + 1.1 * np.abs(sh[:, 1:]).sum(1).max() + 0.5
    return image, alpha, float(max(spread, 1.0))


def _share(config: RasterConfig, bound: np.ndarray, note: str) -> Measurement:
    """Measure the error as a share of its bound; NaN if the cut-off had no effect."""
    error = np.abs(_rgb(_dense(), config) - _exact()[0]).max(-1)
    share = float(np.max(error / (bound + _ROUNDING)))
    return Measurement(share if error.max() >= 1e-5 else np.nan, note)


def alpha_cutoff(alpha_min: float, _full: bool) -> Measurement:
    """Measure the error of omitting α below ``alpha_min``."""
    _, alpha, spread = _exact()
    left_out = np.where(alpha < alpha_min, alpha, 0)
    bound = spread * (1 - np.prod(1 - left_out, axis=0))
    note = f"bound {bound.max():.1e} at most"
    return _share(_EXACT.replace(alpha_min=alpha_min), bound, note)


def early_stop(rule: str, epsilon: float, _full: bool) -> Measurement:
    """Measure the error of stopping at a transmittance of ``epsilon``."""
    _, alpha, spread = _exact()
    bound = spread * epsilon * np.ones(alpha.shape[1:])
    if rule == "before":
        bound = bound / (1 - alpha.max(0))
    config = _EXACT.replace(transmittance_min=epsilon, stop_rule=rule)
    return _share(config, bound, f"bound {bound.max():.1e} at most")


def alpha_cap(_full: bool) -> Measurement:
    """Measure the error of clipping α to 0.99."""
    _, alpha, spread = _exact()
    bound = spread * np.maximum(alpha - 0.99, 0).sum(0)
    note = f"{int((alpha > 0.99).any(0).sum())} pixels"
    return _share(_EXACT.replace(alpha_max=0.99), bound, note)


def capacity_settings(_full: bool) -> Measurement:
    """Count numbers that change with capacities, size buckets or the order of slots."""
    scene, count = scenes.default_scene(), 0
    wanted = _rgb(scene, _EXACT)
    for changes in (
        {"pair_capacity": 8191},
        {"num_size_buckets": 4, "pair_capacity": 2**18},
        {"visible_capacity": SLOTS},
    ):
        count += scenes.count_unequal(_rgb(scene, _EXACT.replace(**changes)), wanted)
    order = np.random.default_rng(0).permutation(SLOTS)
    shuffled = jax.tree.map(lambda a: a[order], scene)
    count += scenes.count_unequal(_rgb(shuffled, _EXACT), wanted)
    return Measurement(count, "3 capacities, order of slots")


_SHARES = {
    "cut/1 of 255": partial(alpha_cutoff, 1 / 255),
    "cut/1 of 1024": partial(alpha_cutoff, 1 / 1024),
    "cut/1e-4": partial(alpha_cutoff, 1e-4),
    "stop/after 1e-3": partial(early_stop, "after", 1e-3),
    "stop/before 1e-3": partial(early_stop, "before", 1e-3),
    "cap/0.99": alpha_cap,
}
CASES = (
    *(
        StressCase(name, "error, as a share of its bound", 1, measure, full_only=True)
        for name, measure in _SHARES.items()
    ),
    StressCase(
        "settings/of size", "numbers changed", 0, capacity_settings, full_only=True
    ),
)
