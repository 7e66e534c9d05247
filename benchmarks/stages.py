"""Claim: compositing takes most of the time of a view, and finding the lists little.

``python benchmarks/stages.py [RUN...]`` times the stages of one view, alternating:
projection, binning with its sort, that sort alone, compositing, its backward pass, and
the whole render with and without gradient.
"""

from __future__ import annotations

import sys

import as_cli  # noqa: F401
import compositor
import jax
import measure
import numpy as np
import scenes

import gsjax


def main() -> None:
    """Measure and save."""
    rows = []
    for case in scenes.real_cases(sys.argv[1:]):
        config = gsjax.exact_config(case.gaussians, case.camera)
        functions, *_ = compositor.stages(case, config)
        # Each device sorts its share at the same time.
        share = -(-config.pair_capacity // jax.local_device_count())
        keys = np.random.default_rng(0).integers(0, 2**32, share, np.uint32)
        keys, sort = jax.device_put(keys), jax.jit(jax.numpy.sort)
        functions["sort"] = lambda sort=sort, keys=keys: sort(keys)
        ms = measure.interleaved(functions)
        # Forward within a gradient keeps a little more, a tenth of its time.
        backward = ms["composite v+g"] - ms["composite"]
        parts = {
            "project": ms["project"],
            "bin and sort": ms["bin"],
            "sort of its keys alone": ms["sort"],
            "composite": ms["composite"],
            "composite backward": backward,
            "render": ms["render"],
            "render v+g": ms["render v+g"],
        }
        rows.append(
            {
                "scene": case.name,
                **{f"{name} ms": value for name, value in parts.items()},
                "bin and sort / composite": ms["bin"] / ms["composite"],
            }
        )
    measure.save("stages", rows, claim=__doc__)


if __name__ == "__main__":
    main()
