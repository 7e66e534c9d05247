"""Claim: on an accelerator each stage is limited by memory traffic or by launches.

``python benchmarks/accelerator.py`` profiles a render and its value and gradient with
the default settings: guitar and garden if their data are present, and synthetic shells
of 0.1, 1 and 3 M Gaussians at 1920 × 1080. For each stage it reports microseconds,
launches, bytes and operations (`kernels`), their share of the device's ceilings, and
the limit: bytes, arithmetic, launches (kernels too short to hide the next launch), or
none of them (below half of each ceiling). Bytes are counted as if caches were empty, so
a share may exceed 1; time in which no kernel runs is waiting for the host. It also
lists how sorts and matrix products were compiled. It needs an accelerator.
"""

from __future__ import annotations

import re
import time
from concurrent.futures import ThreadPoolExecutor

import as_cli  # noqa: F401
import jax
import jax.numpy as jnp
import kernels
import measure
import numpy as np
import scenes
from jax import lax

import gsjax
from gsjax.runtime.console import note

COUNTS = (100_000, 1_000_000, 3_000_000)
_TURNS = 32
_HALF = 0.5  # share of a ceiling below which it is no limit
_SHORT = 5  # µs: shorter kernels end before the next is launched


def ceilings() -> dict[str, float]:
    """Measure the ceilings of the device.

    GB/s of a copy, TFLOP/s of a float32 product, µs of a loop turn and of a call.
    """

    def per_turn(turn, start):
        def run(value, turns):
            return lax.fori_loop(0, turns, lambda _, v: turn(v), value)

        run = jax.jit(run, static_argnums=1)
        many, few = (
            np.median(measure.time_ms(lambda n=n: run(start, n)))
            for n in (3 * _TURNS, _TURNS)
        )
        return (many - few) / (2 * _TURNS)

    large = jnp.ones(2**28, jnp.float32)
    square = jax.random.normal(jax.random.key(0), (8192, 8192)) / 90
    small = jnp.ones(8)
    add = jax.jit(lambda a: a + 1)
    product = per_turn(lambda a: jnp.dot(a, a, precision="highest"), square)
    return {
        "GB/s": 2 * large.nbytes / per_turn(lambda a: a + 1, large) / 1e6,
        "TFLOP/s": 2 * 8192**3 / product / 1e9,
        "turn us": 1e3 * per_turn(lambda a: lax.sin(a) + 1, small),
        "call us": 1e3 * float(np.median(measure.time_ms(lambda: add(small), 99))),
    }


def programs(case: scenes.Case):
    """Compile a render and its gradient: [(name, call, HLO text, seconds)], config."""
    gaussians, camera = case.gaussians, case.camera
    config = gsjax.exact_config(gaussians, camera)
    shape = (camera.height, camera.width, 3)
    weight = jnp.asarray(np.random.default_rng(0).normal(size=shape), jnp.float32)

    def picture(params):
        return gsjax.render(gaussians.replace(params=params), camera, config)

    def loss(params, weight):
        return jnp.sum(picture(params).rgb * weight)

    found = []
    params = gaussians.params
    for name, function, inputs in (
        ("forward", picture, (params,)),
        ("value and gradient", jax.value_and_grad(loss), (params, weight)),
    ):
        lowered = jax.jit(function).lower(*inputs)
        start = time.perf_counter()
        compiled = lowered.compile()
        seconds = time.perf_counter() - start
        call = lambda f=compiled, x=inputs: f(*x)  # noqa: E731
        found.append((name, call, compiled.as_text(), seconds))
    return found, config


def how_compiled(text: str) -> dict[str, list[str]]:
    """Return how sorts and matrix products were compiled, with their precision."""
    sorts, products = set(), set()
    for line in text.splitlines():
        arrays = re.search(r"= (\(.*?\)|\S+) ", line)
        if "cub_sort" in line and arrays:
            sorts.add("radix " + arrays[1].split(",")[0].lstrip("("))
        elif " sort(" in line and arrays:
            keys = arrays[1].count("[")
            sorts.add(f"bitonic, {keys} operands: {arrays[1]}")
        elif " dot(" in line:
            found = re.search(r"operand_precision=\{([^}]*)\}", line)
            products.add(found[1] if found else "default")
        elif "__cublas" in line:
            found = re.search(r'"operand_precision":\[([^\]]*)\]', line)
            products.add(f"library: {found[1] if found else 'default'}")
    return {"sorts": sorted(sorts), "products": sorted(products)}


def measured(case: scenes.Case, made, limits: dict[str, float]) -> list[dict]:
    """Return a row for each stage of each program."""
    rows = []
    for name, call, text, seconds in made:
        ms = float(np.median(measure.time_ms(call)))
        found, busy = kernels.profile(call)
        stages = kernels.by_stage(found, kernels.costs(text))
        common = {
            "scene": case.name,
            "size": f"{case.camera.width} x {case.camera.height}",
            "program": name,
        }
        rows.append(
            {
                **common, "stage": "all", "us": 1e3 * ms,
                "of it waiting": 1e3 * ms - busy, "compile s": seconds,
                "launches": sum(k.launches for k in found),
            }
        )  # fmt: skip
        for stage, row in sorted(stages.items(), key=lambda item: -item[1]["us"]):
            shares = {
                "bytes": row["bytes"] / row["us"] / 1e3 / limits["GB/s"],
                "arithmetic": row["operations"] / row["us"] / 1e6 / limits["TFLOP/s"],
            }
            bound = max(shares, key=lambda key: shares[key])
            if row["us"] < _SHORT * row["launches"]:
                bound = "launches"
            elif shares[bound] < _HALF:
                bound = "none"
            rows.append(
                {
                    **common, "stage": stage, "us": row["us"],
                    "launches": row["launches"], "MB": row["bytes"] / 1e6,
                    "share of bytes": shares["bytes"],
                    "share of arithmetic": shares["arithmetic"], "bound by": bound,
                }
            )  # fmt: skip
    return rows


def main() -> None:
    """Compile in parallel, profile one after another, and save."""
    if jax.default_backend() == "cpu":
        raise SystemExit("accelerator.py: expected an accelerator, got a CPU only")
    cases = [*scenes.real_cases(), *(scenes.shell(n, 1920, 1080) for n in COUNTS)]
    with ThreadPoolExecutor(8) as pool:
        made = list(pool.map(programs, cases))
    limits = ceilings()
    note(f"at most: {limits}")
    rows, compiled = [], {}
    for case, (found, config) in zip(cases, made):
        rows += measured(case, found, limits)
        compiled[case.name] = {
            "pair capacity": config.pair_capacity,
            **how_compiled(found[-1][2]),
        }
    stats = jax.devices()[0].memory_stats() or {}
    keys = list(dict.fromkeys(key for row in rows for key in row))
    rows = [{key: row.get(key, "") for key in keys} for row in rows]
    measure.save(
        "accelerator", rows, claim=__doc__, at_most=limits, compiled=compiled,
        peak_gb=stats.get("peak_bytes_in_use", 0) / 1e9,
    )  # fmt: skip


if __name__ == "__main__":
    main()
