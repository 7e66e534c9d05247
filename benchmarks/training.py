"""Claim: training reaches a good held-out view within minutes on two cores.

``python benchmarks/training.py DATASET [IMAGE …]`` runs `gsjax train --preset fast`
once for each strategy (or ``--strategy``) without compiled programs, with the named
images held out (default: every 8th). ``--steps``, ``--max-gaussians`` and ``--preset``
change the run. It records PSNR and SSIM of the held-out views over seconds, including
compiling and excluding evaluation, keeps results of other runs, and draws PSNR over
seconds and over Gaussians; ``--draw`` only draws kept results.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import measure

from gsjax.io import images
from gsjax.plots.figures import Series, curves_figure, figure_pixels
from gsjax.runs.folder import run_files
from gsjax.runs.history import read_metrics
from gsjax.runtime import files

# This process only queries JAX; its subprocesses need the memory.
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")

EVERY = 50
LEAST = 0.5  # dB, smallest range of a chart: equal runs differ by up to 0.4
STRATEGIES = ("mcmc", "adaptive")
CHANGES = ("preset", "steps", "max-gaussians")


def train(
    dataset: Path, held_out: list[str], strategy: str, other: list[str], run: Path
) -> None:
    """Train once without compiled programs."""
    program = ["-m", "gsjax.cli.main", "train", str(dataset), "-o", str(run)]
    options = ["--strategy", strategy, "--eval-every", str(EVERY), *other]
    if held_out:
        options += ["--test-images", *held_out]
    else:
        options += ["--test-every", "8"]
    measure.run_cold([*program, *options])


def earlier(stem: str, held_out: list[str], new: list[str]) -> list[dict]:
    """Return kept rows of the same images, except those measured again."""
    if not measure.result_path(stem).exists():
        return []
    told = measure.load_result(stem)
    same = told["held out"] == held_out
    return [row for row in told["rows"] if same and row["strategy"] not in new]


def main(
    dataset: Path, held_out: list[str], strategies: list[str], changes: dict[str, str]
) -> None:
    """Measure, save and draw; ``changes`` are changes to the preset "fast"."""
    stem = f"training_{dataset.name}"
    more = "".join(f", {name} {value}" for name, value in changes.items())
    changes = {"preset": "fast", **changes}
    other = [text for name, value in changes.items() for text in (f"--{name}", value)]
    rows = earlier(stem, held_out, [strategy + more for strategy in strategies])
    machine = measure.machine()
    with tempfile.TemporaryDirectory() as folder:
        for strategy in strategies:
            run = Path(folder) / strategy
            train(dataset, held_out, strategy, other, run)
            found = read_metrics(run_files(run).held_out)
            logged = read_metrics(run_files(run).metrics)[-1]
            last = {key: logged[key] for key in ("compilations", "compile_seconds")}
            rows += [{"strategy": strategy + more, **record} for record in found]
            rows[-1] |= {**last, "date": machine["date"], "cpu": machine["cpu"]}
    content = {"machine": machine, "claim": __doc__, "held out": held_out}
    files.write_json(measure.result_path(stem), {**content, "rows": rows})
    for row in rows:
        print(row)
    draw(dataset.name)


def by(rows: list[dict], key: Callable[[dict], str]) -> dict[str, list[dict]]:
    """Group rows by a key, in order."""
    found: dict[str, list[dict]] = {}
    for row in rows:
        found.setdefault(key(row), []).append(row)
    return found


def draw(name: str) -> None:
    """Draw the kept results of a dataset."""
    stem = f"training_{name}"
    path, told = measure.result_path(stem), measure.load_result(stem)
    rows, held_out = told["rows"], {"held out": told["held out"]}
    others = [
        {**row, "strategy": f"{row['strategy']}, {device}"}
        for device, found in measure.results_elsewhere(stem, **held_out)
        for row in found
    ]
    title = f"{name}: PSNR of what was held out, dB"
    series = over_seconds([*rows, *others])
    write(path.with_suffix(".png"), series, title, "seconds", log_x=True)
    sizes = path.with_name(f"{path.stem}_gaussians.png")
    ends = over_gaussians(rows)
    write(sizes, ends, f"{title}, at the end", "thousand Gaussians", log_x=False)


def over_seconds(rows: list[dict]) -> list[Series]:
    """Return one line per run."""
    runs = by(rows, lambda row: row["strategy"])
    return [line(name, run, "seconds", 1) for name, run in runs.items()]


def over_gaussians(rows: list[dict]) -> list[Series]:
    """Return a line for runs that differ in their largest number of Gaussians only."""
    ends = [run[-1] for run in by(rows, lambda row: row["strategy"]).values()]
    alike = by(ends, lambda row: row["strategy"].split(", max-gaussians")[0])
    several = {name: found for name, found in alike.items() if len(found) > 1}
    for found in several.values():
        found.sort(key=lambda row: row["gaussians"])
    return [line(name, found, "gaussians", 1e-3) for name, found in several.items()]


def line(name: str, rows: list[dict], over: str, unit: float) -> Series:
    """Return PSNR over a column."""
    return Series(name, [unit * r[over] for r in rows], [r["psnr"] for r in rows])


def write(
    path: Path, series: list[Series], title: str, x_label: str, log_x: bool
) -> None:
    """Write a chart of the lines, if there are any."""
    if series:
        size = (720 if len(series) < 4 else 1200, 420)
        figure = curves_figure(series, title=title, x_label=x_label, size=size)
        (axes,) = figure.axes
        if log_x:
            axes.set_xscale("log", nonpositive="mask")
        low, high = axes.get_ylim()
        missing = max(0.0, LEAST - (high - low)) / 2
        axes.set_ylim(low - missing, high + missing)
        files.write_file(path, images.encode_png(figure_pixels(figure)))


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("dataset", type=Path)
    parser.add_argument("images", nargs="*")
    parser.add_argument("--strategy", action="append", choices=STRATEGIES)
    for option in CHANGES:
        parser.add_argument(f"--{option}", dest=option)
    parser.add_argument("--draw", action="store_true")
    given = parser.parse_args()
    chosen = given.strategy or list(STRATEGIES)
    changed = {name: getattr(given, name) for name in CHANGES if getattr(given, name)}
    if changed.get("preset") == "fast":
        del changed["preset"]
    if given.draw:
        draw(given.dataset.name)
    else:
        main(given.dataset, given.images, chosen, changed)
