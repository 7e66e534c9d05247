"""Claim: a window of two costs less than three times the order of centres.

``python benchmarks/order.py [RUN...]`` times a picture, and its weighted sum with the
gradient by all parameters of the Gaussians, with each `RasterConfig.order`, counts what
a window misorders, and measures popping when the camera turns.
"""

from __future__ import annotations

import sys
from functools import partial

import as_cli  # noqa: F401
import jax
import jax.numpy as jnp
import measure
import numpy as np
import scenes

import gsjax
from gsjax.bench.popping import popping, turned

PASSES, REPEATS = 3, 5
OUTPUTS = "rgb", "alpha"
WINDOWS, WIDE = (1, 2, 4), (16, 64)
POINTS, FRAMES, DEGREES = 512, 4, 0.25
ORDERS = {
    "center": {},
    **{f"window {w}": {"order": "window", "order_window": w} for w in WINDOWS},
    "pixel": {"order": "pixel"},
}


@partial(jax.jit, static_argnames="config")
def picture(params, gaussians, camera, weights, *, config):
    """Return the picture."""
    del weights
    view = gsjax.render(gaussians.replace(params=params), camera, config)
    return view.rgb, view.misordered


@partial(jax.jit, static_argnames="config")
def gradient(params, gaussians, camera, weights, *, config):
    """Return a weighted sum of the picture, and its gradient."""

    def value(params):
        view = gsjax.render(gaussians.replace(params=params), camera, config)
        return jnp.sum(view.rgb * weights)

    return jax.value_and_grad(value)(params)


def row(case: scenes.Case) -> dict:
    """Return the times of one scene."""
    camera = case.camera
    weights = jax.random.normal(jax.random.key(1), (camera.height, camera.width, 3))
    given = case.gaussians.params, case.gaussians, camera, weights
    config = gsjax.RasterConfig(outputs=OUTPUTS)
    config = gsjax.exact_config(case.gaussians, camera, config)
    functions, cells, exact = {}, {}, None
    for name, changes in reversed(ORDERS.items()):
        mine = config.replace(**changes)
        functions[f"{name} picture"] = partial(picture, *given, config=mine)
        rgb, late = functions[f"{name} picture"]()
        exact = rgb if exact is None else exact
        cells[f"{name} misordered"] = None if late is None else int(late)
        cells[f"{name} difference"] = float(jnp.abs(rgb - exact).mean())
        if name != "pixel":
            functions[f"{name} gradient"] = partial(gradient, *given, config=mine)
    passes = [measure.interleaved(functions, REPEATS) for _ in range(PASSES)]
    for name in functions:
        cells[f"{name} ms"] = float(np.median([one[name] for one in passes]))
        base = f"center {name.split()[-1]}"
        ratios = [one[name] / one[base] for one in passes]
        cells[f"{name} / center"] = float(np.median(ratios))
    cells |= popping_of(case, config)
    return {"scene": case.name, **cells}


def popping_of(case: scenes.Case, config: gsjax.RasterConfig) -> dict:
    """Return the popping of each order, and of wider windows, of 255 levels."""
    rng, camera = np.random.default_rng(0), case.camera
    places = rng.uniform(0, 1, (POINTS, 2)) * (camera.width, camera.height)
    cameras = turned(camera, FRAMES, DEGREES)
    wide = {f"window {w}": {"order": "window", "order_window": w} for w in WIDE}
    found = {}
    for name, changes in {**ORDERS, **wide}.items():
        mine = config.replace(**changes)
        change = popping(case.gaussians, cameras, mine, points=places)
        found[f"{name} popping"] = 255 * float(np.nanmean(change))
    return found


def main() -> None:
    """Measure and save."""
    cases = [x for x in scenes.real_cases(sys.argv[1:]) if x.name != "garden"]
    measure.save("order", [row(case) for case in cases], claim=__doc__)


if __name__ == "__main__":
    main()
