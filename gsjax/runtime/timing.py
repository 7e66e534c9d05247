"""How long something takes, and on what machine."""

import platform
import time
from collections.abc import Callable, Mapping
from datetime import date
from pathlib import Path
from typing import Any

import jax
import numpy as np

from gsjax.runtime.machine import usable_cores


def time_ms(function: Callable[[], Any], repeats: int = 9) -> list[float]:
    """Milliseconds of each of ``repeats`` calls, after one that is not counted."""
    jax.block_until_ready(function())
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(function())
        times.append(1e3 * (time.perf_counter() - start))
    return times


def interleaved(
    functions: Mapping[str, Callable[[], Any]], repeats: int = 9
) -> dict[str, float]:
    """Median ms of each function, all taken in turn, in a new order each round: A B C
    C A B …

    So that a drift of a shared machine, and what one leaves in the caches for the next,
    fall on all of them and ratios hold.
    """
    for function in functions.values():
        jax.block_until_ready(function())
    times: dict[str, list[float]] = {name: [] for name in functions}
    rng, calls = np.random.default_rng(0), list(functions.items())
    for _ in range(repeats):
        for place in rng.permutation(len(calls)):
            name, function = calls[place]
            start = time.perf_counter()
            jax.block_until_ready(function())
            times[name].append(1e3 * (time.perf_counter() - start))
    return {name: float(np.median(t)) for name, t in times.items()}


def machine() -> dict[str, str]:
    """What the numbers were measured on."""
    cpu = platform.processor()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        cpu = next(x.split(":")[1].strip() for x in lines if "model name" in x)
    except (OSError, StopIteration):
        pass
    return {
        "date": date.today().isoformat(),
        "cpu": f"{cpu}, {usable_cores()} cores",
        "devices": f"{jax.local_device_count()} × {jax.devices()[0].device_kind}",
        "jax": jax.__version__,
        "python": platform.python_version(),
    }
