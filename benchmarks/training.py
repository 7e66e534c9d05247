"""Claim: a held-out photograph is shown well within minutes on two cores.

``python benchmarks/training.py DATASET [IMAGE …]`` trains with `gsjax train --preset
fast`, once for each strategy (or the one of ``--strategy``), with the named images held
out (else every 8th), in a process that has nothing compiled. Kept are PSNR and SSIM of
the held-out views over seconds; compiling counts, measuring does not.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import measure
import numpy as np

from gsjax import files, images
from gsjax.curves import Series, curves

EVERY = 50
STRATEGIES = ("mcmc", "adaptive")


def train(dataset: Path, held_out: list[str], strategy: str, run: Path) -> None:
    """One run, from a cold start."""
    program = [sys.executable, "-m", "gsjax.cli", "train", str(dataset), "-o", str(run)]
    options = ["--preset", "fast", "--strategy", strategy, "--eval-every", str(EVERY)]
    if held_out:
        options += ["--test-images", *held_out]
    cold = {"JAX_ENABLE_COMPILATION_CACHE": "false"}
    subprocess.run([*program, *options], check=True, env={**os.environ, **cold})


def lines(path: Path) -> list[dict]:
    """Of a `.jsonl`."""
    return [json.loads(line) for line in path.read_text().splitlines()]


def main(dataset: Path, held_out: list[str], strategies: list[str]) -> None:
    """Measure, save and draw."""
    rows, series = [], []
    with tempfile.TemporaryDirectory() as folder:
        for strategy in strategies:
            run = Path(folder) / strategy
            train(dataset, held_out, strategy, run)
            found = lines(run / "held_out.jsonl")
            steps = lines(run / "metrics.jsonl")
            last = {key: steps[-1][key] for key in ("compilations", "compile_seconds")}
            rows += [{"strategy": strategy, **record} for record in found]
            rows[-1] |= last
            x, y = np.asarray([(r["seconds"], r["psnr"]) for r in found]).T
            series.append(Series(strategy, x, y))
    name = f"training_{dataset.name}"
    measure.RESULTS.mkdir(exist_ok=True)
    path = measure.RESULTS / f"{name}.json"
    content = {"machine": measure.machine(), "claim": __doc__, "held out": held_out}
    files.write_json(path, {**content, "rows": rows})
    title = f"{dataset.name}: PSNR of what was held out, dB"
    picture = curves(series, title=title, x_label="seconds")
    files.write_file(path.with_suffix(".png"), images.encode_png(picture))
    for row in rows:
        print(row)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("dataset", type=Path)
    parser.add_argument("images", nargs="*")
    parser.add_argument("--strategy", action="append", choices=STRATEGIES)
    given = parser.parse_args()
    main(given.dataset, given.images, given.strategy or list(STRATEGIES))
