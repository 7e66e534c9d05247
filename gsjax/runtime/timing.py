"""Run times, and the machine they were measured on."""

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
    """Return the milliseconds of each of ``repeats`` calls, after one warm-up call."""
    jax.block_until_ready(function())
    return [_time_ms(function) for _ in range(repeats)]


def interleaved(
    functions: Mapping[str, Callable[[], Any]], repeats: int = 9
) -> dict[str, float]:
    """Return the median milliseconds of each function, called in turn.

    Every round calls all functions in a new order, so that drift of a shared machine
    and the contents of caches affect all of them alike.
    """
    for function in functions.values():
        jax.block_until_ready(function())
    times: dict[str, list[float]] = {name: [] for name in functions}
    rng, calls = np.random.default_rng(0), list(functions.items())
    for _ in range(repeats):
        for place in rng.permutation(len(calls)):
            name, function = calls[place]
            times[name].append(_time_ms(function))
    return {name: float(np.median(t)) for name, t in times.items()}


def _time_ms(function: Callable[[], Any]) -> float:
    start = time.perf_counter()
    jax.block_until_ready(function())
    return 1e3 * (time.perf_counter() - start)


def machine() -> dict[str, str]:
    """Return the date, processor, devices and versions, to store beside timings."""
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
