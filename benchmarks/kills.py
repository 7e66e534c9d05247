"""Claim: a run that is killed or interrupted at any moment resumes to the same bits.

``python benchmarks/kills.py [COUNT] [--interrupt]`` trains a small scene once without
interruption, then COUNT times (default 20) kills the process (SIGKILL, or SIGINT with
``--interrupt``) at a random moment between the start of Python and the end, and
continues with ``--resume``; every fourth run is killed twice. Runs that ended before
their moment are repeated. Gaussians, last checkpoint and log must equal those of the
first run, apart from times. After SIGINT the exit status must be 130 within 20 seconds,
without a traceback.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import measure
import numpy as np

from gsjax.synthetic.raycaster import DemoDatasetSettings, write_demo_dataset

STEPS, CHECKPOINT_EVERY = 120, 9
VARYING = {"seconds", "compile_seconds", "compilations"}


def command(dataset: Path, run: Path, strategy: str, *more: str) -> list[str]:
    """Return the `gsjax train` command of a run with frequent checkpoints."""
    program = [
        sys.executable,
        "-m",
        "gsjax.cli.main",
        "train",
        str(dataset),
        "-o",
        str(run),
    ]
    settings = [
        "--preset", "fast", "--strategy", strategy, "--steps", str(STEPS),
        "--checkpoint-every", str(CHECKPOINT_EVERY), "--eval-every", "50",
    ]  # fmt: skip
    return [*program, *settings, *more]


def left_behind(run: Path) -> dict:
    """Return the results of a finished run that must not vary."""
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


class Stopped(NamedTuple):
    """State of a run at a signal: alive then, and ended well afterwards."""

    alive: bool
    good: bool


def stopped_after(
    arguments: list[str], seconds: float, environment, how: signal.Signals
) -> Stopped:
    """Start a run and send a signal after so many seconds."""
    pipe = subprocess.PIPE
    process = subprocess.Popen(
        arguments, env=environment, stdout=subprocess.DEVNULL, stderr=pipe, text=True
    )
    try:
        process.communicate(timeout=seconds)
        return Stopped(False, process.returncode == 0)
    except subprocess.TimeoutExpired:
        process.send_signal(how)
        try:
            _, told = process.communicate(timeout=20)
        except subprocess.TimeoutExpired:
            process.kill()
            return Stopped(True, False)
        if how == signal.SIGKILL:
            return Stopped(True, process.returncode == -signal.SIGKILL)
        # Python handles signals by itself while it starts and after all is written.
        own = process.returncode == -signal.SIGINT and "gsjax" not in told
        done = process.returncode == 0
        good = process.returncode == 130 and "Traceback" not in told
        if not (good or own or done):
            print(process.returncode, told, flush=True)
        return Stopped(not done, good or own or done)


def prepared(folder: Path) -> dict[str, str]:
    """Write a small dataset into ``folder``.

    Returns:
      The environment of runs that share a compilation cache there.
    """
    size = DemoDatasetSettings(photos=9, width=48, height=32, points=150, seed=0)
    write_demo_dataset(folder / "dataset", size, overwrite=True)
    return {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(folder / "programs")}


def main(count: int, how: signal.Signals) -> None:
    """Measure and save."""
    # Background jobs of a shell ignore SIGINT, and their children inherit it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
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

        def stopped(run, strategy, times):
            """Stop a run at random times, at least once while alive."""
            arguments = command(folder / "dataset", run, strategy, "--resume")
            while True:
                at = list(rng.uniform(0, seconds[strategy], times))
                took = [stopped_after(arguments, t, environment, how) for t in at]
                if any(took_it.alive for took_it in took):
                    return at, took
                shutil.rmtree(run)

        for index in range(count):
            strategy = ("mcmc", "adaptive")[index % 2]
            run = folder / f"killed-{index}"
            at, took = stopped(run, strategy, 2 if index % 4 == 3 else 1)
            kept = sorted(p.name for p in run.glob("checkpoints/*.npz"))
            finish(command(folder / "dataset", run, strategy, "--resume"))
            rows.append(
                {
                    "strategy": strategy,
                    f"{how.name} after s": [round(t, 2) for t in at],
                    "was alive": [took_it.alive for took_it in took],
                    "ended well": all(took_it.good for took_it in took),
                    "checkpoints found": kept,
                    "same bits": left_behind(run) == wanted[strategy],
                }
            )
            print(rows[-1], flush=True)
    name = "kills" if how == signal.SIGKILL else "interrupts"
    measure.save(name, rows, claim=__doc__)
    good = sum(row["same bits"] and row["ended well"] for row in rows)
    print(f"{good} of {len(rows)} end with the same bits")
    sys.exit(good != len(rows))


if __name__ == "__main__":
    given = argparse.ArgumentParser()
    given.add_argument("count", type=int, nargs="?", default=20)
    given.add_argument("--interrupt", action="store_true")
    options = given.parse_args()
    main(options.count, signal.SIGINT if options.interrupt else signal.SIGKILL)
