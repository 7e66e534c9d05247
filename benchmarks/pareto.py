"""Claim: every setting errs by no more than theory allows, and what each costs.

``python benchmarks/pareto.py [NAME|RUN|PLY …]`` turns one knob at a time (α cut, stop
and its rule, SH degree, tile, chunk, dtype), with a plan for 1/255 beside them, on the
scenes that are built in, and guitar and garden where their data are, or on those named:
milliseconds forward, and of value and gradient, against the errors of the picture and
of the gradient. It exits with 1 if an error is beyond its bound at any pixel looked
at. Fronts that are kept of another kind of device are drawn beside. ``gsjax bench``
does one scene.
"""

from __future__ import annotations

import sys
from pathlib import Path

import as_cli  # noqa: F401
import jax
import measure
import scenes

import gsjax
from gsjax import files, images
from gsjax.bench.pareto import front, pareto, points, stages
from gsjax.bench.scenes import open_trial
from gsjax.bench.sheet import front_picture, table
from gsjax.scene.trials import TRIALS, Trial

REAL = {"guitar": scenes.guitar, "garden": scenes.garden}


def trial_of(name: str) -> Trial:
    """A scene of the benchmarks, or as `gsjax bench` opens it."""
    if name in REAL and not Path(name).exists():
        return Trial(*REAL[name](), background=(0.0, 0.0, 0.0))
    return open_trial(name)


def main() -> int:
    """Measure, save and draw; a scene that is measured again replaces its rows."""
    real = [name for name in REAL if (scenes.DATA / name).is_dir()]
    inside = True
    for name in sys.argv[1:] or [*TRIALS, *real]:
        trial = trial_of(name)
        made = gsjax.plan(
            trial.gaussians, trial.camera, budget=1 / 255, background=trial.background
        )
        rows = pareto(trial, points(trial.gaussians, made))
        print(f"{trial.name}, {trial.camera.width} × {trial.camera.height}")
        print(table(rows, front(rows)))
        size = [trial.camera.width, trial.camera.height]
        measure.save(
            f"pareto_{trial.name}", rows, claim=__doc__, stages=stages(trial),
            size=size, reasons=made.lines(),
        )  # fmt: skip
        others = measure.elsewhere(f"pareto_{trial.name}", size=size)
        picture = front_picture(rows, trial.name, others)
        path = measure.RESULTS / (measure.here(f"pareto_{trial.name}") + ".png")
        files.write_file(path, images.encode_png(picture))
        inside &= all(row["inside"] for row in rows)
        # Each kernel is mapped by itself, and Linux lets a process have 65,530 maps:
        # those of three scenes are more.
        jax.clear_caches()
    return 0 if inside else 1


if __name__ == "__main__":
    sys.exit(main())
