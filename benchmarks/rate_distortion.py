"""Claim: smaller files than foreign ones at equal quality, within the stated goals.

``python benchmarks/rate_distortion.py RUN|PLY...`` compresses scenes for some losses
and for a size, as .sog and .spz, with and without fine-tuning, and compares them with a
plain PLY and with the SOG and SPZ files that PlayCanvas' splat-transform makes from it.
All files are read back and drawn from the held-out views. A scene is named by the last
part of its path, or as NAME=PATH. ``--whole RUN`` runs ``gsjax compress`` for one run
in a process of its own, for its time and memory. ``--draw`` draws the kept
result only. Scenes that are not passed keep their results. The tool needs ``npm``, see
``formats.py``; its files NAME.sog and NAME.spz are kept in the folder of ``--tool``,
and taken from there. Without a GPU its SOG of degree 3 takes a quarter of an hour for
30,000 Gaussians, and is left out beyond 60,000.

The exit status is 1 if a goal is exceeded, or if the file for the loss of a foreign SOG
is larger than that.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import as_cli  # noqa: F401
import formats
import jax
import measure
import numpy as np

import gsjax
from gsjax.compression.importance import measure_importance, sample_cameras
from gsjax.compression.measure import Judge
from gsjax.compression.quantise import as_gaussians, make_source, rows_of
from gsjax.compression.search import UnreachableError, search
from gsjax.compression.types import Goal, Quality
from gsjax.runs.compression import compression_inputs, run_finetuning
from gsjax.runs.scene_source import is_run
from gsjax.train.config import render_mode_of

LOSSES, STEPS = (0.1, 0.3, 1.0), 300
FOREIGN = ".sog", ".spz"
MOST = 60_000  # Gaussians with harmonics: the tool clusters more for hours


def scene_rows(name: str, path: Path, tool: formats.Tool, folder: Path) -> list[dict]:
    """Return sizes and qualities of one scene in all ways."""
    inputs = compression_inputs(path)
    look = inputs.config, inputs.background
    table = rows_of(inputs.gaussians)
    scene = as_gaussians(table)
    judge = Judge(scene, inputs.held_out, *look)
    before = judge.judge(scene)
    importance = measure_importance(scene, sample_cameras(inputs.cameras), *look)
    sources = {suffix: make_source(table, importance, suffix) for suffix in FOREIGN}
    count = int(gsjax.num_active(inputs.gaussians))
    degree = inputs.gaussians.sh_degree
    rows = []

    def add(way: str, size: int, quality: Quality, goal: str = "", met: bool = True):
        same = quality.psnr_before == np.inf
        rows.append(
            {
                "scene": name, "Gaussians": count, "degree": degree, "way": way,
                "goal": goal, "bytes": size, "PSNR": quality.psnr,
                "SSIM": quality.ssim, "loss": quality.loss(before), "met": met,
                "PSNR against before": None if same else quality.psnr_before,
            }
        )  # fmt: skip
        print(rows[-1], flush=True)

    plain = folder / f"{name}.ply"
    gsjax.save(plain, inputs.gaussians, overwrite=True)
    add("plain PLY", plain.stat().st_size, before)
    foreign = {}
    for suffix in FOREIGN:
        if suffix == ".sog" and degree and count > MOST:
            continue
        out = folder / f"{name}{suffix}"
        if not out.exists() and (fault := tool.convert(plain, out)):
            sys.exit(fault)
        quality = judge.judge(gsjax.load(out))
        foreign[suffix] = out.stat().st_size, quality
        add(f"splat-transform {suffix}", *foreign[suffix])

    def ours(suffix: str, goal: Goal, label: str, tuned=None):
        mode = render_mode_of(inputs.config)
        ((_, limit),) = goal.limits.items()
        way = f"gsjax {suffix}" + f", {STEPS} steps" * (tuned is not None)
        try:
            found = search(sources[suffix], judge, before, goal, mode, tuned)
        except UnreachableError as error:
            print(f"{way}, {label}: {error}")
            rows.append(dict.fromkeys(rows[0]) | {"scene": name, "way": way})
            rows[-1] |= {"goal": label, "met": False}
            return None
        add(way, found.size, found.quality, label, found.value <= limit)
        return found

    half = plain.stat().st_size // 50  # if the loss below is not reached
    for suffix in FOREIGN:
        for loss in LOSSES:
            found = ours(suffix, Goal(max_loss=loss), f"{loss} dB")
            if found is not None and (suffix, loss) == (".sog", 0.3):
                half = found.size // 2
    ours(".sog", Goal(max_size=half), f"{half} bytes")
    if ".sog" in foreign:
        size, quality = foreign[".sog"]
        least = max(quality.loss(before), 0.005)
        label = f"{least:.3f} dB, of the foreign SOG"
        found = ours(".sog", Goal(max_loss=least), label)
        rows[-1]["met"] &= found is not None and found.size <= size
    if is_run(path):
        tuned = run_finetuning(path, STEPS)
        ours(".sog", Goal(max_loss=0.3), "0.3 dB", tuned)
    return rows


def whole_process(path: Path) -> dict:
    """Return time and memory of the command, and the time to read its file."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "scene.sog"
        command = [sys.executable, "-m", "gsjax", "compress", path, "-o", out]
        start = time.perf_counter()
        measure.run_cold([str(word) for word in command[1:]])
        seconds = time.perf_counter() - start
        used = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
        code = (
            "import sys, time, gsjax; load = gsjax.load; start = time.perf_counter();"
            "load(sys.argv[1]); print(time.perf_counter() - start)"
        )
        read = [
            float(subprocess.check_output([sys.executable, "-c", code, out]))
            for _ in range(3)
        ]
    return {"run": path.name, "seconds": seconds, "MB": used * 1024 / 1e6, "read": read}


def draw() -> None:
    """Draw size against held-out PSNR, one panel a scene."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    rows = measure.load_result("rate_distortion")["rows"]
    names = list(dict.fromkeys(row["scene"] for row in rows))
    figure, axes = plt.subplots(
        2, -(-len(names) // 2), figsize=(12, 7), layout="constrained", squeeze=False
    )
    colors = {
        way: f"C{k}" for k, way in enumerate(dict.fromkeys(r["way"] for r in rows))
    }
    for name, axis in zip(names, axes.flat):
        some = [row for row in rows if row["scene"] == name]
        ways = dict.fromkeys(row["way"] for row in some)
        key = "PSNR" if some[0]["PSNR"] is not None else "PSNR against before"
        for way in ways:
            points = [r for r in some if r["way"] == way and r[key] is not None]
            points.sort(key=lambda row: row["bytes"])
            x = [row["bytes"] / 1e6 for row in points]
            mark = "o-" if way.startswith("gsjax") else "s"
            y = [row[key] for row in points]
            axis.plot(x, y, mark, color=colors[way], label=way, markersize=5)
        axis.set_xscale("log")
        kept = f"{some[0]['Gaussians']:,} Gaussians, degree {some[0]['degree']}"
        axis.set_title(f"{name}: {kept}", fontsize=9)
        told = "held-out photographs" if key == "PSNR" else "the scene before"
        axis.set(xlabel="MB", ylabel=f"PSNR against {told}, dB")
        axis.grid(alpha=0.3)
    for axis in axes.flat[len(names) :]:
        axis.set_axis_off()
    handles = {}
    for axis in axes.flat:
        handles |= dict(zip(*axis.get_legend_handles_labels()[::-1]))
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4)
    figure.savefig(measure.result_path("rate_distortion").with_suffix(".png"), dpi=110)


def main() -> int:
    """Measure, save and draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", metavar="[NAME=]RUN|PLY")
    parser.add_argument("--whole", type=Path, metavar="RUN")
    parser.add_argument("--tool", type=Path, metavar="FOLDER")
    parser.add_argument("--draw", action="store_true")
    given = parser.parse_args()
    if given.draw:
        draw()
        return 0
    warnings.simplefilter("ignore")  # of rounding
    paths = {}
    for word in given.scenes:
        name, _, path = word.rpartition("=")
        paths[name or Path(path).stem] = Path(path)
    whole = whole_process(given.whole) if given.whole else None
    kept = measure.result_path("rate_distortion")
    told = measure.load_result("rate_distortion") if kept.exists() else {"rows": []}
    rows = [row for row in told["rows"] if row["scene"] not in paths]
    with tempfile.TemporaryDirectory() as folder:
        folder = given.tool or Path(folder)
        tool = formats.Tool(folder)
        package = tool.package
        for name, path in paths.items():
            rows += scene_rows(name, path, tool, folder)
            jax.clear_caches()
    whole = whole or told.get("whole")
    measure.save("rate_distortion", rows, claim=__doc__, package=package, whole=whole)
    draw()
    return int(not all(row["met"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
