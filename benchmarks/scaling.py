"""Claim: time and memory grow with the pairs a view asks for, not with worse.

``python benchmarks/scaling.py`` renders synthetic shells of 1 k … 1 M Gaussians, at
sizes from 320 × 180 to 1920 × 1080, forward and gradient, each point in a process of
its own so that its peak of resident memory can be read; fits slopes, and plots. With a
GPU, ``--gpu`` measures 0.1, 1 and 3 M Gaussians at 1920 × 1080 instead.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time

import measure
import numpy as np

COUNTS = (1_000, 10_000, 100_000, 1_000_000)
SIZES = ((320, 180), (640, 360), (1280, 720), (1920, 1080))


def point(count: int, width: int, height: int) -> dict:
    """One scene at one size, in this process."""
    import gsjax

    gsjax.use_all_cores(queued=False)
    import jax
    import jax.numpy as jnp
    import scenes

    case = scenes.shell(count, width, height)
    gaussians, camera = case.gaussians, case.camera
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


def _peak_gb() -> float:
    """Peak memory: of the first accelerator if there is one, else resident."""
    import jax

    if jax.default_backend() != "cpu":
        return jax.devices()[0].memory_stats()["peak_bytes_in_use"] / 1e9
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


def slopes(rows: list[dict]) -> dict[str, float]:
    """Exponents of time against pairs (log-log) over the points above 10 k pairs."""
    large = [row for row in rows if row["pairs"] > 10_000]
    pairs = np.log([row["pairs"] for row in large])
    return {
        key: float(np.polyfit(pairs, np.log([row[key] for row in large]), 1)[0])
        for key in ("forward ms", "v+g ms")
    }


def plot(rows: list[dict], path) -> None:
    """Time and memory against Gaussians and against pixels."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(13, 4))
    by_count = [row for row in rows if row["width"] == 1280]
    by_size = [row for row in rows if row["Gaussians"] == 100_000]
    panels = (
        (axes[0], by_count, lambda r: r["Gaussians"], "Gaussians (1280 × 720)"),
        (axes[1], by_size, lambda r: r["width"] * r["height"], "pixels (100 k)"),
    )
    for axis, chosen, x, label in panels:
        for key in ("forward ms", "v+g ms"):
            axis.loglog(
                [x(r) for r in chosen], [r[key] for r in chosen], "o-", label=key
            )
        axis.set_xlabel(label)
        axis.set_ylabel("ms")
        axis.legend()
    for key in ("forward GB", "v+g GB"):
        axes[2].loglog(
            [r["Gaussians"] for r in by_count],
            [r[key] for r in by_count],
            "o-",
            label=key,
        )
    axes[2].set_xlabel("Gaussians (1280 × 720)")
    axes[2].set_ylabel("peak memory, GB")
    axes[2].legend()
    for axis in axes:
        axis.grid(True, which="both", alpha=0.3)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def main() -> None:
    """Run every point in its own process, save, fit and plot."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--point", nargs=3, type=int, help="COUNT WIDTH HEIGHT")
    parser.add_argument("--gpu", action="store_true")
    options = parser.parse_args()
    if options.point:
        print(json.dumps(point(*options.point)))
        return
    if options.gpu:
        points = [(n, 1920, 1080) for n in (100_000, 1_000_000, 3_000_000)]
    else:
        points = [(n, 1280, 720) for n in COUNTS]
        points += [(100_000, *size) for size in SIZES if size != (1280, 720)]
    rows = []
    for values in points:
        command = [sys.executable, __file__, "--point", *map(str, values)]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(f"{values} failed:\n{done.stderr}")
        rows.append(json.loads(done.stdout.splitlines()[-1]))
        print(rows[-1], flush=True)
    name = "scaling_gpu" if options.gpu else "scaling"
    measure.save(name, rows, claim=__doc__, slopes=slopes(rows))
    if not options.gpu:
        plot(rows, measure.RESULTS / "scaling.png")


if __name__ == "__main__":
    main()
