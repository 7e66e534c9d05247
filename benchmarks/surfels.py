"""Claim: surfels and the outputs of geometry cost little.

``python benchmarks/surfels.py [RUN...]`` times a picture, and a weighted sum of its
images with the gradient by all parameters of the Gaussians. Surfels alternate with the
ellipsoids from which they were flattened; outputs of geometry alternate with colour
alone, of the same primitive.
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
from gsjax.init.surfels import flattened

PASSES = 5
COLOR = "rgb", "alpha"
ALL = (*COLOR, "depth", "normals", "distortion")
# Name of a way: primitive, ray_depth, outputs, and the way that it is compared with.
WAYS = {
    "ellipsoid": (None, False, COLOR, "ellipsoid"),
    "surfel": ("surfel", True, COLOR, "ellipsoid"),
    "surfel + depth": ("surfel", True, (*COLOR, "depth"), "ellipsoid"),
    "surfel_area": ("surfel_area", True, COLOR, "ellipsoid"),
    "surfel + geometry": ("surfel", True, ALL, "surfel"),
    "ellipsoid + ray depth": (None, True, (*COLOR, "depth"), "ellipsoid"),
    "ellipsoid + geometry": (None, True, ALL, "ellipsoid"),
}


@partial(jax.jit, static_argnames="config")
def picture(params, gaussians, camera, cotangents, *, config):
    """Return the images that the config asks for."""
    del cotangents
    view = gsjax.render(gaussians.replace(params=params), camera, config)
    return {name: getattr(view, name) for name in config.outputs}


@partial(jax.jit, static_argnames="config")
def gradient(params, *given, config):
    """Return a weighted sum of the images, and its gradient."""

    def value(params):
        images = picture(params, *given, config=config)
        return sum(jnp.sum(image * given[-1][k]) for k, image in images.items())

    return jax.value_and_grad(value)(params)


TASKS = {"picture": picture, "gradient": gradient}


def row(case: scenes.Case) -> dict:
    """Return the times of one scene."""
    height, width = case.camera.height, case.camera.width
    key = jax.random.key(1)
    cotangents = {
        name: jax.random.normal(key, (height, width, 3)[: 3 if many else 2])
        for name in ALL
        for many in [name in ("rgb", "normals")]
    }
    functions = {}
    for name, (primitive, ray, outputs, _) in WAYS.items():
        gaussians = flattened(case.gaussians) if primitive else case.gaussians
        config = gsjax.RasterConfig(primitive=primitive, ray_depth=ray, outputs=outputs)
        config = gsjax.exact_config(gaussians, case.camera, config)
        for task, program in TASKS.items():
            given = gaussians.params, gaussians, case.camera, cotangents
            functions[f"{name} {task}"] = partial(program, *given, config=config)
    passes = [measure.interleaved(functions) for _ in range(PASSES)]
    cells = {}
    for name, (*_, base) in WAYS.items():
        for task in TASKS:
            ms = float(np.median([one[f"{name} {task}"] for one in passes]))
            ratios = [one[f"{name} {task}"] / one[f"{base} {task}"] for one in passes]
            cells[f"{name} {task} ms"] = ms
            if name != base:
                cells[f"{name} {task} / {base}"] = float(np.median(ratios))
    return {"scene": case.name, **cells}


def main() -> None:
    """Measure and save."""
    cases = scenes.real_cases(sys.argv[1:])
    measure.save("surfels", [row(case) for case in cases], claim=__doc__)


if __name__ == "__main__":
    main()
