"""Claim: a held-out photograph is shown well within minutes on two cores.

``python benchmarks/training.py DATASET [IMAGE …]`` trains with `gsjax train --preset
fast`, once for each strategy (or the one of ``--strategy``), with the named images held
out (else every 8th), in a process that has nothing compiled; with ``--steps N`` so many
steps, ``--max-gaussians N`` no more Gaussians, ``--preset NAME`` another preset. Residuals
are PSNR and SSIM of the held-out views over seconds; compiling counts, measuring does
not. What was kept of other runs of that dataset stays. Drawn are PSNR over seconds,
with the runs that are kept of another kind of device, and that of the ends over
Gaussians where runs differ in these alone; with ``--draw`` of what is kept.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import measure

from gsjax.io import images
from gsjax.plots.curves import Series, curves
from gsjax.runs.folder import run_files
from gsjax.runs.history import read_metrics
from gsjax.runtime import files

# This process asks JAX what there is, and leaves the memory to those it starts.
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")

EVERY = 50
LEAST = 0.5  # dB that a picture spans: runs that differ by nothing are 0.4 apart
STRATEGIES = ("mcmc", "adaptive")
CHANGES = ("preset", "steps", "max-gaussians")


def train(
    dataset: Path, held_out: list[str], strategy: str, other: list[str], run: Path
) -> None:
    """One run, from a cold start."""
    program = ["-m", "gsjax.cli.main", "train", str(dataset), "-o", str(run)]
    options = ["--strategy", strategy, "--eval-every", str(EVERY), *other]
    if held_out:
        options += ["--test-images", *held_out]
    measure.run_cold([*program, *options])


def earlier(stem: str, held_out: list[str], new: list[str]) -> list[dict]:
    """Rows of an earlier result, of the same images, but for those measured anew."""
    if not measure.path_of(stem).exists():
        return []
    told = measure.kept(stem)
    same = told["held out"] == held_out
    return [row for row in told["rows"] if same and row["strategy"] not in new]


def main(
    dataset: Path, held_out: list[str], strategies: list[str], changes: dict[str, str]
) -> None:
    """Measure, save and draw; ``changes`` to the preset "fast", by their options."""
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
    files.write_json(measure.path_of(stem), {**content, "rows": rows})
    for row in rows:
        print(row)
    draw(dataset.name)


def by(rows: list[dict], key: Callable[[dict], str]) -> dict[str, list[dict]]:
    """Rows of a key together, in their order."""
    found: dict[str, list[dict]] = {}
    for row in rows:
        found.setdefault(key(row), []).append(row)
    return found


def draw(name: str) -> None:
    """Pictures of what is kept of a dataset."""
    stem = f"training_{name}"
    path, told = measure.path_of(stem), measure.kept(stem)
    rows, held_out = told["rows"], {"held out": told["held out"]}
    others = [
        {**row, "strategy": f"{row['strategy']}, {device}"}
        for device, found in measure.elsewhere(stem, **held_out)
        for row in found
    ]
    title = f"{name}: PSNR of what was held out, dB"
    series = over_seconds([*rows, *others])
    write(path.with_suffix(".png"), series, title, "seconds", log_x=True)
    sizes = path.with_name(f"{path.stem}_gaussians.png")
    ends = over_gaussians(rows)
    write(sizes, ends, f"{title}, at the end", "thousand Gaussians", log_x=False)


def over_seconds(rows: list[dict]) -> list[Series]:
    """A line a run."""
    runs = by(rows, lambda row: row["strategy"])
    return [line(name, run, "seconds", 1) for name, run in runs.items()]


def over_gaussians(rows: list[dict]) -> list[Series]:
    """A line for runs that differ in their most Gaussians alone: the ends of each."""
    ends = [run[-1] for run in by(rows, lambda row: row["strategy"]).values()]
    alike = by(ends, lambda row: row["strategy"].split(", max-gaussians")[0])
    several = {name: found for name, found in alike.items() if len(found) > 1}
    for found in several.values():
        found.sort(key=lambda row: row["gaussians"])
    return [line(name, found, "gaussians", 1e-3) for name, found in several.items()]


def line(name: str, rows: list[dict], over: str, unit: float) -> Series:
    """PSNR over one of what was kept."""
    return Series(name, [unit * r[over] for r in rows], [r["psnr"] for r in rows])


def write(
    path: Path, series: list[Series], title: str, x_label: str, log_x: bool
) -> None:
    """Write a picture of the lines, if there are any."""
    if series:
        # The names of the lines stand beside the title.
        size = (720 if len(series) < 4 else 1200, 420)
        picture = curves(
            series, title=title, x_label=x_label, size=size, log_x=log_x, min_y_span=LEAST
        )
        files.write_file(path, images.encode_png(picture))


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
