"""Timing, machine description, and where results go."""

from __future__ import annotations

import json
import os
import platform
import time
from datetime import date
from pathlib import Path

import jax
import numpy as np

RESULTS = Path(__file__).with_name("results")


def time_ms(function, repeats: int = 9) -> list[float]:
    """Milliseconds of each of ``repeats`` calls, after one that is not counted."""
    jax.block_until_ready(function())
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(function())
        times.append(1e3 * (time.perf_counter() - start))
    return times


def interleaved(functions: dict, repeats: int = 9) -> dict[str, float]:
    """Median ms of each function, all taken in turn: A B C A B C …

    So that a drift of a shared machine falls on all of them and ratios hold.
    """
    for function in functions.values():
        jax.block_until_ready(function())
    times: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(repeats):
        for name, function in functions.items():
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
        "cpu": f"{cpu}, {os.cpu_count()} cores",
        "devices": f"{jax.local_device_count()} × {jax.devices()[0].device_kind}",
        "jax": jax.__version__,
        "python": platform.python_version(),
    }


def save(name: str, rows: list[dict], **more) -> None:
    """Write ``results/name.json`` and print the rows as a table."""
    RESULTS.mkdir(exist_ok=True)
    content = {"machine": machine(), **more, "rows": rows}
    path = RESULTS / f"{name}.json"
    path.write_text(json.dumps(content, indent=1) + "\n")
    print(table(rows))
    print(f"written to {path.name}: {content['machine']}")


def table(rows: list[dict]) -> str:
    """Rows with the same keys as a Markdown table."""
    head = list(rows[0])
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    for row in rows:
        cells = (
            f"{v:.3g}" if isinstance(v, float) and abs(v) < 100
            else f"{v:.0f}" if isinstance(v, float) else str(v)
            for v in row.values()
        )  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)
