"""Compare how soon two commits reach a quality in training.

``python benchmarks/before.py COMMIT DATASET [IMAGE …]`` trains on the demo photographs
as `gsjax demo` does, and on DATASET with `--preset fast` and the named images held out
(default: every 8th), with the code of COMMIT and with the working tree, each in a
process without compiled programs. The result is the seconds until a PSNR of the
held-out views is passed; compiling counts, evaluating and loading do not.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import measure

from gsjax.runs.folder import run_files
from gsjax.runs.history import read_metrics

# As `gsjax demo`, with more evaluations; modules have moved since the first commits.
DEMO = """
import sys
from pathlib import Path
try:
    from gsjax.cli.common import start_jax
    from gsjax.runs import demo
except ImportError:
    from gsjax import demo
    from gsjax.commands.common import start_jax
start_jax()
usual = demo.demo_config
demo.demo_config = lambda *given: usual(*given).replace(every_eval=20)
demo.run_demo(Path(sys.argv[1]), demo.DemoSettings(), overwrite=False)
"""


def trained(code: Path, arguments: list[str], run: Path) -> list[dict]:
    """Train once with that code and return the evaluations."""
    measure.run_cold(arguments, code)
    return read_metrics(run_files(run).held_out)


def passed(found: list[dict], psnr: float) -> float:
    """Return the seconds until a PSNR is passed."""
    return next(row["seconds"] for row in found if row["psnr"] >= psnr)


def compared(scene: str, before: list[dict], now: list[dict]) -> list[dict]:
    """Return the seconds to the last three whole decibels that both reach."""
    most = int(min(max(row["psnr"] for row in found) for found in (before, now)))
    rows = []
    for psnr in range(most - 2, most + 1):
        old, new = passed(before, psnr), passed(now, psnr)
        row = {"scene": scene, "psnr": psnr, "seconds before": old, "seconds": new}
        rows.append({**row, "ratio": new / old})
    return rows


def main(commit: str, dataset: Path, held_out: list[str]) -> None:
    """Measure and save."""
    options = ["-m", "gsjax", "train", str(dataset.resolve())]
    options += ["--preset", "fast", "--eval-every", "25"]
    if held_out:
        options += ["--test-images", *held_out]
    else:
        options += ["--test-every", "8"]
    rows, curves = [], {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        codes = {
            "before": measure.code_of(commit, folder / "code"),
            "now": measure.ROOT,
        }
        for state, code in codes.items():
            demo, run = folder / f"demo_{state}", folder / f"run_{state}"
            turned = ["-c", DEMO, str(demo)]
            curves[f"demo {state}"] = trained(code, turned, demo / "run")
            arguments = [*options, "-o", str(run)]
            curves[f"{dataset.name} {state}"] = trained(code, arguments, run)
    for scene in ("demo", dataset.name):
        rows += compared(scene, curves[f"{scene} before"], curves[f"{scene} now"])
    more = {"commit": commit, "held out": held_out, "curves": curves}
    measure.save("before", rows, claim=__doc__, **more)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("commit")
    parser.add_argument("dataset", type=Path)
    parser.add_argument("images", nargs="*")
    given = parser.parse_args()
    main(given.commit, given.dataset, given.images)
