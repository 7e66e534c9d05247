"""Claim: time and memory grow with the pairs a view asks for, not with worse.

``python benchmarks/scaling.py`` renders synthetic shells of 1 k … 1 M Gaussians, at
sizes from 320 × 180 to 1920 × 1080, with room for up to 8 times as many, and up to 8
cameras in a call; forward and gradient, each point in a process of its own so that its
peak of resident memory can be read; fits slopes, and plots. With a GPU, ``--gpu``
measures 0.1, 1 and 3 M Gaussians at 1920 × 1080 instead.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable

import measure
import numpy as np

# This process asks JAX what there is, and leaves the memory to those it starts.
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")

COUNTS = (1_000, 10_000, 100_000, 1_000_000)
SIZES = ((320, 180), (640, 360), (1280, 720), (1920, 1080))


def point(count: int, width: int, height: int, room: int, cameras: int) -> dict:
    """One scene at one size, in this process, with ``room`` times the slots."""
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
    """The camera moved sideways a little, so that a batch is not one view twice."""
    move = np.zeros((4, 4), np.float32)
    move[0, 3] = 0.02 * index
    return dataclasses.replace(camera, viewmat=camera.viewmat + move)


def _peak_gb() -> float:
    """Peak memory: of the first accelerator if there is one, else resident."""
    import jax

    if jax.default_backend() != "cpu":
        return jax.devices()[0].memory_stats()["peak_bytes_in_use"] / 1e9
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


def series(rows: list[dict]) -> dict[str, tuple[list[dict], Callable[[dict], float]]]:
    """The rows in which one thing alone varies, and that thing, by its name."""
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
    """Exponents of time, memory and first calls against each thing (log-log)."""
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


def plot(rows: list[dict], path) -> None:
    """Time and memory against Gaussians and against pixels."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib import ticker

    figure, axes = plt.subplots(1, 5, figsize=(20, 4))

    labels = {
        "Gaussians": "Gaussians (1280 × 720)",
        "pixels": "pixels (100 k)",
        "cameras": "cameras (100 k, 320 × 180)",
        "capacity / active": "capacity / active (100 k, 320 × 180)",
    }
    found = series(rows)
    panels = [
        (axis, *found[name], label) for axis, (name, label) in zip(axes, labels.items())
    ]
    by_count = found["Gaussians"][0]
    for axis, chosen, x, label in panels:
        for key in ("forward ms", "v+g ms"):
            axis.loglog(
                [x(r) for r in chosen], [r[key] for r in chosen], "o-", label=key
            )
        axis.set_xlabel(label)
        axis.set_ylabel("ms")
        axis.legend()
    for key in ("forward GB", "v+g GB"):
        axes[4].loglog(
            [r["Gaussians"] for r in by_count],
            [r[key] for r in by_count],
            "o-",
            label=key,
        )
    axes[4].set_xlabel("Gaussians (1280 × 720)")
    axes[4].set_ylabel("peak memory, GB")
    axes[4].legend()
    for axis in axes:
        axis.grid(True, which="both", alpha=0.3)
        low, high = axis.get_ylim()
        if high < 100 * low:  # powers of ten alone would be too few
            axis.yaxis.set_major_locator(ticker.LogLocator(subs=(1, 2, 3, 5)))
            axis.yaxis.set_major_formatter(ticker.StrMethodFormatter("{x:g}"))
            axis.yaxis.set_minor_formatter(ticker.NullFormatter())
    for axis in axes[2:4]:
        axis.set_xticks([1, 2, 4, 8], labels=["1", "2", "4", "8"])
        axis.minorticks_off()
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def main() -> None:
    """Run every point in its own process, save, fit and plot."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--point", nargs=5, type=int, help="as of `point`")
    parser.add_argument("--gpu", action="store_true")
    options = parser.parse_args()
    if options.point:
        print(json.dumps(point(*options.point)))
        return
    import jax

    if options.gpu == (jax.default_backend() == "cpu"):
        raise SystemExit("--gpu is for accelerators, and for them alone")
    if options.gpu:
        points = [(n, 1920, 1080, 1, 1) for n in (100_000, 1_000_000, 3_000_000)]
    else:
        points = [(n, 1280, 720, 1, 1) for n in COUNTS]
        points += [(100_000, *size, 1, 1) for size in SIZES if size != (1280, 720)]
        points += [(100_000, 320, 180, n, 1) for n in (2, 4, 8)]
        points += [(100_000, 320, 180, 1, n) for n in (2, 4, 8)]
    rows = []
    for values in points:
        command = [sys.executable, __file__, "--point", *map(str, values)]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(f"{values} failed:\n{done.stderr}")
        rows.append(json.loads(done.stdout.splitlines()[-1]))
        print(rows[-1], flush=True)
    measure.save("scaling", rows, claim=__doc__, slopes=slopes(rows))
    if not options.gpu:
        plot(rows, measure.RESULTS / "scaling.png")


if __name__ == "__main__":
    main()
