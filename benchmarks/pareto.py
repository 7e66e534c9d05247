"""Claim: every setting errs by no more than theory allows, and what each costs.

``python benchmarks/pareto.py [NAME|RUN|PLY …]`` turns one knob at a time (α cut, stop
and its rule, SH degree, tile, chunk, dtype), with a plan for 1/255 beside them (unless
``--without-plan``), on the scenes that are built in, and guitar and garden where their
data are, or on those named: milliseconds forward, and of value and gradient, against
the errors of the picture and of the gradient. It exits with 1 if an error is beyond its
bound at any pixel looked at. Fronts that are kept of another kind of device are drawn
beside; with ``--draw NAME …`` nothing is measured, and what is kept is drawn. ``gsjax
bench`` does one scene.
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
    """A scene of the benchmarks, or as `gsjax bench` opens it."""
    if name in REAL and not Path(name).exists():
        return StressScene(*REAL[name](), background=(0.0, 0.0, 0.0))
    return open_bench_scene(name)


def measured(trial: StressScene, planned: bool) -> bool:
    """Measure and save; whether all are inside. ``planned``: with a plan's point."""
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
    """The picture of what is kept of a scene."""
    stem = f"pareto_{name}"
    told = measure.kept(stem)
    others = measure.elsewhere(stem, size=told["size"])
    picture = front_picture(told["rows"], name, others)
    path = measure.path_of(stem).with_suffix(".png")
    files.write_file(path, images.encode_png(picture))


def main() -> int:
    """Measure, save and draw; a scene that is measured again replaces its rows."""
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
        # Each kernel is mapped by itself, and Linux lets a process have 65,530 maps:
        # those of three scenes are more.
        jax.clear_caches()
    return 0 if inside else 1


if __name__ == "__main__":
    sys.exit(main())
