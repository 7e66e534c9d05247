"""Claim: no setting exceeds its theoretical error bound; and the cost of each.

``python benchmarks/pareto.py [--without-plan] [--draw] [NAME|RUN|PLY …]`` changes one
setting at a time (α cutoff, stop and its rule, SH degree, tile, chunk, dtype) and adds
a plan for 1/255, on the built-in scenes and on guitar and garden if present:
milliseconds of image and gradient against their errors. The exit status is 1 if an
error exceeds its bound. Fronts of other kinds of devices are drawn too; ``--draw`` only
draws kept results. ``gsjax bench`` does the same for one scene.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import as_cli  # noqa: F401
import jax
import measure
import scenes

import gsjax
from gsjax.bench.pareto import front, make_points, measure_points, time_stages
from gsjax.bench.report import front_picture, table
from gsjax.bench.scenes import open_bench_scene
from gsjax.io import images
from gsjax.runtime import files
from gsjax.synthetic.stress_scenes import STRESS_SCENES, StressScene

REAL = {"guitar": scenes.guitar, "garden": scenes.garden}


def trial_of(name: str) -> StressScene:
    """Return a scene of the benchmarks, or one that `gsjax bench` opens."""
    if name in REAL and not Path(name).exists():
        return StressScene(*REAL[name](), background=(0.0, 0.0, 0.0))
    return open_bench_scene(name)


def measured(trial: StressScene, planned: bool) -> bool:
    """Measure and save; return whether all points are within their bounds."""
    made = None
    if planned:
        behind = trial.background
        made = gsjax.plan(
            trial.gaussians, trial.camera, budget=1 / 255, background=behind
        )
    rows = measure_points(trial, make_points(trial.gaussians, made))
    print(f"{trial.name}, {trial.camera.width} × {trial.camera.height}")
    print(table(rows, front(rows)))
    measure.save(
        f"pareto_{trial.name}", rows, claim=__doc__, stages=time_stages(trial),
        size=[trial.camera.width, trial.camera.height],
        reasons=made.lines() if made else [],
    )  # fmt: skip
    return all(row["inside"] for row in rows)


def draw(name: str) -> None:
    """Draw the kept result of a scene."""
    stem = f"pareto_{name}"
    told = measure.load_result(stem)
    others = measure.results_elsewhere(stem, size=told["size"])
    picture = front_picture(told["rows"], name, others)
    path = measure.result_path(stem).with_suffix(".png")
    files.write_file(path, images.encode_png(picture))


def main() -> int:
    """Measure, save and draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME|RUN|PLY")
    parser.add_argument("--without-plan", action="store_true")
    parser.add_argument("--draw", action="store_true")
    options = parser.parse_args()
    real = [name for name in REAL if (scenes.DATA / name).is_dir()]
    inside = True
    for name in options.names or [*STRESS_SCENES, *real]:
        if not options.draw:
            trial = trial_of(name)
            inside &= measured(trial, not options.without_plan)
            name = trial.name
        draw(name)
        # Linux limits a process to 65,530 memory maps, and each kernel takes some.
        jax.clear_caches()
    return 0 if inside else 1


if __name__ == "__main__":
    sys.exit(main())
