"""Claim: materialising and dividing the projection pays, and changes no visible bit.

``python benchmarks/projecting.py [RUN...]`` times image and gradient, alternating: as
is; without `materialize`, so that masks and derivatives are recomputed wherever they
are used; without `shard_rows`, so that every device projects all ranks; and always
divided. Scenes of degree 0 are timed again with random bands up to degree 3. It reports
compile times and the differences of images and gradients too.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from contextlib import ExitStack
from unittest import mock

import as_cli  # noqa: F401
import jax
import jax.numpy as jnp
import measure
import numpy as np
import scenes

import gsjax
from gsjax.raster import render_camera
from gsjax.raster.lists.depth_order import depth_order
from gsjax.raster.primitives import ellipsoid
from gsjax.runtime.devices import replicate, shard_rows


def unchanged(values, *_, **__):
    """Return the values: the replacement of a function that is left out."""
    return values


def order_in_parts(z, *given):
    """Return `depth_order` divided among devices."""
    order, count = depth_order(z, *given)
    devices = jax.local_device_count()
    return shard_rows(order, devices, fill=z.shape[0]), count


# Replacements: (module, name, value).
WAYS = {
    "as it is": [],
    "not once": [
        (ellipsoid, "materialize_mask", unchanged),
        (ellipsoid, "materialize", unchanged),
    ],
    "not in parts": [(render_camera, "shard_rows", unchanged)],
    "always in parts": [(render_camera, "depth_order", order_in_parts)],
}


def with_bands(case: scenes.Case, degree: int) -> scenes.Case:
    """Return the scene with small random coefficients up to a degree."""
    params = case.gaussians.params
    count = (degree + 1) ** 2 - 1
    shape = (case.gaussians.capacity, count, 3)
    sh = 0.02 * jax.random.normal(jax.random.key(5), shape)
    sh = jnp.concatenate([params.sh[:, :1], sh], axis=1)
    gaussians = case.gaussians.replace(params=dataclasses.replace(params, sh=sh))
    return case._replace(name=f"{case.name}, degree {degree}", gaussians=gaussians)


def row(case: scenes.Case) -> dict:
    """Return the times of one scene relative to the unchanged code."""
    scene, camera = replicate(case.gaussians), case.camera
    config = gsjax.exact_config(scene, camera)
    cotangent = jax.random.normal(jax.random.key(1), (camera.height, camera.width, 3))

    def render(params):
        return gsjax.render(scene.replace(params=params), camera, config).rgb

    programs = {
        "forward": render,
        "v+g": jax.value_and_grad(lambda params: jnp.sum(render(params) * cotangent)),
    }
    functions, found, seconds = {}, {}, {}
    for way, changes in WAYS.items():
        jax.clear_caches()
        for key, function in programs.items():
            with ExitStack() as patches:
                for change in changes:
                    patches.enter_context(mock.patch.object(*change))
                lowered = jax.jit(function).lower(scene.params)
            start = time.perf_counter()
            compiled = lowered.compile()
            seconds[key, way] = time.perf_counter() - start
            functions[f"{key}, {way}"] = lambda run=compiled: run(scene.params)
            found[key, way] = compiled(scene.params)
    ms = measure.interleaved(functions, 21)
    told = {
        "scene": case.name,
        "SH degree": scene.sh_degree,
        "forward ms": ms["forward, as it is"],
        "v+g ms": ms["v+g, as it is"],
    }
    for key, way in seconds:
        if way == "as it is":
            continue
        usual, changed = (key, "as it is"), (key, way)
        told[f"{key} as it is / {way}"] = ms[f"{key}, as it is"] / ms[f"{key}, {way}"]
        told[f"{key} compiling as it is / {way}"] = seconds[usual] / seconds[changed]
        told[f"{key} differs from {way}"] = relative(found[usual], found[changed])
    return told


def relative(a, b) -> float:
    """Return the relative L2 difference over all leaves."""
    pairs = zip(
        map(np.asarray, jax.tree.leaves(a)), map(np.asarray, jax.tree.leaves(b))
    )
    squares = [(np.sum((x - y) ** 2), np.sum(x**2)) for x, y in pairs]
    return float(np.sqrt(np.divide(*np.sum(squares, axis=0))))


def main() -> None:
    """Measure and save."""
    rows = []
    for case in scenes.real_cases(sys.argv[1:]):
        cases = [case]
        if case.gaussians.sh_degree == 0:
            cases.append(with_bands(case, 3))
        for one in cases:
            rows.append(row(one))
            measure.save("projecting", rows, claim=__doc__)


if __name__ == "__main__":
    main()
