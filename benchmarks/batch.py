"""Claim: several cameras in one call cost no more than one call each.

``python benchmarks/batch.py [CAMERAS]`` renders slightly shifted views of the garden
(or of its synthetic stand-in), in one call and one by one, alternating; default: 8.
"""

from __future__ import annotations

import argparse
import time

import as_cli  # noqa: F401
import jax
import jax.numpy as jnp
import measure
import scenes
from scaling import shifted

import gsjax


def main() -> None:
    """Measure and save."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cameras", nargs="?", type=int, default=8)
    count = parser.parse_args().cameras
    case = scenes.real_cases()[-1]
    gaussians = case.gaussians
    cameras = [shifted(case.camera, index) for index in range(count)]
    batch = gsjax.stack_cameras(cameras)
    config = gsjax.exact_config(gaussians, batch)

    @jax.jit
    def forward(params, camera):
        return gsjax.render(gaussians.replace(params=params), camera, config).rgb

    both = jax.jit(jax.value_and_grad(lambda *given: jnp.sum(forward(*given) ** 2)))
    rows = []
    for name, function in (("forward", forward), ("v+g", both)):

        def one_by_one(function=function):
            return [
                jax.block_until_ready(function(gaussians.params, camera))
                for camera in cameras
            ]

        def at_once(function=function):
            return function(gaussians.params, batch)

        first = []
        for call in (lambda f=function: f(gaussians.params, cameras[0]), at_once):
            begun = time.perf_counter()
            jax.block_until_ready(call())
            first.append(time.perf_counter() - begun)
        ms = measure.interleaved({"one by one": one_by_one, "at once": at_once})
        rows.append(
            {
                "scene": case.name,
                "what": name,
                "cameras": count,
                **{f"{key} ms": value for key, value in ms.items()},
                "at once / one by one": ms["at once"] / ms["one by one"],
                "first call of one s": first[0],
                "first call of all s": first[1],
            }
        )
    measure.save("batch", rows, claim=__doc__)


if __name__ == "__main__":
    main()
