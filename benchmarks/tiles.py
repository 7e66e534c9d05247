"""Claim: tiles of 8 × 8 pixels are fastest, although smaller ones evaluate less.

``python benchmarks/tiles.py [RUN …]`` composites and renders the scenes of
`compositor.py` with tiles of 4, 8 and 16 pixels, alternating, and counts evaluations (a
Gaussian at a pixel) per contribution to the image; for tiles of 2 it only counts.
"""

from __future__ import annotations

import sys

import as_cli  # noqa: F401
import compositor
import measure
import scenes

import gsjax

TIMED, COUNTED = (4, 8, 16), (2, 4, 8, 16)
SHOWN = ("composite", "composite v+g", "render", "render v+g")


def main() -> None:
    """Measure and save."""
    rows = []
    for case in scenes.real_cases(sys.argv[1:]):
        functions, counts = {}, {}
        for side in COUNTED:
            config = gsjax.exact_config(
                case.gaussians, case.camera, gsjax.RasterConfig(tile_size=side)
            )
            stages, _, evaluations, contributions = compositor.stages(case, config)
            counts[side] = evaluations, contributions
            if side in TIMED:
                functions |= {f"{side} {name}": stages[name] for name in SHOWN}
        ms = measure.interleaved(functions, 7)
        for side, (evaluations, contributions) in counts.items():
            rows.append(
                {
                    "scene": case.name,
                    "tile": side,
                    **{f"{name} ms": ms.get(f"{side} {name}") for name in SHOWN},
                    "evaluations M": evaluations / 1e6,
                    "per contribution": evaluations / contributions,
                }
            )
    measure.save("tiles", rows, claim=__doc__)


if __name__ == "__main__":
    main()
