"""Claim: a run that is killed at any moment goes on to the same bits.

``python benchmarks/kills.py [COUNT]`` trains a small scene with `gsjax train` once
without interruption, then COUNT times (default 20) kills the process (SIGKILL) at a
random moment, from starting Python to writing the result, and goes on with
``--resume``, every fourth time with a second kill on the way. A run that was over
before its moment came does not count, and another takes its place. The Gaussians, the
last checkpoint and the log must be those of the first run, to the bit; seconds apart.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import measure
import numpy as np

from gsjax.scene.caster import DemoDatasetSettings, write_demo_dataset

STEPS, CHECKPOINT_EVERY = 120, 9
VARYING = {"seconds", "compile_seconds", "compilations"}


def command(dataset: Path, run: Path, strategy: str, *more: str) -> list[str]:
    """`gsjax train` of a run with a checkpoint every few steps."""
    program = [sys.executable, "-m", "gsjax.cli", "train", str(dataset), "-o", str(run)]
    settings = [
        "--preset", "fast", "--strategy", strategy, "--steps", str(STEPS),
        "--checkpoint-every", str(CHECKPOINT_EVERY), "--eval-every", "50",
    ]  # fmt: skip
    return [*program, *settings, *more]


def left_behind(run: Path) -> dict:
    """What a finished run consists of, as far as it may not vary."""
    log = [json.loads(x) for x in (run / "metrics.jsonl").read_text().splitlines()]
    last = max((run / "checkpoints").glob("step_*.npz"))
    with np.load(last) as arrays:
        state = {name: arrays[name].tobytes() for name in arrays.files}
    meta = json.loads(state.pop("meta.json"))
    return {
        "splat": (run / "splat.ply").read_bytes(),
        "state": state,
        "step": meta["step"],
        "log": [{k: v for k, v in x.items() if k not in VARYING} for x in log],
        "eval": json.loads((run / "eval.json").read_text())["each"],
    }


def killed_after(arguments: list[str], seconds: float, environment) -> bool:
    """Start, and kill after so many seconds; whether it was still alive then."""
    process = subprocess.Popen(
        arguments, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        process.wait(seconds)
        return False
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        return True


def prepared(folder: Path) -> dict[str, str]:
    """Write a small dataset into ``folder``; the environment of runs that share what
    they compile there.
    """
    size = DemoDatasetSettings(photos=9, width=48, height=32, points=150, seed=0)
    write_demo_dataset(folder / "dataset", size, overwrite=True)
    return {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(folder / "programs")}


def main(count: int) -> None:
    """Measure and save."""
    rng = np.random.default_rng(0)
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        environment = prepared(folder)

        def finish(arguments):
            subprocess.run(arguments, env=environment, check=True, capture_output=True)

        wanted, seconds = {}, {}
        for strategy in ("mcmc", "adaptive"):
            for trial in ("compiling", "whole"):
                run = folder / f"{strategy}-{trial}"
                begun = time.perf_counter()
                finish(command(folder / "dataset", run, strategy))
                seconds[strategy] = time.perf_counter() - begun
                wanted[strategy] = left_behind(run)

        def killed(run, strategy, times):
            """When, and whether the process was alive then: at least once."""
            arguments = command(folder / "dataset", run, strategy, "--resume")
            while True:
                at = list(rng.uniform(0, seconds[strategy], times))
                alive = [killed_after(arguments, t, environment) for t in at]
                if any(alive):
                    return at, alive
                shutil.rmtree(run)

        for index in range(count):
            strategy = ("mcmc", "adaptive")[index % 2]
            run = folder / f"killed-{index}"
            at, alive = killed(run, strategy, 2 if index % 4 == 3 else 1)
            kept = sorted(p.name for p in run.glob("checkpoints/*.npz"))
            finish(command(folder / "dataset", run, strategy, "--resume"))
            rows.append(
                {
                    "strategy": strategy,
                    "killed after s": [round(t, 2) for t in at],
                    "was alive": alive,
                    "checkpoints found": kept,
                    "same bits": left_behind(run) == wanted[strategy],
                }
            )
            print(rows[-1], flush=True)
    measure.save("kills", rows, claim=__doc__)
    same = sum(row["same bits"] for row in rows)
    print(f"{same} of {len(rows)} end with the same bits")
    sys.exit(same != len(rows))


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 20)
