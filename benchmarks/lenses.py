"""Claim: lenses, the unscented transform and rolling shutters cost little.

``python benchmarks/lenses.py [guitar|garden|SPLATS...]`` times a picture, and its value
with the gradient by all parameters of the Gaussians, alternating with those of the
pinhole. All cameras see almost the same: the fisheye has the polynomial of the tangent.
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
from gsjax.cameras.camera import with_shutter

LENSES = {
    "opencv": (-0.1, 0.02, 1e-3, -1e-3),
    "fisheye": (1 / 3, 2 / 15, 17 / 315, 62 / 2835),
}
TWIST = np.array([0.0, 0.02, 0.0, 0.01, 0.0, 0.0])
PASSES = 5


def through(camera: gsjax.Camera, lens: str) -> gsjax.Camera:
    """Return the camera with a lens of `LENSES`."""
    return gsjax.make_camera(
        viewmat=camera.viewmat,
        K=camera.K,
        width=camera.width,
        height=camera.height,
        lens=lens,
        coefficients=LENSES[lens],
    )


@partial(jax.jit, static_argnames="config")
def picture(params, gaussians, camera, cotangent, *, config):
    """Return a picture."""
    del cotangent
    return gsjax.render(gaussians.replace(params=params), camera, config).rgb


@partial(jax.jit, static_argnames="config")
def gradient(params, *given, config):
    """Return a weighted sum of a picture, and its gradient."""

    def value(params):
        return jnp.sum(picture(params, *given, config=config) * given[-1])

    return jax.value_and_grad(value)(params)


def row(case: scenes.Case) -> dict:
    """Return the times of one scene relative to the pinhole's."""
    plain = gsjax.exact_config(case.gaussians, case.camera)
    unscented = plain.replace(projection="unscented")
    rolling = with_shutter(case.camera, "top_to_bottom", twist=TWIST)
    ways = {
        "pinhole": (case.camera, plain),
        "opencv": (through(case.camera, "opencv"), plain),
        "fisheye": (through(case.camera, "fisheye"), plain),
        "unscented": (case.camera, unscented),
        "rolling": (rolling, plain),
    }
    shape = case.camera.height, case.camera.width, 3
    cotangent = jax.random.normal(jax.random.key(1), shape)
    functions = {}
    for name, (camera, config) in ways.items():
        config = gsjax.exact_config(case.gaussians, camera, config)
        for task, program in (("picture", picture), ("gradient", gradient)):
            given = case.gaussians.params, case.gaussians, camera, cotangent
            call = partial(program, *given, config=config)
            functions[f"{name} {task}"] = call
    passes = [measure.interleaved(functions) for _ in range(PASSES)]
    ms = {name: float(np.median([one[name] for one in passes])) for name in functions}
    cells = {f"pinhole {task} ms": ms[f"pinhole {task}"] for task in TASKS}
    for name in list(ways)[1:]:
        for task in TASKS:
            ratios = [one[f"{name} {task}"] / one[f"pinhole {task}"] for one in passes]
            cells[f"{name} {task}"] = float(np.median(ratios))
    return {"scene": case.name, **cells}


TASKS = "picture", "gradient"


def main() -> None:
    """Measure and save."""
    cases = scenes.real_cases(sys.argv[1:])
    measure.save("lenses", [row(case) for case in cases], claim=__doc__)


if __name__ == "__main__":
    main()
