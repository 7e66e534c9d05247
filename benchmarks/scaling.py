"""Claim: time and memory grow at most linearly with the pairs of a view.

``python benchmarks/scaling.py [--side-by-side N] [--draw]`` renders synthetic shells of
1 k to 1 M Gaussians (3 M on accelerators) at 320 × 180 to 1920 × 1080, with up to 8
times the capacity and up to 8 cameras per call, forward and gradient. Each point runs
in its own process, so that its peak memory can be read. It fits slopes and plots them
with kept results of other devices. ``--side-by-side`` compiles N points in parallel
first; first calls then take longer.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import measure
import numpy as np

# This process only queries JAX; its subprocesses need the memory.
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")

COUNTS = (1_000, 10_000, 100_000, 1_000_000)
SIZES = ((320, 180), (640, 360), (1280, 720), (1920, 1080))


def point(count: int, width: int, height: int, room: int, cameras: int) -> dict:
    """Measure one scene at one size in this process, with ``room`` times the slots."""
    import as_cli  # noqa: F401
    import jax
    import jax.numpy as jnp
    import scenes

    import gsjax

    case = scenes.shell(count, width, height)
    gaussians = gsjax.grow(case.gaussians, room * case.gaussians.capacity)
    camera = case.camera
    if cameras > 1:
        camera = gsjax.stack_cameras([shifted(camera, i) for i in range(cameras)])
    jax.block_until_ready(gaussians.params.means)
    start = time.perf_counter()
    config = gsjax.exact_config(gaussians, camera)
    fitting = time.perf_counter() - start
    render = jax.jit(gsjax.render, static_argnames="config")
    start = time.perf_counter()
    result = jax.block_until_ready(render(gaussians, camera, config=config))
    first = time.perf_counter() - start
    repeats = 3 if count >= 1_000_000 else 7
    forward = measure.time_ms(lambda: render(gaussians, camera, config=config), repeats)
    forward_peak = _peak_gb()
    target = jnp.full((height, width, 3), 0.5)

    @jax.jit
    def gradient(params, camera):
        def loss(params):
            rgb = gsjax.render(gaussians.replace(params=params), camera, config).rgb
            return jnp.mean((rgb - target) ** 2)

        return jax.value_and_grad(loss)(params)

    start = time.perf_counter()
    jax.block_until_ready(gradient(gaussians.params, camera))
    first_gradient = time.perf_counter() - start
    both = measure.time_ms(lambda: gradient(gaussians.params, camera), repeats)
    return {
        "Gaussians": count,
        "width": width,
        "height": height,
        "room": room,
        "cameras": cameras,
        "devices": jax.local_device_count(),
        "visible": int(result.demand.visible),
        "pairs": int(result.demand.pairs),
        "alpha mean": float(jnp.mean(result.alpha)),
        "forward ms": float(np.median(forward)),
        "v+g ms": float(np.median(both)),
        "forward GB": forward_peak,
        "v+g GB": _peak_gb(),
        "exact_config s": fitting,
        "first forward s": first,
        "first v+g s": first_gradient,
    }


def shifted(camera, index: int):
    """Move a camera sideways a little, so that the views of a batch differ."""
    move = np.zeros((4, 4), np.float32)
    move[0, 3] = 0.02 * index
    return dataclasses.replace(camera, viewmat=camera.viewmat + move)


def _peak_gb() -> float:
    """Return the peak memory of the first accelerator, or of the process."""
    import jax

    if jax.default_backend() != "cpu":
        return jax.devices()[0].memory_stats()["peak_bytes_in_use"] / 1e9
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


def points(accelerator: bool) -> list[tuple[int, int, int, int, int]]:
    """Return the arguments of `point`; one varies at a time."""
    counts = (*COUNTS, 3_000_000) if accelerator else COUNTS
    sizes = SIZES[::3] if accelerator else SIZES
    more = (8,) if accelerator else (2, 4, 8)
    found = [(100_000, *size, 1, 1) for size in sizes if size != (1280, 720)]
    found += [(100_000, 320, 180, n, 1) for n in more]
    found += [(100_000, 320, 180, 1, n) for n in more]
    return found + [(n, 1280, 720, 1, 1) for n in counts]  # the largest last


def measured(values: tuple[int, ...], compiled: str | None = None) -> dict:
    """Run `point` in its own process; ``compiled`` is a compilation cache.

    Raises:
      SystemExit: if it failed.
    """
    more = {}
    if compiled:
        more = {
            "JAX_COMPILATION_CACHE_DIR": compiled,
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        }
    command = [sys.executable, __file__, "--point", *map(str, values)]
    done = subprocess.run(
        command, capture_output=True, text=True, env={**os.environ, **more}
    )
    if done.returncode:
        raise SystemExit(f"{values} failed:\n{done.stderr}")
    return json.loads(done.stdout.splitlines()[-1])


def compiled_before(wanted: list[tuple[int, ...]], at_once: int) -> Iterator[dict]:
    """Yield rows; first calls are timed while ``at_once`` compile in parallel."""

    def begun(values: tuple[int, ...]) -> dict[str, float]:
        try:
            row = measured(values, folder)
        except SystemExit:  # it may fit into memory alone
            return {}
        return {key: row[key] for key in row if key.endswith(" s")}

    with tempfile.TemporaryDirectory() as folder:
        with ThreadPoolExecutor(at_once) as pool:
            first = list(pool.map(begun, wanted))
        for values, cold in zip(wanted, first):
            yield {**measured(values, folder), **cold}


def series(rows: list[dict]) -> dict[str, tuple[list[dict], Callable[[dict], float]]]:
    """Return the rows in which one quantity varies, and that quantity, by name."""
    plain = [row for row in rows if row["room"] == row["cameras"] == 1]
    small = [row for row in rows if row["width"] == 320]
    wide = [row for row in plain if row["width"] == 1280] or plain
    sizes = [row for row in plain if row["Gaussians"] == 100_000]
    return {
        "Gaussians": (wide, lambda row: row["Gaussians"]),
        "pixels": (
            sorted(sizes, key=lambda row: row["width"]),
            lambda row: row["width"] * row["height"],
        ),
        "pairs": (
            [row for row in rows if row["pairs"] > 10_000 and row["room"] == 1],
            lambda row: row["pairs"],
        ),
        "cameras": (
            [row for row in small if row["room"] == 1], lambda row: row["cameras"]
        ),
        "capacity / active": (
            [row for row in small if row["cameras"] == 1], lambda row: row["room"]
        ),
    }  # fmt: skip


def slopes(rows: list[dict]) -> dict[str, dict[str, float]]:
    """Return log-log exponents of time, memory and first calls by quantity."""
    measured = ("forward ms", "v+g ms", "v+g GB", "first forward s", "first v+g s")
    return {
        name: {
            key: float(np.polyfit(np.log([x(row) for row in chosen]),
                                  np.log([row[key] for row in chosen]), 1)[0])
            for key in measured
        }
        for name, (chosen, x) in series(rows).items()
        if len({x(row) for row in chosen}) > 1
    }  # fmt: skip


def plot(kept: list[tuple[str, list[dict]]], path) -> None:
    """Plot time and memory by quantity, one line per device."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib import ticker

    labels = {
        "Gaussians": "Gaussians (1280 × 720)",
        "pixels": "pixels (100 k)",
        "cameras": "cameras (100 k, 320 × 180)",
        "capacity / active": "capacity / active (100 k, 320 × 180)",
    }
    panels = [(name, label, "ms") for name, label in labels.items()]
    panels.append(("Gaussians", labels["Gaussians"], "GB"))
    figure, axes = plt.subplots(1, 5, figsize=(22, 4.4))
    for axis, (name, label, unit) in zip(axes, panels):
        for place, (device, rows) in enumerate(kept):
            chosen, x = series(rows)[name]
            for key, marks in (("forward", "o--"), ("v+g", "o-")):
                values = [row[f"{key} {unit}"] for row in chosen]
                label_of = f"{key}, {device}"
                at = [x(row) for row in chosen]
                axis.loglog(at, values, marks, color=f"C{place}", label=label_of)
        axis.set_xlabel(label)
        axis.set_ylabel(unit if unit == "ms" else "peak memory, GB")
        axis.grid(True, which="both", alpha=0.3)
        low, high = axis.get_ylim()
        if high < 100 * low:  # powers of ten alone are too few
            axis.yaxis.set_major_locator(ticker.LogLocator(subs=(1, 2, 3, 5)))
            axis.yaxis.set_major_formatter(ticker.StrMethodFormatter("{x:g}"))
            axis.yaxis.set_minor_formatter(ticker.NullFormatter())
    for axis in axes[2:4]:
        axis.set_xticks([1, 2, 4, 8], labels=["1", "2", "4", "8"])
        axis.minorticks_off()
    figure.legend(*axes[0].get_legend_handles_labels(), loc="upper center", ncols=4)
    figure.tight_layout(rect=(0, 0, 1, 0.92))
    figure.savefig(path, dpi=110)


def draw() -> None:
    """Plot the kept results of every kind of device."""
    told = measure.load_result("scaling")
    mine = measure.device_name(told["machine"]), told["rows"]
    others = measure.results_elsewhere("scaling")
    plot([mine, *others], measure.result_path("scaling").with_suffix(".png"))


def main() -> None:
    """Run every point, save, fit and plot."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--point", nargs=5, type=int, help="arguments of `point`")
    parser.add_argument("--side-by-side", type=int, default=1)
    parser.add_argument("--draw", action="store_true", help="draw kept results only")
    options = parser.parse_args()
    if options.point:
        print(json.dumps(point(*options.point)))
        return
    if not options.draw:
        import jax

        wanted = points(jax.default_backend() != "cpu")
        found = map(measured, wanted)
        if options.side_by_side > 1:
            found = compiled_before(wanted, options.side_by_side)
        rows = []
        for row in found:
            rows.append(row)
            measure.save("scaling", rows, claim=__doc__, slopes=slopes(rows))
    draw()


if __name__ == "__main__":
    main()
